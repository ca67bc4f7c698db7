"""A rollout, and the batches made of it, replayed step by step in plain Python."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import HighBatch, LowBatch, Step
from hrlspec.agent.interaction import assign, start
from hrlspec.agent.low_level import TaskBook
from hrlspec.config import CurriculumConfig, RelabelConfig, evolve
from hrlspec.learning.batch import high_batch, low_batch
from hrlspec.learning.experience import gather
from hrlspec.learning.reach import reach_batch
from hrlspec.learning.rollout import Collector, Setting, collect, fill_pool
from hrlspec.learning.train import Trainer
from hrlspec.methods import LTL2ACTION, Ours
from hrlspec.spec import TaskState, TaskTree
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine
from tests.agent.test_agent import read_shield
from tests.learning.test_targets import low_reference, plan_reference
from tests.probes import (
    Corridor,
    on_device,
    pairs,
    quick_jit,
    random_params,
    read_monitor,
    small_agent,
    small_config,
    small_planner,
)
from tests.tasks.test_rewards import reference as read_rewards

# Letters everywhere, two of them together, and a short horizon: many episodes that end in every way.
ENV = Corridor(cells=("a", "", "bc", "", "d", "", ""), starts=(1, 3, 5), horizon=9)
CONFIG = small_config(
    num_steps=48,
    curriculum=CurriculumConfig(levels=3, tasks_per_level=32, max_nodes=8, tree_share=0.5),
    shield=evolve(small_config().shield, {"threshold": 0.6}),
    relabel=RelabelConfig(share=1.0),
)
PLANNER = small_planner(network__advice=1.0, advised=3, learns_unfinished=True)
AGENT = Agent(ENV, CONFIG, Ours(high=PLANNER))
E, T = CONFIG.num_envs, CONFIG.num_steps
RULES = [Bonus("a", "d", 5.0), Bonus("b", "d", 10.0, ("a",))]
LEVEL = 2


class Rollout(NamedTuple):
    """One rollout; ``carried`` says which decisions were made at the end of the one before."""

    trajectory: Step
    low: LowBatch
    plan: HighBatch
    after: Collector


@quick_jit
def prepare(params: Any, bank: TaskTree, key: jax.Array) -> tuple[TaskBook, Collector]:
    tasks = jax.tree.map(lambda x: x[:E], bank)
    book = AGENT.low.prepare(params, jax.tree.map(lambda *x: jnp.concatenate(x), tasks, bank))
    layouts = jax.vmap(ENV.sample_layout, (0, None))(jax.random.split(key, E), ENV.default_params)
    worker = start(jax.random.split(key, E), ENV, machine(), book, layouts, jnp.arange(E))
    worker = assign(AGENT, params, book, worker, jnp.zeros((E, 8)))
    zeros = jnp.zeros(E, jnp.int32)
    return book, Collector(worker=worker, level=zeros, started=zeros, since=zeros)


def batches(agent: Agent, key: jax.Array, params: Any, book: TaskBook, steps: Step) -> tuple[LowBatch, HighBatch]:
    """What an iteration learns from."""
    relabel_key, pick_key = jax.random.split(key)
    blocks = gather(relabel_key, agent, params, machine(), book, steps, jnp.zeros(1, jnp.uint32), jnp.arange(E))
    experience = jax.tree.map(lambda x: x[0], blocks)
    assert agent.high.ppo is not None
    return low_batch(agent, params, experience), high_batch(pick_key, agent, experience, agent.high.ppo)


@quick_jit
@chex.assert_max_traces(n=1)
def roll(params: Any, book: TaskBook, collector: Collector, key: jax.Array) -> Rollout:
    keys = jax.random.split(key, 3)
    envs = jnp.arange(E, dtype=jnp.int32)
    pool = fill_pool(keys[0], AGENT, book, jnp.int32(LEVEL), envs, size=12)
    after, trajectory = collect(keys[1], Setting(AGENT, params, machine(), book, pool, envs), collector, 0.0)
    return Rollout(trajectory, *batches(AGENT, keys[2], params, book, trajectory), after)


def machine() -> RewardMachine:
    return reward_machine(ENV.propositions, subtask=0.5, bonuses=RULES)


@functools.cache
def params() -> Any:
    return random_params(AGENT, 3)


@functools.cache
def rollouts() -> tuple[TaskBook, Rollout, Rollout]:
    """Two in a row; the tests look at the second, which begins and ends in the middle of episodes."""
    bank = draw_bank(np.random.default_rng(0), CONFIG.curriculum, 4, np.zeros(0, np.uint32))
    book, collector = prepare(params(), bank, jax.random.key(0))
    first = roll(params(), book, collector, jax.random.key(1))
    second = roll(params(), book, first.after, jax.random.key(2))
    return jax.tree.map(np.asarray, (book, first, second))


@pytest.fixture
def book() -> TaskBook:
    return rollouts()[0]


@pytest.fixture
def t() -> Step:
    return rollouts()[2].trajectory


def ways(tree: TaskTree, node: int, lost: Any = None) -> int:
    """How many paths to a leaf are open; those that begin with a lost edge are not."""
    children = [i for i in np.flatnonzero(tree.parent == node) if tree.valid[i] and (lost is None or not lost[i])]
    return sum(ways(tree, i) for i in children) or int(tree.accepting[node])


def tree_of_row(book: TaskBook, row: int) -> TaskTree:
    return jax.tree.map(lambda x: x[row], book.tree)


def position(view: Any) -> np.ndarray:
    return view[1].argmax(-1)


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


def flat(x: Any) -> Any:
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), x)


@quick_jit
def control(params: Any, view: Any, instruction: Any) -> Any:
    return jax.vmap(AGENT.low.control, (None, 0, 0))(params, view, instruction)


@quick_jit
def plan_all(params: Any, view: Any, tree: TaskTree, state: TaskState) -> Any:
    instruction = jax.vmap(AGENT.low.instruct, (None, 0))(params, tree)
    choice = AGENT.high.choose(AGENT.low, params, view, tree, state, instruction)
    return choice.logits, choice.value


def log_probs(logits: Any, choice: np.ndarray) -> np.ndarray:
    return np.take_along_axis(np.asarray(jax.nn.log_softmax(logits)), choice[:, None], 1)[:, 0]


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


# --- Batches ---


def in_time(t: Step) -> dict[str, np.ndarray]:
    ends = {name: getattr(t.outcome, name) for name in ("reward", "terminated", "truncated")}
    return {**ends, "value": t.low.value, "decided": t.high.made, "high_value": t.high.value}


def test_targets_of_the_originals_equal_the_reference(t: Step) -> None:
    low = rollouts()[2].low
    expected = low_reference({**in_time(t), "bootstrap": t.bootstrap.low}, 0.9, 0.95, True).T
    credit = low.credit
    valid = credit.valid[:E]
    np.testing.assert_allclose(credit.target[:E][valid], expected[valid], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(credit.advantage[:E], credit.target[:E] - t.low.value.T, atol=1e-5)
    np.testing.assert_array_equal(valid, (t.episode < max(2, T // 5)).T)
    np.testing.assert_array_equal(credit.learns[:E], valid & ~t.low.shielded.T)


@quick_jit
def low_log_probs(params: Any, low: LowBatch) -> jax.Array:
    instruction = jax.vmap(jax.vmap(AGENT.low.instruct, (None, 0)), (None, 0))(params, low.trees)
    row = jnp.arange(low.slot.shape[0])[:, None]
    instruction = jax.tree.map(lambda x: x[row, low.slot, low.edge], instruction)
    instruction = dataclasses.replace(instruction, ahead=low.ahead)
    logits, _ = jax.vmap(jax.vmap(AGENT.low.respond, (None, 0, 0)), (None, 0, 0))(params, low.sight, instruction)
    return jnp.take_along_axis(jax.nn.log_softmax(logits), low.decision.action[..., None], -1)[..., 0]


def test_ratios_are_one_at_the_start_of_the_update() -> None:
    """For what was not relabelled, at both levels."""
    _, _, rollout = rollouts()
    low, plan = rollout.low, rollout.plan
    now = np.asarray(low_log_probs(params(), low))
    learns = low.credit.learns & (np.arange(2 * E) < E)[:, None]
    np.testing.assert_allclose(now[learns], low.decision.log_prob[learns], atol=1e-5)
    assert learns.sum() > 30
    logits, _ = plan_all(params(), plan.view, plan.tree, plan.state)
    recomputed, chosen = log_probs(logits, plan.decision.edge), plan.credit.valid & (plan.decision.log_prob != 0)
    np.testing.assert_allclose(recomputed[chosen], plan.decision.log_prob[chosen], atol=1e-5)
    assert chosen.sum() > 10
    assert (recomputed[chosen] < -0.1).sum() > 5


def test_copies_keep_the_probability_that_their_actions_were_drawn_with(t: Step) -> None:
    low, plan = rollouts()[2].low, rollouts()[2].plan
    copied = [next(e for e in range(E) if (low.sight.shared[E + i] == low.sight.shared[e]).all()) for i in range(E)]
    assert sorted(copied) == list(range(E))
    np.testing.assert_array_equal(low.decision.log_prob[E:], t.low.log_prob.T[copied])
    # The path of a copy is what happened: it was no choice. All other decisions are the rollout's.
    drawn = plan.decision.log_prob[plan.credit.valid & (plan.decision.log_prob != 0)]
    assert 0 < len(drawn) < plan.credit.valid.sum()
    assert np.isin(drawn, t.high.log_prob).all()


def test_planner_samples_are_decisions_with_their_targets(t: Step) -> None:
    """Every sample of an original is one of the decisions of the reference, with its advantage."""
    credit = rollouts()[2].plan.credit
    known = plan_reference_of(t)
    found = 0
    for b in np.flatnonzero(credit.valid):
        key = round(float(credit.advantage[b]), 3), round(float(credit.target[b]), 3)
        found += any(abs(key[0] - a) < 2e-3 and abs(key[1] - g) < 2e-3 for a, g in known)
    assert found >= 0.4 * credit.valid.sum()


def plan_reference_of(t: Step) -> list[tuple[float, float]]:
    x = {**in_time(t), "bootstrap": t.bootstrap.high}
    advantages = plan_reference(x, 0.9, 0.95)
    return [(a, a + float(t.high.value[where])) for where, a in advantages.items()]


def test_transe_pairs_lead_from_a_decision_to_where_its_sub_task_was_completed() -> None:
    plan = rollouts()[2].plan
    pairs_ = np.flatnonzero(plan.credit.valid & plan.completed)
    assert len(pairs_) > 10
    here, there = position(plan.view), position(plan.next_view)
    for b in pairs_:
        assert plan.reached[b].any()
        assert (ENV.table[there[b]] >= plan.reached[b]).all()
        edges = [k for k in range(8) if plan.tree.parent[b, k] == plan.state.node[b] and plan.tree.valid[b, k]]
        assert any((plan.tree.reach[b, k] == plan.reached[b]).all() for k in edges)
        assert plan.decision.edge[b] in edges
        assert abs(int(here[b]) - int(there[b])) <= ENV.horizon


def test_without_unfinished_every_sample_was_completed() -> None:
    """The paper's planner data: sub-tasks that were not completed are left out."""
    _, _, rollout = rollouts()
    t = rollout.trajectory
    planner = dataclasses.replace(PLANNER, learns_unfinished=False)
    agent = Agent(ENV, evolve(CONFIG, {"relabel.share": 0.0}), Ours(high=planner))
    bank = rollouts()[0]

    @quick_jit
    def rebuild(book: TaskBook, t: Step) -> HighBatch:
        return batches(agent, jax.random.key(0), params(), book, t)[1]

    plan = jax.tree.map(np.asarray, rebuild(bank, t))
    completed = 0
    for e in range(E):
        for s in np.flatnonzero(t.high.made[:, e] & (t.episode[:, e] < max(2, T // 5))):
            end = s
            o = t.outcome
            ends = o.edge_taken | o.terminated | o.truncated
            while end < T - 1 and not ends[end, e] and not t.high.made[end + 1, e]:
                end += 1
            completed += bool(o.edge_taken[end, e])
    assert plan.credit.valid.sum() == min(completed, len(plan.credit.valid))
    assert 0 < completed < t.high.made.sum()


def test_noise_is_as_correlated_as_it_is_asked_to_be() -> None:
    """An untrained policy of continuous actions is nothing but noise."""
    env = envs_jax.make("walk")
    agent = small_agent(env, evolve(small_config(num_steps=64), {"shield.enabled": False}), LTL2ACTION)
    rewards = reward_machine(env.propositions)
    bank = on_device(draw_bank(np.random.default_rng(0), agent.config.curriculum, 5, np.zeros(0, np.uint32)))

    @quick_jit
    def actions(correlation: jax.Array) -> jax.Array:
        state = Trainer(agent).init(jax.random.key(0), bank, rewards)
        book = agent.low.prepare(state.params, jax.tree.map(lambda *x: jnp.concatenate(x), state.tasks, bank))
        envs = jnp.arange(agent.config.num_envs, dtype=jnp.int32)
        pool = fill_pool(jax.random.key(1), agent, book, jnp.int32(0), envs, size=2)
        setting = Setting(agent, state.params, rewards, book, pool, envs)
        return collect(jax.random.key(2), setting, state.collector, correlation)[1].low.action

    for correlation in (0.0, 0.9):
        drawn = np.asarray(actions(jnp.float32(correlation)))
        assert (drawn[1:] * drawn[:-1]).mean() / (drawn**2).mean() == pytest.approx(correlation, abs=0.08)
