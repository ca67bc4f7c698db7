"""Training spread over several devices, which on a CPU are threads: the same run."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec import checkpoint
from hrlspec.agent.experience import Step
from hrlspec.agent.low_level import TaskBook
from hrlspec.checkpoint import state_hash
from hrlspec.config import Config, ConfigError, evolve
from hrlspec.learning.shards import SPREAD, WHOLE, Shards
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.methods import ImplicitPlanner, Ours
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import reward_machine
from tests.probes import Corridor, assert_agree, on_device, quick_jit, small_agent, small_config, small_planner

ENV = Corridor(cells=("a", "", "bc", "", "d", "", ""), starts=(1, 3, 5), horizon=9)
# So many that one of four devices has 32 in groups of 8: with 16, JAX 0.10.2 rounds otherwise.
CONFIG = evolve(small_config(num_envs=128, blocks=4), {"curriculum.promotion": 0.3})
MACHINE = reward_machine(ENV.propositions, subtask=0.5)
ITERATIONS = 30
SLOW = pytest.mark.slow  # compiling for each number of devices takes most of the time


class Measuring(ImplicitPlanner):
    """Whose parameters depend on what is measured, too."""

    def measure(self, book: TaskBook, steps: Step, config: Config) -> Any:
        del book, config
        return steps.outcome.reward.sum()

    def observe(self, params: Any, measured: Any) -> Any:
        return jax.tree.map(lambda x: x + 1e-6 * measured, params)


@functools.cache
def trainer(devices: int) -> Trainer:
    return Trainer(small_agent(ENV, CONFIG, Ours(high=Measuring(**vars(small_planner())))), devices)


@functools.cache
def bank() -> Any:
    return on_device(draw_bank(np.random.default_rng(0), CONFIG.curriculum, 4, np.zeros(0, np.uint32)))


@functools.cache
def programs(devices: int) -> Any:
    """The first state and an iteration, for so many devices."""
    some = trainer(devices)
    return quick_jit(some.init), quick_jit(some.iterate)


def trained(state: TrainState, devices: int, iterations: int) -> TrainState:
    for _ in range(iterations):
        state, _ = programs(devices)[1](state, bank(), MACHINE, jnp.zeros(0, jnp.uint32))
    return state


@functools.cache
def fresh(devices: int) -> TrainState:
    state: TrainState = programs(devices)[0](jax.random.key(0), bank(), MACHINE)
    return state


def moved(state: TrainState, devices: int) -> TrainState:
    """The same state on so many devices."""
    there: TrainState = jax.tree.map(lambda x, like: jax.device_put(x, like.sharding), state, fresh(devices))
    return there


def moved_by_checkpoint(state: TrainState, devices: int, folder: Path) -> TrainState:
    """The state, saved and restored on so many devices."""
    checkpoint.save(folder, 1, state)
    return checkpoint.load(folder, fresh(devices)).state


@SLOW
def test_an_iteration_does_not_depend_on_the_number_of_devices() -> None:
    """Each of 30 in a row, started from the same state; to the bit it is only where XLA adds up alike, see below."""
    state = fresh(1)
    for _ in range(ITERATIONS):
        several = trained(moved(state, 4), 4, 1)
        state = trained(state, 1, 1)
        assert_agree(state, several)
    assert int(state.curriculum.level) > 0  # and with it the counts of all devices


@SLOW
@pytest.mark.skipif(jax.__version_info__ < (0, 10, 2), reason="XLA adds up a bias's gradient in another order")
@pytest.mark.parametrize("devices", [2, 4])
def test_nor_does_a_run_to_the_bit(devices: int) -> None:
    hashes = [state_hash(trained(fresh(n), n, ITERATIONS)) for n in (1, devices)]
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize(("before", "after"), [(4, 1), *(pytest.param(*two, marks=SLOW) for two in ((1, 4), (2, 4)))])
def test_a_checkpoint_is_restored_on_another_number_of_devices(before: int, after: int, tmp_path: Path) -> None:
    restored = moved_by_checkpoint(fresh(before), after, tmp_path)
    assert state_hash(restored) == state_hash(fresh(before))
    assert {x.sharding for x in jax.tree.leaves(restored)} == {x.sharding for x in jax.tree.leaves(fresh(after))}


@SLOW
@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 1), (2, 4)])
def test_and_goes_on_there(before: int, after: int, tmp_path: Path) -> None:
    state = trained(fresh(before), before, 1)
    restored = moved_by_checkpoint(state, after, tmp_path)
    assert_agree(trained(restored, after, 1), trained(state, before, 1))


def test_each_device_has_its_environments_and_all_parameters() -> None:
    state = fresh(4)
    assert {len(x.sharding.device_set) for x in jax.tree.leaves(state)} == {4}
    for x in jax.tree.leaves((state.collector, state.tasks)):
        assert [shard.data.shape[0] for shard in x.addressable_shards] == [32] * 4 or not x.size
    for x in jax.tree.leaves((state.params, state.optimisers)):
        assert x.is_fully_replicated


@SLOW
def test_and_after_an_iteration() -> None:
    for before, after in zip(jax.tree.leaves(fresh(4)), jax.tree.leaves(trained(fresh(4), 4, 1)), strict=True):
        assert after.sharding.is_equivalent_to(before.sharding, before.ndim)


@pytest.mark.parametrize("devices", [1, 2, 4])
def test_means_and_totals_are_over_all_blocks(devices: int) -> None:
    shards = Shards(8, 4, devices)
    rows = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)

    def on_each(x: Any) -> Any:
        blocks = shards.in_blocks(x)
        squares = shards.mean(lambda block: {"all": (block**2).sum(), "each": block.sum(0)}, blocks)
        return squares, shards.total(blocks.sum((1, 2))), shards.envs()

    means, total, envs = jax.jit(shards.on_each(on_each, (SPREAD,), (WHOLE, WHOLE, SPREAD)))(rows)
    blocks = rows.reshape(4, 2, 3).astype(np.float64)
    np.testing.assert_allclose(means["all"], (blocks**2).sum((1, 2)).mean(), rtol=1e-6)
    np.testing.assert_allclose(means["each"], blocks.sum(1).mean(0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(total, blocks.sum(), rtol=1e-5)
    np.testing.assert_array_equal(envs, np.arange(8))


@pytest.mark.parametrize(
    ("blocks", "devices", "message"),
    [
        (4, 3, "devices is 3, expected a divisor of 4, the number of blocks"),
        (1, 2, "devices is 2, expected a divisor of 1, the number of blocks"),
        (64, 64, "devices is 64, but JAX has 4"),
    ],
)
def test_what_does_not_go_together_is_refused(blocks: int, devices: int, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}$"):
        Shards(64, blocks, devices)
