"""Paths on from where a task stands, and a planner that values each of them by itself."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.agent.agent import Agent
from hrlspec.agent.distributions import MASKED
from hrlspec.agent.experience import Credit, HighBatch, View, undecided
from hrlspec.agent.high_level import Choice
from hrlspec.agent.networks.controller import Instruction
from hrlspec.config import evolve
from hrlspec.methods import Ours
from hrlspec.methods.paths import Paths, best_of_edges, open_paths, sequence
from hrlspec.spec import TaskState, TaskTree, initial, open_edges, subtask_avoid
from tests.probes import Corridor, on_device, quick_jit, random_params, small_config, small_planner
from tests.trees import random_tree, tree_of

ENV = Corridor()
TREE = tree_of([(0, "a", ""), (0, "b", "c"), (1, "c", ""), (1, "b", "a"), (2, "a", "")], num_propositions=4)
NO_NODE = TaskTree.NO_NODE


def planner_agent(**changes: Any) -> Agent:
    return Agent(ENV, small_config(), Ours(high=small_planner(values_paths=True, **changes)))


@functools.partial(quick_jit, static_argnums=0)
def choose(agent: Agent, params: Any, views: View, tree: TaskTree, state: TaskState) -> tuple[Choice, Instruction]:
    """What is chosen of one task in some views, and the low level's instructions."""
    each = jax.tree.map(lambda x: jnp.stack([x] * len(views[1])), (tree, state, agent.low.instruct(params, tree)))
    return agent.high.choose(agent.low, params, views, *each), each[2]


@functools.partial(quick_jit, static_argnums=0)
def worth(agent: Agent, params: Any, views: View, path: jax.Array) -> jax.Array:
    """What a path from the root of `TREE` is worth in some views."""
    planner = agent.high.planner(agent.low)  # type: ignore[attr-defined]
    task = sequence(on_device(TREE), jnp.int32(0), path)
    ask = jax.vmap(functools.partial(planner.apply, method="worth_of_view"), in_axes=(None, 0, None))
    return ask(params["high"], views, task)


def worth_by_leaf(agent: Agent, params: Any, views: View) -> dict[int, np.ndarray]:
    """Of every path, each asked for by itself."""
    paths = {path[-1]: jnp.array((path + [NO_NODE] * 4)[:4], jnp.int32) for path in paths_below(TREE, 0)}
    return {leaf: np.asarray(worth(agent, params, views, path)) for leaf, path in paths.items()}


def paths_below(tree: TaskTree, node: int) -> list[list[int]]:
    """By recursion: the nodes of each path from ``node`` to a leaf."""
    children = np.flatnonzero(np.asarray(tree.valid) & (np.asarray(tree.parent) == node)).tolist()
    return [[child, *rest] for child in children for rest in paths_below(tree, child) or [[]]]


@pytest.mark.parametrize("seed", range(6))
def test_open_paths_are_those_that_a_recursion_finds(seed: int) -> None:
    """From any node, with any edges blocked; in the order of their leaves, or, of many, in turn by first edge."""
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, num_nodes=9, num_propositions=4)
    node = int(rng.choice(np.flatnonzero(np.asarray(tree.valid))))
    blocked = rng.random(tree.num_nodes) < 0.3
    state = TaskState(jnp.int32(node), jnp.asarray(blocked), jnp.int32(0))
    expected = sorted((path for path in paths_below(tree, node) if not blocked[path[0]]), key=lambda path: path[-1])
    for most, length in ((9, 8), (2, 8), (9, 2)):
        found = jax.tree.map(np.asarray, quick_jit(open_paths, static_argnums=(2, 3))(tree, state, most, length))
        assert found.known.sum() == min(most, len(expected))
        in_order = expected
        if tree.num_nodes > 2 * most:
            place = {path[-1]: sum(other[0] == path[0] for other in expected[:i]) for i, path in enumerate(expected)}
            in_order = sorted(expected, key=lambda path, place=place: (place[path[-1]], path[-1]))
        for path, leaf, nodes in zip(in_order, found.leaf, found.nodes, strict=False):
            assert leaf == path[-1]
            assert nodes.tolist() == (path + [NO_NODE] * length)[:length]


def test_a_sequence_asks_for_what_its_path_asks_for() -> None:
    """Both goals and what is to be avoided, which includes what the edges beside it reach."""
    path = np.array([2, 5, NO_NODE, NO_NODE], np.int32)
    found = jax.tree.map(np.asarray, sequence(on_device(TREE), jnp.int32(0), jnp.asarray(path)))
    expected = tree_of([(0, "b", "ac"), (1, "a", "")], num_propositions=4, num_nodes=5)
    jax.tree.map(np.testing.assert_array_equal, found, jax.tree.map(np.asarray, expected))
    np.testing.assert_array_equal(subtask_avoid(found), found.avoid)
    rest = jax.tree.map(np.asarray, sequence(on_device(TREE), jnp.int32(2), jnp.asarray(path[1:])))
    expected = tree_of([(0, "a", "")], num_propositions=4, num_nodes=4)
    # Nothing is left of what led to the node where it begins but its goal, which the planner's root is told as well.
    assert rest.reach[0].tolist() == [False, True, False, False]
    np.testing.assert_array_equal(rest.reach[1:], np.asarray(expected.reach)[1:])
    np.testing.assert_array_equal(rest.parent, expected.parent)


