"""Exclusions: what is counted, what follows from it for a task, and that training finds one that the world has."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from envs_jax.base import EnvParams, StepResult
from hrlspec.agent.agent import Agent
from hrlspec.agent.networks.exclusions import Entries, Exclusions, entries, owed, spoils
from hrlspec.config import evolve
from hrlspec.learning.train import Trainer
from hrlspec.methods import METHODS
from hrlspec.spec import TaskTree
from hrlspec.tasks.rewards import reward_machine
from tests.probes import (
    Corridor,
    CorridorLayout,
    CorridorState,
    bank_of,
    on_device,
    random_params,
    small_agent,
    small_config,
)
from tests.trees import random_tree, tree_of

P = 4


@pytest.mark.parametrize("seed", range(5))
def test_entries_are_what_a_plain_count_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = rng.random((40, 3, P)) < 0.2
    episode = np.cumsum(rng.random((40, 3)) < 0.15, 0).astype(np.int32)
    after, exposed, entered = np.zeros((P, P)), np.zeros(P), np.zeros(P)
    for env in range(3):
        seen, previous = set[int](), set[int]()
        for t in range(40):
            if t == 0 or episode[t, env] != episode[t - 1, env]:
                seen, previous = set(), set()
            now = set(np.flatnonzero(labels[t, env]).tolist())
            for q in seen:
                exposed[q] += 1
                for g in now - previous:
                    after[q, g] += 1
            for g in now - previous:
                entered[g] += 1
            seen, previous = seen | now, now
    counted = entries(jnp.asarray(labels), jnp.asarray(episode))
    np.testing.assert_array_equal(counted.after, after)
    np.testing.assert_array_equal(counted.exposed, exposed)
    np.testing.assert_array_equal(counted.entered, entered)
    assert counted.steps == 120


@pytest.mark.parametrize(
    ("after", "steps_after", "excluded"),
    [(0, 1_000, True), (1, 1_000, True), (2, 1_000, False), (0, 999, False), (20, 2_000, False), (0, 0, False)],
)
def test_what_is_missing_where_it_was_to_be_expected_is_excluded(after: int, steps_after: int, excluded: bool) -> None:
    """The second proposition was entered once in ten steps: 100 times in 1,000."""
    none = Entries.none(2)
    counts = dataclasses.replace(
        none,
        after=none.after.at[0, 1].set(after),
        exposed=jnp.array([float(steps_after), 0.0]),
        entered=jnp.array([0.0, 1_000.0]),
        steps=jnp.float32(10_000),
    )
    np.testing.assert_array_equal(counts.excluded(), [[False, excluded], [False, False]])
    assert not none.excluded().any()


@pytest.mark.parametrize("seed", range(20))
def test_owed_is_what_all_ways_have_in_common(seed: int) -> None:
    tree = random_tree(np.random.default_rng(seed), num_nodes=9, num_propositions=P, most_together=2)

    def ways(node: int) -> list[np.ndarray]:
        below = [k for k in range(tree.num_nodes) if tree.valid[k] and tree.parent[k] == node]
        here = np.asarray(tree.reach[node])
        return [here | way for k in below for way in ways(k)] or [here]

    found = np.asarray(owed(tree))
    for node in np.flatnonzero(tree.valid & (tree.parent >= 0)):
        np.testing.assert_array_equal(found[node], np.logical_and.reduce(ways(int(node))))


@pytest.mark.parametrize(
    ("edges", "avoided"),
    [
        ([(0, "c", "")], ["a"]),
        ([(0, "b", ""), (1, "c", "")], ["a", "a"]),
        ([(0, "c", ""), (1, "b", "")], ["a", ""]),
        ([(0, "a", ""), (1, "c", "")], ["", "a"]),  # it must be entered: nothing can be done about that
        ([(0, "b", ""), (1, "c", ""), (1, "d", "")], ["", "a", ""]),  # there is another way
        ([(0, "b", ""), (1, "c", ""), (1, "cd", "")], ["a", "a", "a"]),
    ],
)
def test_what_spoils_what_is_owed_is_avoided(edges: Any, avoided: list[str]) -> None:
    tree = tree_of(edges, num_propositions=P)
    excluded = jnp.zeros((P, P), bool).at[0, 2].set(True)  # no c after a
    found = np.asarray(spoils(owed(tree), jnp.asarray(tree.reach), excluded))
    assert ["".join("abcd"[p] for p in np.flatnonzero(row)) for row in found[1:]] == avoided


@struct.dataclass
class _Memory(CorridorState):
    gone: jax.Array  # bool []


@dataclasses.dataclass(frozen=True)
class Vanishing(Corridor):
    """A corridor where nothing bears a c any more once the agent has been at a."""

    cells: tuple[str, ...] = ("a", "", "b", "c")
    starts: tuple[int, ...] = (1,)

    def reset_to(self, layout: CorridorLayout, key: jax.Array, params: EnvParams) -> tuple[jax.Array, _Memory]:
        state = _Memory(position=layout.start, layout=layout, time=jnp.int32(0), gone=jnp.bool_(False))
        return self.observation(state, params), state

    def step_env(self, key: jax.Array, state: Any, action: jax.Array, params: EnvParams) -> StepResult:
        observation, after, *rest = super().step_env(key, state, action, params)
        return observation, after.replace(gone=state.gone | (after.position == 0)), *rest

    def labels(self, state: Any, params: EnvParams) -> jax.Array:
        return super().labels(state, params) & ~(state.gone & (jnp.arange(P) == 2))


def test_training_finds_what_the_world_takes_away() -> None:
    changes = {"network.exclusions": True, "network.forbidden": True, "shield.enabled": False}
    agent = small_agent(Vanishing(), evolve(small_config(), changes))
    config = agent.config.curriculum
    tasks = [tree_of([(0, goal, "")], num_propositions=P, num_nodes=config.max_nodes) for goal in "abc"]
    tasks.append(tree_of([(0, "b", ""), (1, "c", "")], num_propositions=P, num_nodes=config.max_nodes))
    bank = on_device(bank_of(tasks, config.levels * config.tasks_per_level))
    machine = reward_machine(agent.env.propositions)
    trainer, reserved = Trainer(agent), np.zeros(1, np.uint32)
    state = trainer.init(jax.random.key(0), bank, machine)
    before = agent.low.instruct(state.params, on_device(tasks[3]))
    assert not before.avoid.any()
    assert not before.forbidden.any()
    for _ in range(30):
        state, _ = trainer.iterate(state, bank, machine, reserved)
    counts = state.params["low"][Exclusions.COLLECTION]["exclusions"]["entries"]
    assert counts.steps == 30 * agent.config.num_envs * agent.config.num_steps  # the optimiser leaves them alone
    np.testing.assert_array_equal(np.argwhere(counts.excluded()), [[0, 2]])
    now = agent.low.instruct(state.params, on_device(tasks[3]))
    for row in (now.avoid, now.forbidden):
        np.testing.assert_array_equal(np.argwhere(row[1:]), [[0, 0], [1, 0]])


def test_who_knows_the_subtask_alone_avoids_what_spoils_the_subtask_alone() -> None:
    method = METHODS["option"]
    agent = Agent(Vanishing(), method.configure(evolve(small_config(), {"network.exclusions": True})), method)
    params = random_params(agent, 0)
    many = jax.tree.map(lambda x: jnp.full_like(x, 1e4), Entries.none(P))
    counts = dataclasses.replace(many, after=many.after.at[0, 2].set(0))
    params["low"][Exclusions.COLLECTION] = {"exclusions": {"entries": counts}}
    tree: TaskTree = on_device(tree_of([(0, "b", ""), (1, "c", "")], num_propositions=P))
    np.testing.assert_array_equal(np.argwhere(agent.low.instruct(params, tree).avoid), [[2, 0]])
