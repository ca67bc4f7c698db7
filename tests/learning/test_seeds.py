"""Several seeds as one program: each is what it is alone, and nothing is compiled after the first iteration."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.checkpoint import state_hash
from hrlspec.config import ConfigError
from hrlspec.learning.seeds import Seeds
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.tasks.bank import ITERATIONS_PER_BANK, TaskBanks
from hrlspec.tasks.rewards import reward_machine
from tests.probes import CORRIDOR_CONFIG, CORRIDOR_HELD_OUT, Corridor, assert_agree, on_device, quick_jit, small_agent

ENV = Corridor()
TRAINER = Trainer(small_agent(ENV, CORRIDOR_CONFIG))


@functools.cache
def machine() -> Any:
    return on_device(reward_machine(ENV.propositions))


@functools.cache
def banks(seed: int) -> TaskBanks:
    return TaskBanks(seed, CORRIDOR_CONFIG.curriculum, ENV.num_propositions, np.zeros(0, np.uint32))


def held_out(seed: int) -> jax.Array:
    """Each seed has its own."""
    return jnp.asarray(CORRIDOR_HELD_OUT.hashes[: seed + 1].repeat(3)[:3])


@functools.cache
def fresh(seed: int) -> TrainState:
    state: TrainState = quick_jit(TRAINER.init)(jax.random.key(seed), banks(seed).at(0), machine())
    return state


@functools.cache
def alone() -> Any:
    return quick_jit(TRAINER.iterate)


WAYS = pytest.mark.parametrize(
    ("number", "devices", "at_once"), [(2, 2, False), (4, 2, False), (3, 1, True), (4, 2, True)]
)


@pytest.mark.slow
@WAYS
def test_each_iteration_is_that_of_each_seed_alone(
    number: int, devices: int, at_once: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """From the same states; counts, keys and curricula to the bit, and what an episode does with it.

    A draw that falls next to the border between two actions could go either way; with these seeds none does.
    """
    seeds = Seeds(TRAINER, number, devices, at_once)
    iterate = quick_jit(seeds.iterate)
    reserved = jnp.stack([held_out(seed) for seed in range(number)])
    states, metrics = [fresh(seed) for seed in range(number)], dict[str, Any]()
    for i in (0, 1, ITERATIONS_PER_BANK, ITERATIONS_PER_BANK + 1):
        tasks = [banks(seed).at(i) for seed in range(number)]
        with jax.log_compiles(bool(i)):
            stacked = jax.tree.map(lambda *x: jnp.stack(x), *tasks)
            together, metrics = iterate(seeds.join(states), stacked, machine(), reserved)
            parts = seeds.split(together)
        for seed in range(number):
            states[seed], mine = alone()(states[seed], tasks[seed], machine(), held_out(seed))
            assert_agree(parts[seed], states[seed])
            assert_agree({name: value[seed] for name, value in metrics.items()}, mine)
    assert {value.shape for value in metrics.values()} == {(number,)}
    assert len({state_hash(state.params) for state in states}) == number
    assert [said for said in caplog.messages if "ompil" in said] == []


class Toy(Trainer):
    """Compiled in no time, with what seeds do not do equally often: rounds of a loop, a branch."""

    def iterate(self, state: TrainState, bank: Any, machine: Any, reserved: Any) -> Any:
        key, draw = jax.random.split(state.key)
        rounds, much = jax.random.randint(draw, (), 0, 9), bank.depth.max() + machine.completion
        grown = jax.lax.while_loop(
            lambda at: at[0] < rounds, lambda at: (at[0] + 1, at[1] + much), (0, state.params["x"])
        )
        params = jax.lax.cond(rounds > 4, lambda x: 2 * x, lambda x: x - reserved.sum(), grown[1])
        return state.replace(key=key, params={"x": params}), {"rounds": rounds.astype(jnp.float32), "sum": params.sum()}


def toy_state(seed: int) -> TrainState:
    """Of the real form, but for its parameters."""
    shapes = shape_of_state()
    rng = np.random.default_rng(seed)

    def some(like: Any) -> jax.Array:
        if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
            return jax.random.split(jax.random.key(seed), like.shape)
        return jnp.asarray(rng.normal(size=like.shape), like.dtype)

    return jax.tree.map(some, shapes).replace(params={"x": jnp.array([-0.0, seed, 0.5])})


@functools.cache
def shape_of_state() -> TrainState:
    shapes: TrainState = jax.eval_shape(TRAINER.init, jax.random.key(0), banks(0).at(0), machine())
    return shapes


@WAYS
def test_seeds_that_do_different_things(
    number: int, devices: int, at_once: bool, caplog: pytest.LogCaptureFixture
) -> None:
    toy = Toy(TRAINER.agent)
    one = quick_jit(toy.iterate)
    seeds, states = Seeds(toy, number, devices, at_once), [toy_state(seed) for seed in range(number)]
    tasks = [banks(seed).at(0) for seed in range(number)]
    stacked, reserved = jax.tree.map(lambda *x: jnp.stack(x), *tasks), jnp.stack([*map(held_out, range(number))])
    together, rounds = seeds.join(states), list[list[float]]()
    program = quick_jit(seeds.iterate).lower(together, stacked, machine(), reserved).compile()
    for i in range(3):
        with jax.log_compiles(i > 0):
            together, metrics = program(together, stacked, machine(), reserved)
            parts = seeds.split(together)
        alone = [one(*each, machine(), own) for *each, own in zip(states, tasks, reserved, strict=True)]
        states = [state for state, _ in alone]
        assert [state_hash(part) for part in parts] == [state_hash(state) for state in states]
        assert state_hash(metrics) == state_hash(jax.tree.map(lambda *x: jnp.stack(x), *(told for _, told in alone)))
        rounds.append(metrics["rounds"].tolist())
    assert max(len({*some}) for some in rounds) > 1
    assert [said for said in caplog.messages if "ompil" in said] == []


@pytest.mark.parametrize("devices", [1, 2, 4])
def test_states_are_joined_and_split_to_the_bit(devices: int) -> None:
    """Negative zeros too, and no matter where they lie."""
    seeds, states = Seeds(TRAINER, 4, devices), [toy_state(seed) for seed in range(4)]
    joined = seeds.join(states)
    assert [state_hash(some) for some in seeds.split(joined)] == [state_hash(some) for some in states]
    for x in jax.tree.leaves(joined):
        assert [shard.data.shape[0] for shard in x.addressable_shards] == [4 // devices] * devices or not x.size


@pytest.mark.parametrize(
    ("number", "devices", "message"),
    [(3, 2, "devices is 2, expected a divisor of 3"), (64, 64, "devices is 64, but JAX has 4")],
)
def test_what_does_not_go_together_is_refused(number: int, devices: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Seeds(TRAINER, number, devices)