def test_an_edge_is_worth_its_best_path() -> None:
    paths = Paths(
        known=jnp.array([True, True, True, False]),
        leaf=jnp.array([3, 4, 5, 0]),
        nodes=jnp.array([[1, 3], [1, 4], [2, 5], [1, 3]]),
    )
    values, row, has_one = best_of_edges(paths, jnp.array([0.2, 0.7, 0.1, 9.0]), 6)
    np.testing.assert_allclose(values, [0.1, 0.7, 0.1, 0.1, 0.1, 0.1])
    assert (row[1], row[2]) == (1, 2)
    assert has_one.tolist() == [False, True, True, False, False, False]


@pytest.mark.parametrize("rounds", [0, 4])
def test_the_choice_follows_the_values_of_paths_asked_one_by_one(rounds: int) -> None:
    agent = planner_agent(network__rounds=rounds, inverse_temperature=3.0)
    params, tree, views = random_params(agent, 0), on_device(TREE), ENV.view_at(np.array([1, 2]))
    each = worth_by_leaf(agent, params, views)
    choice = jax.tree.map(np.asarray, choose(agent, params, views, tree, initial(tree))[0])
    of_first, of_second = np.maximum(each[3], each[4]), each[5]
    np.testing.assert_allclose(choice.value, np.maximum(of_first, of_second), rtol=1e-5)
    np.testing.assert_allclose(choice.logits[:, 1] - choice.logits[:, 2], 3.0 * (of_first - of_second), atol=1e-4)
    assert (choice.logits[:, [0, 3, 4, 5]] == MASKED).all()
    np.testing.assert_array_equal(choice.leaf[:, 1], np.where(each[3] >= each[4], 3, 4))
    np.testing.assert_array_equal(choice.leaf[:, 2], 5)


def test_the_low_level_is_told_the_path_that_is_meant() -> None:
    """Its later sub-tasks, and nothing after its end; of an edge that is not open, all that may come."""
    config = evolve(small_config(), {"network.roles": True, "network.lookahead": 2})
    agent = Agent(ENV, config, Ours(high=small_planner(values_paths=True, tells_path=True, network__rounds=0)))
    assert agent.high.follows_plan
    params, tree = random_params(agent, 0), on_device(TREE)
    views = ENV.view_at(np.array([1, 2]))
    choice, instruction = jax.tree.map(np.asarray, choose(agent, params, views, tree, initial(tree)))
    for env in range(2):
        for edge, path in ((1, [1, int(choice.leaf[env, 1])]), (2, [2, 5])):
            expected = np.zeros((2, 4))
            expected[0] = np.asarray(TREE.reach)[path[1]]
            np.testing.assert_array_equal(choice.ahead[env, edge], expected)
        np.testing.assert_array_equal(choice.ahead[env, 0], instruction.ahead[env, 0])


def test_the_loss_is_the_error_of_the_path_that_was_meant() -> None:
    agent = planner_agent(transe=0.0)
    high, params = agent.high, random_params(agent, 1)
    tree, views = on_device(TREE), ENV.view_at(np.array([1, 2, 3]))
    alike = jax.tree.map(lambda x: jnp.stack([x] * 3), (tree, initial(tree)))
    leaves, targets = jnp.array([3, 5, 4], jnp.int32), jnp.array([0.5, -1.0, 2.0])
    valid = jnp.array([True, True, False])
    nothing, false = jnp.zeros(3), jnp.zeros(3, bool)
    batch = HighBatch(
        tree=alike[0],
        view=views,
        state=alike[1],
        decision=undecided(3, tree.num_nodes, (0, 4)).replace(leaf=leaves),  # type: ignore[attr-defined]
        credit=Credit(advantage=nothing, target=targets, learns=false, valid=valid),
        reached=jnp.zeros((3, 4), bool),
        next_view=views,
        completed=false,
    )
    loss, metrics = quick_jit(lambda p: high.loss(agent.low, p, batch, jnp.float32(0)))(params["high"])
    each = worth_by_leaf(agent, params, views)
    error = np.mean([(each[int(leaves[row])][row] - float(targets[row])) ** 2 for row in (0, 1)])
    np.testing.assert_allclose(metrics["value_loss"], error, rtol=1e-4)
    np.testing.assert_allclose(loss, high.ppo.value_coefficient * error, rtol=1e-4)  # type: ignore[union-attr]


def test_blocked_edges_are_not_chosen() -> None:
    agent = planner_agent(network__rounds=0, inverse_temperature=3.0)
    tree, views = on_device(TREE), ENV.view_at(np.array([2, 3]))
    state = initial(tree)
    state = TaskState(state.node, state.blocked.at[1].set(True), state.status)
    choice, _ = choose(agent, random_params(agent, 2), views, tree, state)
    for logits in np.asarray(choice.logits):
        assert np.flatnonzero(logits > MASKED / 2).tolist() == np.flatnonzero(open_edges(tree, state)).tolist()
