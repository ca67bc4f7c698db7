"""The entry points: training is the loop that anybody can write, seeds side by side are seeds alone."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hrlspec
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import LowLevel
from hrlspec.api import TrainedAgent
from hrlspec.checkpoint.leaves import state_hash
from hrlspec.config import ConfigError, evolve
from hrlspec.evaluation import evaluate_suite, suite_from_text
from hrlspec.learning.train import Trainer
from hrlspec.methods import Ours
from hrlspec.spec import SpecError, task_hashes
from hrlspec.tasks.bank import ITERATIONS_PER_BANK, TaskBanks
from hrlspec.tasks.rewards import reward_machine
from tests.probes import CORRIDOR_CONFIG, CORRIDOR_HELD_OUT, ITERATIONS, Corridor, random_params, small_planner

# a at 0, b at 4, c at 5; episodes start at 1, 2 or 3.
ENV = Corridor()
METHOD = Ours(high=small_planner())
STEPS_PER_ITERATION = 16 * 16
SETTINGS = {field.name: getattr(CORRIDOR_CONFIG, field.name) for field in dataclasses.fields(CORRIDOR_CONFIG)}
CHANGES = SETTINGS | {"total_steps": 1}
SEEDS = (3, 8)

History = list[tuple[int, dict[str, np.ndarray]]]


def train(key: jax.Array) -> tuple[TrainedAgent, History]:
    history: History = []
    trained = hrlspec.train(
        key,
        ENV,
        total_steps=CORRIDOR_CONFIG.total_steps,
        method=METHOD,
        changes=CHANGES,
        held_out=CORRIDOR_HELD_OUT,
        progress=lambda steps, metrics: history.append((steps, dict(metrics))),
    )
    return trained, history


@functools.cache
def alone(seed: int) -> tuple[TrainedAgent, History]:
    return train(jax.random.key(seed))


@functools.cache
def together() -> tuple[TrainedAgent, History]:
    return train(jnp.stack([jax.random.key(seed) for seed in SEEDS]))


def flat(params: Any) -> np.ndarray:
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(params)])


# --- Training ---


@pytest.mark.slow
def test_training_is_the_loop_that_anybody_can_write() -> None:
    """To the bit: with the settings that the changes make, banks drawn from the seed, and what is held out left out."""
    trainer, machine = Trainer(Agent(ENV, CORRIDOR_CONFIG, METHOD)), reward_machine(ENV.propositions)
    reserved = np.unique(CORRIDOR_HELD_OUT.hashes)
    banks = TaskBanks(SEEDS[0], CORRIDOR_CONFIG.curriculum, ENV.num_propositions, reserved)
    state = trainer.init(jax.random.key(SEEDS[0]), banks.at(0), machine)
    metrics = []
    for i in range(ITERATIONS):
        state, some = trainer.iterate(state, banks.at(i), machine, jnp.asarray(reserved))
        metrics.append(jax.device_get(some))
    trained, history = alone(SEEDS[0])
    assert trained.agent == trainer.agent
    assert state_hash(trained.params) == state_hash(state.params)
    assert [some for _, some in history] == metrics


@pytest.mark.slow
def test_training_can_be_vmapped_and_scanned_by_other_code() -> None:
    trainer, machine = Trainer(Agent(ENV, CORRIDOR_CONFIG, METHOD)), reward_machine(ENV.propositions)
    reserved = jnp.asarray(np.unique(CORRIDOR_HELD_OUT.hashes))
    bank = TaskBanks(0, CORRIDOR_CONFIG.curriculum, ENV.num_propositions, np.unique(CORRIDOR_HELD_OUT.hashes)).at(0)

    def trained(key: jax.Array) -> Any:
        begun = trainer.init(key, bank, machine)
        return jax.lax.scan(lambda state, _: trainer.iterate(state, bank, machine, reserved), begun, length=3)

    keys = jax.random.split(jax.random.key(0), 2)
    state, metrics = jax.eval_shape(jax.vmap(trained), keys)
    assert state.iteration.shape == (2,)
    assert metrics["returns"].shape == (2, 3)


@pytest.mark.parametrize("several", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_progress_is_told_after_each_iteration(several: bool) -> None:
    history, shape = (together()[1], (len(SEEDS),)) if several else (alone(SEEDS[0])[1], ())
    assert [steps for steps, _ in history] == [STEPS_PER_ITERATION * (i + 1) for i in range(ITERATIONS)]
    assert history[-1][0] == CORRIDOR_CONFIG.total_steps
    for _, metrics in history:
        assert {"episodes", "successes", "returns", "level", "low/value_loss", "high/value_loss"} <= metrics.keys()
        assert {np.shape(value) for value in metrics.values()} == {shape}
        assert all(np.isfinite(value).all() for value in metrics.values())
    assert sum(metrics["episodes"].sum() for _, metrics in history) > 100


@pytest.mark.slow
def test_seeds_side_by_side_are_seeds_alone() -> None:
    """But for rounding, which is not the same in batches of another size.

    The distance between the two, in units of the way that learning went: at most 2.2e-6, over 10 seeds at three
    instruction sets (AVX, AVX2, AVX-512); no metric came nearer to its bound than a two-thousandth of it.
    """
    both, metrics = together()
    trainer = Trainer(both.agent)
    for i, seed in enumerate(SEEDS):
        one, history = alone(seed)
        assert both.agent == one.agent
        bank = TaskBanks(
            seed, CORRIDOR_CONFIG.curriculum, ENV.num_propositions, np.unique(CORRIDOR_HELD_OUT.hashes)
        ).at(0)
        begun = flat(trainer.init(jax.random.key(seed), bank, one.rewards).params)
        found, expected = flat(both[i].params), flat(one.params)
        way = np.linalg.norm(expected - begun)
        assert way > 1
        assert np.linalg.norm(found - expected) < 1e-3 * way
        for (_, some), (_, mine) in zip(metrics, history, strict=True):
            for name, value in mine.items():
                np.testing.assert_allclose(some[name][i], value, rtol=1e-2, atol=1e-3, err_msg=name)
    other = flat(both[1].params) - flat(both[0].params)
    assert np.linalg.norm(other) > 1


@pytest.mark.slow
def test_one_of_agents_trained_side_by_side() -> None:
    both, _ = together()
    for i in range(len(SEEDS)):
        jax.tree.map(np.testing.assert_array_equal, both[i].params, jax.tree.map(lambda x, i=i: x[i], both.params))
        assert jax.tree.map(jnp.shape, both[i].params) == jax.tree.map(jnp.shape, alone(SEEDS[0])[0].params)
        assert both[i].rewards is both.rewards


def test_what_is_held_out_would_have_been_trained_on() -> None:
    def hashes(reserved: np.ndarray) -> np.ndarray:
        banks = TaskBanks(SEEDS[0], CORRIDOR_CONFIG.curriculum, ENV.num_propositions, reserved)
        return np.concatenate([task_hashes(banks.at(i)) for i in (0, ITERATIONS_PER_BANK)])

    assert np.isin(hashes(np.zeros(0, np.uint32)), CORRIDOR_HELD_OUT.hashes).any()
    assert not np.isin(hashes(np.unique(CORRIDOR_HELD_OUT.hashes)), CORRIDOR_HELD_OUT.hashes).any()


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"env": "lettre"}, ValueError, "unknown environment 'lettre', expected one of: letter"),
        ({"method": "best"}, ValueError, "unknown method 'best', expected one of: ours"),
        ({"total_steps": 0}, ConfigError, "Config.total_steps is 0, expected a number from 1 to"),
        (
            {"changes": {"low.rate": 1.0}},
            ConfigError,
            "unknown setting 'rate' of PPOConfig, expected one of: optimiser",
        ),
        ({"changes": {"num_envs": 7}}, ConfigError, "blocks is 2, expected a divisor of 7"),
    ],
)
def test_what_cannot_be_meant_is_refused(wrong: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        hrlspec.train(jax.random.key(0), **({"env": ENV} | wrong))


# --- Evaluation ---


class ObedientLow(LowLevel):
    """Walks straight to what its sub-task reaches, whatever it avoids."""

    def control(self, params: Any, view: Any, instruction: Any) -> tuple[jax.Array, jax.Array]:
        planes, here = view
        cells = jnp.arange(here.shape[0])
        right = (instruction.reach @ planes @ cells) > here @ cells
        return jnp.where(right, 10.0, -10.0) * jnp.array([-1.0, 1.0]), jnp.float32(0)


class Obedient(Agent):
    """An agent whose low level does as it is told."""

    @functools.cached_property
    def low(self) -> LowLevel:
        return ObedientLow(self.env, self.config, self.method.sees, self.high.follows_plan)


@functools.cache
def obedient() -> TrainedAgent:
    agent = Obedient(ENV, evolve(CORRIDOR_CONFIG, {"num_envs": 32}), METHOD)
    return TrainedAgent(agent, random_params(agent, 0), reward_machine(ENV.propositions, completion=2.0))


TASKS = """
achieve a                          # 1, 2 or 3 steps

