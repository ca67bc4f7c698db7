"""After its first call no program is compiled again, and none talks to the host while it runs."""

from __future__ import annotations

import dataclasses
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.evaluation import episodes
from hrlspec.evaluation.episodes import run_episodes
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.tasks.bank import ITERATIONS_PER_BANK, TaskBanks
from hrlspec.tasks.rewards import reward_machine
from tests.probes import (
    CORRIDOR_CONFIG,
    CORRIDOR_HELD_OUT,
    Corridor,
    bank_of,
    on_device,
    probe_task,
    random_params,
    small_agent,
)

ENV = Corridor()
TRAINER = Trainer(small_agent(ENV, CORRIDOR_CONFIG))
BANKS = TaskBanks(0, CORRIDOR_CONFIG.curriculum, ENV.num_propositions, np.zeros(0, np.uint32))

step = Trainer.iterate
"""With the settings of the API's tests, which train by the same program."""


def fresh() -> tuple[TrainState, Any, Any]:
    """A state, rewards, and what is reserved, on the device."""
    machine = on_device(reward_machine(ENV.propositions))
    state = TRAINER.init(jax.random.key(0), BANKS.at(0), machine)
    return state, machine, jnp.zeros(len(CORRIDOR_HELD_OUT), jnp.uint32)


def with_full_window(state: TrainState) -> TrainState:
    """As if every episode of the current level had succeeded for long."""
    many = {name: jnp.int32(10_000) for name in ("finished", "succeeded")}
    return dataclasses.replace(state, curriculum=dataclasses.replace(state.curriculum, **many))


def test_training_is_traced_once_for_all_levels_banks_and_rewards() -> None:
    state, machine, reserved = fresh()
    levels, sizes = [], set()
    for i in (0, 1, ITERATIONS_PER_BANK, ITERATIONS_PER_BANK + 1):
        state, metrics = step(TRAINER, state, BANKS.at(i), machine, reserved)
        sizes.add(step._cache_size())
        levels.append(int(metrics["level"]))
        state = with_full_window(state)
    assert levels == [1, 1, 2, 2]
    assert np.asarray(state.tasks.depth).max() == 2  # tasks of the new level have come in
    other = on_device(reward_machine(ENV.propositions, completion=2.0))
    step(TRAINER, state, BANKS.at(0), other, reserved + 1)
    assert sizes == {step._cache_size()}


def test_training_has_no_business_with_the_host() -> None:
    """Nothing is sent to the device once a chunk has begun, and no program calls back."""
    state, machine, reserved = fresh()
    bank = BANKS.at(0)
    state, _ = step(TRAINER, state, bank, machine, reserved)
    with jax.transfer_guard("disallow"):
        for _ in range(3):
            state, metrics = step(TRAINER, state, bank, machine, reserved)
        with pytest.raises(Exception, match="Disallowed host-to-device transfer"):
            step(TRAINER, state, bank, machine, np.zeros(len(CORRIDOR_HELD_OUT), np.uint32))
    assert metrics["level"] >= 1
    program = step.lower(TRAINER, fresh()[0], bank, machine, reserved).as_text()
    for word in ("callback", "infeed", "outfeed", "send", "recv"):
        assert word not in program
    talkative = jax.jit(lambda x: jax.debug.print("{}", x)).lower(1.0).as_text()
    assert "callback" in talkative  # as such a program would say


def test_an_evaluation_is_traced_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """For other parameters, tasks, layouts and rewards, and whatever is left for the last chunk."""
    begin = chex.assert_max_traces(episodes.start, n=1)  # called once in each program
    monkeypatch.setattr(episodes, "start", begin)
    # No other test has this agent, whose programs it would otherwise find compiled.
    env = Corridor(horizon=11)
    agent = small_agent(env, CORRIDOR_CONFIG)

    def evaluate(names: list[str], seed: int, completion: float = 1.0, **how: Any) -> Any:
        trees = bank_of([probe_task(name, num_propositions=4, num_nodes=6) for name in names], 20)
        layouts = jax.vmap(env.sample_layout, (0, None))(jax.random.split(jax.random.key(seed), 20), env.default_params)
        machine = reward_machine(env.propositions, completion=completion)
        return run_episodes(
            jax.random.key(seed), agent, random_params(agent, seed), machine, trees, layouts, chunk=8, **how
        )

    first = evaluate(["achieve a", "a; b"], 0)
    second = evaluate(["(a or b); c"], 1, completion=2.0)
    assert first.steps.shape == second.steps.shape == (20,)
    with pytest.raises(AssertionError, match="traced > 1 times"):
        evaluate(["achieve a"], 0, greedy=True)  # another program
