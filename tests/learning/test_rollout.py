"""A rollout, replayed step by step in plain Python."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import Step
from hrlspec.agent.low_level import TaskBook
from hrlspec.config import evolve
from hrlspec.learning.reach import reach_batch
from hrlspec.learning.rollout import RETRIED, Collector, Pool, Setting, collect, fill_pool
from hrlspec.learning.train import Trainer
from hrlspec.methods import LTL2ACTION
from hrlspec.spec import TaskState
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import reward_machine
from tests.agent.test_agent import read_shield
from tests.learning.rollouts import (
    AGENT,
    CONFIG,
    ENV,
    RULES,
    E,
    T,
    flat,
    log_probs,
    params,
    plan_all,
    position,
    rollouts,
    tree_of_row,
    ways,
)
from tests.probes import on_device, pairs, quick_jit, read_monitor, small_agent, small_config
from tests.tasks.test_rewards import reference as read_rewards


@pytest.fixture
def book() -> TaskBook:
    return rollouts()[0]


@pytest.fixture
def t() -> Step:
    return rollouts()[2].trajectory


def test_the_sample_is_rich(t: Step) -> None:
    assert t.outcome.terminated.sum() > 10
    assert t.outcome.truncated.sum() > 5
    assert t.outcome.satisfied.sum() > 5
    assert (t.outcome.terminated & ~t.outcome.satisfied).any()
    assert t.low.shielded.sum() > 5
    assert t.low.shielded.mean() < 0.5
    assert (t.outcome.labels.sum(-1) > 1).any()
    assert t.state.blocked.any()
    assert rollouts()[1].trajectory.outcome.reward.max() >= 5
    assert t.high.made[0].any()
    assert not t.high.made[0].all()
    assert set(t.level.ravel()) == {0, 1, 2}


def test_the_world_moves_as_it_says(t: Step) -> None:
    here = position(t.view)
    there = np.clip(here + 2 * t.low.action - 1, 0, len(ENV.cells) - 1)
    np.testing.assert_array_equal(t.outcome.labels, ENV.table[there])
    ended = t.outcome.terminated | t.outcome.truncated
    going_on = ~ended[:-1]
    np.testing.assert_array_equal(here[1:][going_on], there[:-1][going_on])
    assert np.isin(here[1:][~going_on], ENV.starts).all()
    assert len(set(here[1:][~going_on])) == 3
    assert not (t.outcome.terminated & t.outcome.truncated).any()
    np.testing.assert_array_equal(t.episode, np.cumsum(ended, 0) - ended)


def test_episodes_last_no_longer_than_the_horizon() -> None:
    """Over both rollouts; a truncated one lasts exactly that long."""
    _, first, second = rollouts()
    both = jax.tree.map(lambda *x: np.concatenate(x), first.trajectory, second.trajectory)
    for e in range(E):
        length = 0
        for step in range(2 * T):
            length += 1
            assert length <= ENV.horizon
            assert both.outcome.truncated[step, e] == (length == ENV.horizon and not both.outcome.terminated[step, e])
            if both.outcome.terminated[step, e] or both.outcome.truncated[step, e]:
                length = 0


def test_labels_replay_through_the_monitor() -> None:
    """Tasks, nodes, blocked edges, edges taken, ends and rewards; nothing survives the end of an episode."""
    book, first, second = rollouts()
    both = jax.tree.map(lambda *x: np.concatenate(x), first.trajectory, second.trajectory)
    for e in range(E):
        steps: list[int] = []
        node, blocked = 0, set()
        for s in range(2 * T):
            if not steps:
                task, node, blocked = both.task[s, e], 0, set()
                assert task < E if s == 0 else (task - E) // 32 == both.level[s, e]
            steps.append(s)
            assert (both.task[s, e], both.state.node[s, e], pairs(both.state.blocked[s, e])) == (task, node, blocked)
            tree = tree_of_row(book, task)
            assert tree.parent[both.high.edge[s, e]] == node
            assert both.high.edge[s, e] not in blocked
            before = node
            labels, edge = pairs(both.outcome.labels[s, e]), both.high.edge[s, e]
            node, blocked, status = read_monitor(tree, node, blocked, labels, edge)
            assert (both.outcome.node[s, e], both.outcome.edge_taken[s, e]) == (node, node != before)
            assert both.outcome.satisfied[s, e] == (status == "satisfied")
            assert both.outcome.terminated[s, e] == (status != "running")
            if both.outcome.terminated[s, e] or both.outcome.truncated[s, e]:
                reached = tree.reach[both.outcome.node[steps, e]]
                taken, done = both.outcome.edge_taken[steps, e], both.outcome.satisfied[steps, e]
                expected = read_rewards(RULES, 1.0, 0.5, both.outcome.labels[steps, e], reached, taken, done)
                np.testing.assert_allclose(both.outcome.reward[steps, e], expected)
                steps = []


def test_decisions_where_they_are_due_and_only_there() -> None:
    book, first, second = rollouts()
    both = jax.tree.map(lambda *x: np.concatenate(x), first.trajectory, second.trajectory)
    due = np.ones((2 * T, E), bool)
    for s in range(1, 2 * T):
        for e in range(E):
            ended = both.outcome.terminated[s - 1, e] or both.outcome.truncated[s - 1, e]
            lost = not both.outcome.edge_taken[s - 1, e] and bool(
                book.tree.avoid[both.task[s - 1, e], both.high.edge[s - 1, e]] @ both.outcome.labels[s - 1, e]
            )
            due[s, e] = ended or both.outcome.edge_taken[s - 1, e] or lost
            if not due[s, e]:
                assert both.high.edge[s, e] == both.high.edge[s - 1, e]
            assert both.since[s, e] == (0 if due[s, e] else both.since[s - 1, e] + 1)
    np.testing.assert_array_equal(both.high.made, due)
    assert 0.1 < due.mean() < 0.9


def test_what_lies_ahead_is_a_way_to_a_leaf(book: TaskBook, t: Step) -> None:
    """Or, of an edge that was not advised on, everything that lies ahead; and it stays until the next decision."""
    plans = 0
    for s, e in np.ndindex(T, E):
        tree, edge = tree_of_row(book, t.task[s, e]), t.high.edge[s, e]
        ways = []
        for leaf in np.flatnonzero(tree.accepting):
            way = [leaf]
            while way[0] not in (0, edge):
                way.insert(0, tree.parent[way[0]])
            if way[0] == edge:
                ways.append(np.array([*tree.reach[way[1:3]], *np.zeros((2, 4), bool)])[:2])
        everything = np.asarray(book.instructions.ahead[t.task[s, e], edge], bool)
        assert any((t.high.ahead[s, e] == way).all() for way in [*ways, everything])
        plans += not (t.high.ahead[s, e] == everything).all()
        if s and not t.high.made[s, e]:
            np.testing.assert_array_equal(t.high.ahead[s, e], t.high.ahead[s - 1, e])
    assert plans > 0


@quick_jit
def control(params: Any, view: Any, instruction: Any) -> Any:
    return jax.vmap(AGENT.low.control, (None, 0, 0))(params, view, instruction)


def test_actions_values_and_the_shield(book: TaskBook, t: Step) -> None:
    instruction = jax.tree.map(lambda x: x[t.task.ravel(), t.high.edge.ravel()], book.instructions)
    instruction = dataclasses.replace(instruction, ahead=flat(t.high.ahead))
    logits, value = control(params(), flat(t.view), instruction)
    own = ~t.low.shielded.ravel()
    np.testing.assert_allclose(t.low.log_prob.ravel()[own], log_probs(logits, t.low.action.ravel())[own], atol=1e-5)
    np.testing.assert_allclose(t.low.value.ravel(), value, atol=1e-5)
    q = np.asarray(quick_jit(jax.vmap(AGENT.low.reach_values, (None, 0)))(params(), flat(t.view)))
    for i in range(T * E):
        forbidden, action = pairs(instruction.avoid[i]), int(t.low.action.ravel()[i])
        shielded = t.low.shielded.ravel()[i]
        # Of two actions the shield replaced the other one; an action that stands is one that the rule lets stand.
        meant = 1 - action if shielded else action
        assert read_shield(CONFIG.shield.threshold, q[i], forbidden, meant) == action
        if shielded:
            np.testing.assert_allclose(
                t.low.log_prob.ravel()[i], log_probs(logits[i][None], np.array([meant]))[0], atol=1e-5
            )


def test_reach_values_are_of_the_state_after_the_step(t: Step) -> None:
    """Also where the episode ended there, and the next one's first state is what is seen next."""
    value = np.asarray(quick_jit(jax.vmap(AGENT.low.reach_values, (None, 0)))(params(), flat(t.view))).max(-1)
    value = value.reshape(T, E, -1)
    goes_on = ~(t.outcome.terminated | t.outcome.truncated)[:-1]
    np.testing.assert_allclose(t.reach_value[:-1][goes_on], value[1:][goes_on], atol=1e-5)
    assert (np.abs(t.reach_value[:-1] - value[1:])[~goes_on] > 1e-3).any()


