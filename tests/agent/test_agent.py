"""Sampling, the shield, grouping, and what the agent prepares of its tasks."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.agent import groups
from hrlspec.agent.agent import Agent
from hrlspec.agent.distributions import Categorical
from hrlspec.agent.experience import View
from hrlspec.agent.groups import if_any, in_groups
from hrlspec.agent.low_level import LowLevel
from hrlspec.agent.shield import shielded_action
from hrlspec.methods import MyopicLow
from hrlspec.spec import TaskTree
from tests.probes import Corridor, on_device, pairs, quick_jit, random_params, small_agent, small_config, small_planner
from tests.trees import random_tree

P, A = 5, 4


@pytest.mark.parametrize(
    ("backend", "group", "at_a_time"),
    [("cpu", 1, 1), ("cpu", 3, 3), ("cpu", 8, 8), ("cpu", 50, 20), ("an accelerator", 3, 7), ("with room", 3, 20)],
)
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_groups_compute_for_those_in_need_and_keep_the_rest(
    backend: str, group: int, at_a_time: int, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setattr(groups, "AT_ONCE", 20 if backend == "with room" else 7)
    rng = np.random.default_rng(group)
    needed = rng.random(20) < share
    inputs = {"x": rng.normal(size=(20, 3)).astype(np.float32), "i": np.arange(20)}
    kept = on_device((-np.ones(20, np.float32), -np.ones((20, 2), np.int32)))

    def function(x: Any) -> Any:
        assert x["x"].shape == (at_a_time, 3)
        return x["x"].sum(-1), jnp.stack([x["i"], 2 * x["i"]], -1)

    sums, pairs_ = in_groups(function, jnp.asarray(needed), on_device(inputs), kept, group)
    np.testing.assert_allclose(sums, np.where(needed, inputs["x"].sum(-1), -1), rtol=1e-5, atol=1e-6)
    expected = np.stack([inputs["i"], 2 * inputs["i"]], -1)
    np.testing.assert_array_equal(pairs_, np.where(needed[:, None], expected, -1))


@pytest.mark.parametrize("backend", ["cpu", "an accelerator"])
@pytest.mark.parametrize("needed", [(False, False, False), (False, True, False), (True, True, True)])
def test_what_none_needs_is_not_computed_on_a_cpu(
    backend: str, needed: tuple[bool, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    calls: list[int] = []

    def function() -> jax.Array:
        jax.debug.callback(lambda: calls.append(1))
        return jnp.arange(3.0)

    found = if_any(function, jnp.asarray(needed), -jnp.ones(3))
    jax.effects_barrier()
    np.testing.assert_array_equal(found, np.where(needed, np.arange(3.0), -1))
    assert len(calls) == (backend != "cpu" or any(needed))


def read_shield(threshold: float, q: np.ndarray, avoid: set[int], action: int) -> int:
    """The paper's rule, in plain Python."""
    if not avoid:
        return action
    nearest = max(avoid, key=lambda g: (max(q[g]), -g))
    return int(np.argmin(q[nearest])) if max(q[nearest]) > threshold else action


class Scripted(LowLevel):
    """Four actions, and Q values that are seen instead of learned."""

    actions = Categorical(A)  # type: ignore[assignment]

    def reach_values(self, params: Any, view: View) -> jax.Array:
        return view.propositions


def test_shield_follows_its_rule() -> None:
    rng = np.random.default_rng(0)
    replaced = 0
    low = Scripted(Corridor(), small_config(), "future", follows_plan=False)

    def act(q: jax.Array, avoid: jax.Array, action: jax.Array) -> jax.Array:
        return shielded_action(low, low.reach_values({}, View(q, jnp.zeros(0))), avoid, action)

    compiled = quick_jit(jax.vmap(act))
    q, avoid = rng.random((500, P, A)) ** 0.3, rng.random((500, P)) < 0.3
    action = rng.integers(A, size=500).astype(np.int32)
    result = compiled(q.astype(np.float32), avoid, action)
    assert result.dtype == jnp.int32
    for i in range(500):
        assert int(result[i]) == read_shield(0.9, q[i], pairs(avoid[i]), int(action[i]))
        replaced += int(result[i]) != action[i]
    assert replaced > 100


@pytest.fixture(scope="module")
def agent() -> Agent:
    return small_agent(Corridor())


@pytest.fixture(scope="module")
def trees() -> TaskTree:
    rng = np.random.default_rng(5)
    many = [random_tree(rng, num_nodes=6, num_propositions=4, most_together=2, distinct=True) for _ in range(20)]
    return on_device(jax.tree.map(lambda *x: np.stack(x), *many))


def test_the_book_holds_each_sub_tasks_avoid_set(agent: Agent, trees: TaskTree) -> None:
    params = random_params(agent, 0)
    book = quick_jit(agent.low.prepare)(params, trees)
    instruct = quick_jit(agent.low.instruct)
    for m in range(20):
        tree = jax.tree.map(lambda x, m=m: x[m], trees)
        alone = instruct(params, tree)
        jax.tree.map(lambda x, y, m=m: np.testing.assert_allclose(x[m], y, atol=1e-5), book.instructions, alone)
        np.testing.assert_array_equal(book.instructions.reach[m], tree.reach)
        for k in range(6):
            siblings = [j for j in range(6) if tree.valid[j] and tree.parent[j] == tree.parent[k] >= 0 and j != k]
            reached = set().union(*(pairs(tree.reach[j]) for j in siblings))
            expected = pairs(tree.avoid[k]) | (reached - pairs(tree.reach[k])) if tree.valid[k] else set()
            assert pairs(book.instructions.avoid[m, k]) == expected


def test_myopic_low_sees_nothing_of_the_future(trees: TaskTree) -> None:
    agent, sighted = small_agent(Corridor(), method=MyopicLow(high=small_planner())), small_agent(Corridor())
    params = random_params(agent, 0)
    for name, instruction in (
        ("myopic", quick_jit(agent.low.prepare)(params, trees).instructions),
        ("ours", sighted.low.prepare(params, trees).instructions),
    ):
        assert np.asarray(instruction.reach).any()
        assert np.asarray(instruction.avoid).any()
        for future in (instruction.future, instruction.ahead):
            assert np.asarray(future).any() == (name == "ours")
