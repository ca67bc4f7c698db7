"""What is learned from a rollout, against its steps replayed in plain Python."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import HighBatch, LowBatch, Step
from hrlspec.agent.low_level import TaskBook
from hrlspec.config import evolve
from hrlspec.methods import Ours
from tests.learning.rollouts import (
    AGENT,
    CONFIG,
    ENV,
    PLANNER,
    E,
    T,
    batches,
    log_probs,
    params,
    plan_all,
    position,
    rollouts,
)
from tests.learning.test_targets import low_reference, plan_reference
from tests.probes import quick_jit


@pytest.fixture
def t() -> Step:
    return rollouts()[2].trajectory


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