def test_the_reach_critic_learns_from_every_transition(t: Step) -> None:
    """1 where a letter holds after the step, else the discounted value of the next state, also where a task ends."""
    batch = jax.tree.map(np.asarray, reach_batch(AGENT.low, on_device(t)))
    assert batch.target.shape == (E, T, len(ENV.propositions))
    for s, e in np.ndindex(T, E):
        held = pairs(t.outcome.labels[s, e])
        expected = [
            1.0 if p in held else CONFIG.shield.discount * float(t.reach_value[s, e, p])
            for p in range(len(ENV.propositions))
        ]
        np.testing.assert_allclose(batch.target[e, s], expected, rtol=1e-5, atol=1e-6)
        assert batch.action[e, s] == t.low.action[s, e]
        jax.tree.map(lambda x, y, s=s, e=e: np.testing.assert_array_equal(x[e, s], y[s, e]), batch.view, t.view)
    assert t.outcome.terminated.any()


def states(t: Step, node: np.ndarray, blocked: np.ndarray) -> TaskState:
    return TaskState(node=node.ravel(), blocked=blocked.reshape(T * E, -1), status=np.zeros(T * E, np.int32))


def test_decisions_log_probabilities_and_values(book: TaskBook, t: Step) -> None:
    trees = jax.tree.map(lambda x: x[t.task.ravel()], book.tree)
    logits, value = plan_all(params(), flat(t.view), trees, states(t, t.state.node, t.state.blocked))
    made = t.high.made.ravel()
    expected = log_probs(logits, t.high.edge.ravel())[made]
    np.testing.assert_allclose(t.high.log_prob.ravel()[made], expected, atol=1e-5)
    # Where one way is left to the end, V^h is what the low level expects of it.
    nodes, lost = t.state.node.ravel(), t.state.blocked.reshape(T * E, -1)
    at = zip(t.task.ravel(), nodes, lost, strict=True)
    one_way = np.array([ways(tree_of_row(book, task), node, gone) == 1 for task, node, gone in at])
    worth = np.where(one_way, t.low.value.ravel(), np.asarray(value))
    np.testing.assert_allclose(t.high.value.ravel()[made], worth[made], atol=1e-5)
    assert 10 < (made & one_way).sum() < made.sum() - 10
    assert (expected < -0.1).sum() > 10  # there were choices