achieve a; achieve b
achieve c ensuring not b           # which lies on the way
achieve d                          # which is nowhere
"""


def test_tasks_are_evaluated_as_text() -> None:
    result = hrlspec.evaluate(jax.random.key(0), obedient(), TASKS, episodes=30, greedy=True)
    assert [task.task for task in result.per_task] == [
        "achieve a",
        "achieve a; achieve b",
        "achieve c ensuring not b",
        "achieve d",
    ]
    scores = [task.score for task in result.per_task]
    assert [score.episodes for score in scores] == [8, 8, 8, 8]  # as many for each, and 30 at least
    assert [score.success_rate.estimate for score in scores] == [1, 1, 0, 0]
    assert [score.violation_rate.estimate for score in scores] == [0, 0, 1, 0]
    assert [score.return_mean.estimate for score in scores] == [2, 2, 0, 0]
    assert 1 <= scores[0].steps_mean.estimate <= 3
    assert 5 <= scores[1].steps_mean.estimate <= 7
    assert result.total.success_rate.estimate == 0.5


def test_layouts_depend_on_the_seed_alone() -> None:
    def steps(key: int, seed: int) -> float:
        result = hrlspec.evaluate(jax.random.key(key), obedient(), "achieve a", episodes=32, seed=seed, greedy=True)
        return result.total.steps_mean.estimate

    assert steps(0, 0) == steps(1, 0)
    assert len({steps(0, seed) for seed in range(3)}) > 1


def test_a_trained_agent_is_evaluated_on_a_suite() -> None:
    trained, _ = alone(SEEDS[0])
    suite = suite_from_text("tasks", "achieve a\nachieve b", ENV.propositions)
    key = jax.random.key(1)
    result = hrlspec.evaluate(key, trained, suite, episodes=20)
    assert result.to_json() == hrlspec.evaluate(key, trained, "achieve a\nachieve b", episodes=20).to_json()
    expected = evaluate_suite(key, trained.agent, trained.params, trained.rewards, suite, layouts_per_task=10)
    assert result.to_json() == expected.to_json()


@pytest.mark.slow
def test_one_of_many_is_evaluated() -> None:
    both, _ = together()
    result = hrlspec.evaluate(jax.random.key(1), both[1], "achieve a\nachieve b", episodes=20)
    assert result.total.episodes == 20


@pytest.mark.parametrize(
    ("text", "message"),
    [("achieve z", "z"), ("achieve a;;", "line 1, column 11"), ("# none", "found no formula")],
)
def test_tasks_that_cannot_be_read_are_refused(text: str, message: str) -> None:
    with pytest.raises((SpecError, ValueError), match=message):
        hrlspec.evaluate(jax.random.key(0), obedient(), text)
