"""Staying: what an agent that is trained for it is told, when it jumps, and what it learns from."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.agent.agent import Agent
from hrlspec.agent.interaction import _progress, start
from hrlspec.agent.low_level import TaskBook
from hrlspec.config import Config, ConfigError, evolve
from hrlspec.evaluation import ltl_suite
from hrlspec.learning.experience import gather
from hrlspec.learning.rollout import collect
from hrlspec.learning.train import Trainer
from hrlspec.methods import LTL2ACTION, OPTION
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import reward_machine
from tests.learning.test_rollout import begun
from tests.probes import on_device, quick_jit, random_params, small_agent, small_config

LETTER = envs_jax.make("letter")
NAMES = LETTER.propositions
BEFORE = 4
COMPLETION = reward_machine(NAMES)


def staying(**more: Any) -> Config:
    changes = {"curriculum.stay": 0.5, "curriculum.hold_before_jump": BEFORE, "network.lookahead": 2, **more}
    return evolve(small_config(), changes)


def book_of(config: Config, text: str) -> tuple[Agent, TaskBook]:
    agent = small_agent(LETTER, config)
    suite = ltl_suite("some", text, LETTER, forever=True, max_nodes=8)
    return agent, agent.low.prepare(random_params(agent, 0), suite.automata)


def test_what_is_to_be_held_lies_ahead_of_itself() -> None:
    """Before the jump and after it; not where something else comes next, nor for an agent that knows nothing of it."""
    _, book = book_of(staying(), "FG a & F c")
    ahead, reach = np.asarray(book.instructions.ahead), np.asarray(book.tree.reach, np.float32)
    hold = np.asarray(book.tree.hold)
    assert set(hold.flat) == {1, BEFORE}
    for row, edge in np.argwhere(np.asarray(book.tree.valid) & (np.asarray(book.tree.parent) == 0)):
        held = hold[row, edge] > 1
        assert held == (reach[row, edge] == [1, 0, 0, 0, 0]).all()
        assert (ahead[row, edge, 0] == reach[row, edge]).all() == held
    _, other = book_of(evolve(small_config(), {"network.lookahead": 2}), "FG a & F c")
    assert other.tree.hold is None
    assert not (np.asarray(other.instructions.ahead)[hold > 1] > 0).any()


@pytest.mark.parametrize(
    ("trace", "jumps_after"),
    [("aaaaa", 4), ("aaabaaaaa", 8), ("bcaaaa", 6), ("aaa", None), ("aaabaaab", None)],
)
def test_it_jumps_once_it_has_held_for_long_enough(trace: str, jumps_after: int | None) -> None:
    _, book = book_of(staying(), "FG a")
    book = on_device(book)
    layout = jax.vmap(LETTER.sample_layout, (0, None))(jax.random.split(jax.random.key(0), 1), LETTER.default_params)
    worker = start(jax.random.split(jax.random.key(0), 1), LETTER, COMPLETION, book, layout, jnp.zeros(1, jnp.int32))
    worker = dataclasses.replace(worker, decision=dataclasses.replace(worker.decision, edge=jnp.ones(1, jnp.int32)))
    found, rounds = None, 0
    for step, name in enumerate(trace, 1):
        labels = jnp.array([[name == other for other in NAMES]])
        task, state, moved, _, accepted = _progress(book, worker, labels)
        assert bool(moved[0]) == bool(accepted[0])
        found, rounds = found or (step if moved[0] else None), rounds + int(accepted[0])
        worker = dataclasses.replace(worker, task=task, task_state=state)
    assert found == jumps_after
    assert rounds == (0 if jumps_after is None else len(trace) - jumps_after + 1)


def test_nothing_that_was_held_is_relabelled_as_reached_when_it_had_been_held() -> None:
    """Paths of the copies have sub-tasks that are completed as soon as they are met, and the trees of all are alike."""
    config = staying(**{"relabel.share": 1.0, "shield.enabled": False, "curriculum.levels": 1})
    agent = small_agent(LETTER, config)
    setting, collector = begun(agent, 2)
    steps = quick_jit(lambda: collect(jax.random.key(2), setting, collector, 0.0)[1])()
    envs, reserved = jnp.arange(config.num_envs, dtype=jnp.int32), jnp.zeros(0, jnp.uint32)
    args = agent, setting.params, COMPLETION, setting.book, steps, reserved, envs
    found = quick_jit(lambda: gather(jax.random.key(3), *args))()
    hold = np.asarray(found.trees.hold).reshape(2 * config.num_envs, -1)
    assert (hold[: config.num_envs] > 1).any()
    assert (hold[config.num_envs :] == 1).all()


def test_who_is_not_told_is_not_trained_to_stay() -> None:
    with pytest.raises(ConfigError, match=r"curriculum\.stay is 0\.5, which asks for a low level that sees ahead"):
        staying(**{"network.lookahead": 0})
    with pytest.raises(ConfigError, match="asks for a low level that sees ahead"):
        evolve(OPTION.configure(staying()), {"curriculum.stay": 0.5})
    with pytest.raises(ConfigError, match=r"curriculum\.stay is 0\.5, which LTL2Action cannot be told"):
        small_agent(LETTER, staying(), LTL2ACTION)


def test_an_iteration_leaves_the_state_as_it_was_made() -> None:
    """Tasks that end with staying go in and come out: nothing compiles anew after the first."""
    agent = small_agent(LETTER, staying())
    trainer, none = Trainer(agent), np.zeros(0, np.uint32)
    bank = on_device(draw_bank(np.random.default_rng(0), agent.config.curriculum, len(NAMES), none))
    before = jax.eval_shape(lambda: trainer.init(jax.random.key(0), bank, COMPLETION))
    after, _ = jax.eval_shape(lambda state: trainer.iterate(state, bank, COMPLETION, jnp.asarray(none)), before)
    assert before.tasks.hold.shape == before.tasks.parent.shape
    jax.tree.map(assert_same, before, after)


def assert_same(one: jax.ShapeDtypeStruct, other: jax.ShapeDtypeStruct) -> None:
    assert (one.shape, one.dtype, one.weak_type) == (other.shape, other.dtype, other.weak_type)