def test_cut_episodes_bootstrap_with_the_state_they_were_cut_in(book: TaskBook, t: Step) -> None:
    """Truncated ones and the rollout's last step: the value of what would have come next, not of the next episode."""
    trees = jax.tree.map(lambda x: x[t.task.ravel()], book.tree)
    there = np.clip(position(t.view) + 2 * t.low.action - 1, 0, len(ENV.cells) - 1)
    blocked = np.zeros_like(t.state.blocked)
    for s, e in np.ndindex(T, E):
        tree = tree_of_row(book, t.task[s, e])
        arguments = (
            int(t.state.node[s, e]),
            pairs(t.state.blocked[s, e]),
            pairs(t.outcome.labels[s, e]),
            int(t.high.edge[s, e]),
        )
        blocked[s, e, list(read_monitor(tree, *arguments)[1])] = True
    _, value = plan_all(
        params(), flat(jax.tree.map(np.asarray, ENV.view_at(there))), trees, states(t, t.outcome.node, blocked)
    )
    value = np.asarray(value).reshape(T, E)
    for bootstrap in (t.bootstrap.low, t.bootstrap.high):
        np.testing.assert_allclose(bootstrap[t.outcome.truncated], value[t.outcome.truncated], atol=1e-5)
    going_on = ~(t.outcome.terminated | t.outcome.truncated)[-1]
    assert going_on.sum() > 5
    after = rollouts()[2].after.worker
    instruction = jax.tree.map(lambda x: x[after.task, after.decision.edge], book.instructions)
    instruction = jax.tree.map(
        lambda x: np.repeat(x, T, 0), dataclasses.replace(instruction, ahead=after.decision.ahead)
    )
    views = jax.tree.map(lambda x: np.repeat(x, T, 0), after.view)
    low = np.asarray(control(params(), views, instruction)[1])[::T]
    np.testing.assert_allclose(t.bootstrap.low[-1][going_on], low[going_on], atol=1e-5)
    at = zip(after.task, after.task_state.node, after.task_state.blocked, strict=True)
    one_way = np.array([ways(tree_of_row(book, task), node, lost) == 1 for task, node, lost in at])
    high = np.where(one_way, low, value[-1])
    np.testing.assert_allclose(t.bootstrap.high[-1][going_on], high[going_on], atol=1e-5)
    assert 0 < one_way[going_on].sum() < going_on.sum()


