"""Recorded episodes: as environment and monitor have them, step by step; what the high level makes of branches."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.agent.agent import Agent
from hrlspec.agent.networks.planner import PlannerConfig
from hrlspec.config import Config, NetworkConfig
from hrlspec.evaluation.episodes import trace_episodes
from hrlspec.evaluation.recording import Record, record_episodes
from hrlspec.methods import METHODS, OURS, ImplicitPlanner, Ours
from hrlspec.spec import RUNNING, SATISFIED, TaskTree, advance, compile_task, initial, parse
from hrlspec.spec.monitor import open_edges
from hrlspec.tasks.rewards import reward_machine
from tests.probes import random_params

SMALL = Config(
    network=NetworkConfig(latent=8, conv_channels=(), encoder_mlp=(8,), actor=(8,), critic=(8,), task_rounds=0)
)
SMALL_OURS = OURS.replace(network=PlannerConfig(features=8, hidden=8, rounds=0))
KEY = jax.random.key(3)
TASK = "(achieve a or (achieve b ensuring not c)); achieve d"


def tree_for(env: envs_jax.Environment, text: str, num_nodes: int = 8) -> TaskTree:
    tree = compile_task(parse(text), env.propositions, num_nodes)
    return jax.tree.map(lambda x: np.asarray(x)[None], tree)


def setting(env: envs_jax.Environment, method: Any, text: str) -> tuple[Any, ...]:
    """What three episodes in random layouts are made of."""
    agent = Agent(env, SMALL, method)
    layouts = jax.vmap(env.sample_layout, (0, None))(jax.random.split(KEY, 3), env.default_params)
    return KEY, agent, random_params(agent, 1), reward_machine(env.propositions), tree_for(env, text), layouts


@functools.cache
def recorded(env: envs_jax.Environment, method: Any, text: str) -> tuple[Any, Any, Record]:
    """How they ended, their layouts, and what went on."""
    how = setting(env, method, text)
    ended, record = jax.device_get(record_episodes(*how, which=np.zeros(3, int)))
    return ended, how[-1], record


@pytest.mark.parametrize("name", ["letter", pytest.param("walk", marks=pytest.mark.slow)])
def test_what_is_recorded_is_what_happens(name: str) -> None:
    env = envs_jax.make(name, horizon=20)
    assert isinstance(env, envs_jax.Drawable)
    ended, layouts, record = recorded(env, SMALL_OURS, TASK)
    tree = jax.tree.map(lambda x: jnp.asarray(x[0]), tree_for(env, TASK))
    step, position, holding, follow = map(jax.jit, (env.step_env, env.position, env.labels, advance))
    params = env.default_params
    moved = 0
    for i, steps in enumerate(ended.steps):
        _, state = env.reset_to(jax.tree.map(lambda x, i=i: x[i], layouts), jax.random.fold_in(KEY, i), params)
        task = initial(tree)
        for t in range(steps):
            before, after = (jax.tree.map(lambda x, t=t, i=i: x[t, i], x) for x in (record.before, record.after))
            np.testing.assert_allclose(before.position, position(state), atol=1e-6)
            np.testing.assert_array_equal(before.labels, holding(state, params))
            assert int(before.state.node) == int(task.node)
            _, state, *_ = step(KEY, state, record.action[t, i], params)
            labels = holding(state, params)
            task = follow(tree, task, labels, int(record.high.edge[t, i]))
            np.testing.assert_allclose(after.position, position(state), atol=1e-6)
            np.testing.assert_array_equal(after.labels, labels)
            np.testing.assert_array_equal(after.state.blocked, task.blocked)
            assert (int(after.state.node), int(after.state.status)) == (int(task.node), int(task.status))
            assert record.reward[t, i] == (task.status == SATISFIED)
            moved += int(after.state.node != before.state.node)
        assert steps == env.horizon or task.status != RUNNING
    assert moved or name == "walk"


def test_branches_have_probabilities_and_values_where_a_decision_is_made() -> None:
    env = envs_jax.make("letter", horizon=20)
    ended, _, record = recorded(env, SMALL_OURS, TASK)
    for i, steps in enumerate(ended.steps):
        high = jax.tree.map(lambda x, i=i, steps=steps: x[:steps, i], record.high)
        state = jax.tree.map(lambda x, i=i, steps=steps: x[:steps, i], record.before.state)
        tree = jax.tree.map(lambda x: np.asarray(x[0]), tree_for(env, TASK))
        assert high.made[0]
        assert high.open[0].tolist() == np.asarray(open_edges(tree, jax.tree.map(lambda x: x[0], state))).tolist()
        for t in np.flatnonzero(high.made):
            assert high.open[t, high.edge[t]]
            np.testing.assert_allclose(high.probability[t].sum(), 1, rtol=1e-5)
            assert not high.probability[t, ~high.open[t]].any()
            assert not high.worth[t, ~high.open[t]].any()
            if high.open[t].sum() == 1:  # alone is as it is
                np.testing.assert_allclose(high.worth[t, high.edge[t]], high.value[t], rtol=1e-5)


@pytest.mark.slow
def test_a_branch_alone_is_worth_what_the_task_of_that_branch_is() -> None:
    """By a planner that values paths each for itself, of which the best is the task's value."""
    env = envs_jax.make("letter", horizon=3)
    method = Ours(high=ImplicitPlanner(values_paths=True))
    _, _, record = recorded(env, method, "achieve a or achieve b")
    both = record.high.worth[0]
    np.testing.assert_allclose(both[:, 1:3].max(1), record.high.value[0], rtol=1e-5)
    assert (both[:, 1] != both[:, 2]).all()
    for branch, text in ((1, "achieve a ensuring not b"), (2, "achieve b ensuring not a")):
        _, _, alone = recorded(env, method, text)
        np.testing.assert_allclose(alone.high.value[0], both[:, branch], rtol=1e-5)


def test_an_episode_that_is_recorded_goes_as_it_does_otherwise() -> None:
    env, method = envs_jax.make("letter", horizon=12), METHODS["ltl2action"]
    ended, _, record = recorded(env, method, TASK)
    traced, trace = jax.device_get(trace_episodes(*setting(env, method, TASK), which=np.zeros(3, int)))
    jax.tree.map(np.testing.assert_array_equal, ended, traced)
    np.testing.assert_array_equal(record.running, trace.running)
    np.testing.assert_array_equal(record.before.position, trace.env_state.position)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["option", "ltl2action"])
def test_other_methods_are_recorded(name: str) -> None:
    env = envs_jax.make("letter", horizon=12)
    _, _, record = recorded(env, METHODS[name], TASK)
    assert np.isfinite(record.value).all()
    assert (record.high.edge[0] == TaskTree.ROOT).all() == (name == "ltl2action")  # which assigns none