def begun(agent: Agent, size: int) -> tuple[Setting, Collector]:
    """An untrained agent with its first episodes, and a pool of ``size`` for each environment."""
    rewards = reward_machine(agent.env.propositions)
    bank = on_device(
        draw_bank(np.random.default_rng(0), agent.config.curriculum, agent.env.num_propositions, np.zeros(0, np.uint32))
    )
    state = Trainer(agent).init(jax.random.key(0), bank, rewards)
    book = agent.low.prepare(state.params, jax.tree.map(lambda *x: jnp.concatenate(x), state.tasks, bank))
    envs = jnp.arange(agent.config.num_envs, dtype=jnp.int32)
    pool = fill_pool(jax.random.key(1), agent, book, jnp.int32(0), envs, size=size)
    return Setting(agent, state.params, rewards, book, pool, envs), state.collector


def test_noise_is_as_correlated_as_it_is_asked_to_be() -> None:
    """An untrained policy of continuous actions is nothing but noise."""
    config = evolve(small_config(num_steps=64), {"shield.enabled": False})
    agent = small_agent(envs_jax.make("walk"), config, LTL2ACTION)

    @quick_jit
    def actions(correlation: jax.Array) -> jax.Array:
        return collect(jax.random.key(2), *begun(agent, 2), correlation)[1].low.action

    for correlation in (0.0, 0.9):
        drawn = np.asarray(actions(jnp.float32(correlation)))
        assert (drawn[1:] * drawn[:-1]).mean() / (drawn**2).mean() == pytest.approx(correlation, abs=0.08)


def test_half_of_the_failed_episodes_are_begun_again() -> None:
    """With the same task in the same place; all others are the pool's, in turn."""
    config = evolve(small_config(num_steps=64), {"shield.enabled": False, "curriculum.retry": 0.5})
    agent = small_agent(ENV, config, LTL2ACTION)

    @quick_jit
    def rolled() -> tuple[Step, Pool, Any]:
        setting, collector = begun(agent, 3)
        return collect(jax.random.key(2), setting, collector, 0.0)[1], setting.pool, collector.layout

    t, pool, layout = jax.tree.map(np.asarray, rolled())
    places, again, failed = position(t.view), 0, 0
    for env in range(config.num_envs):
        task, start = t.task[0, env], layout.start[env]
        for number, end in enumerate(np.flatnonzero((t.outcome.terminated | t.outcome.truncated)[:-1, env])):
            failed += not t.outcome.satisfied[end, env]
            if t.level[end + 1, env] == RETRIED:
                assert not t.outcome.satisfied[end, env]
                again += 1
            else:
                task, start = pool.task[env, number % 3], pool.layout.start[env, number % 3]
            assert (t.task[end + 1, env], places[end + 1, env]) == (task, start)
    assert failed > 100
    assert again / failed == pytest.approx(0.5, abs=0.15)
