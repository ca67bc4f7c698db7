"""The planner's passes over a tree against the same passes written out, node by node and edge by edge."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.agent.networks.messages import Rounds, Sweep, below
from hrlspec.agent.networks.planner import Planner, PlannerConfig
from hrlspec.agent.networks.transition import Transition
from hrlspec.config import NetworkConfig
from hrlspec.spec import TaskState, TaskTree, initial, open_edges, subtask_avoid
from tests.probes import on_device, quick_jit
from tests.trees import random_tree

N, P, F, LATENT, HIDDEN, ROUNDS = 8, 4, 6, 5, 7, 3
LEAST_VALID = 4


def some_trees(number: int) -> list[TaskTree]:
    rng = np.random.default_rng(3)
    trees = (random_tree(rng, num_nodes=N, num_propositions=P, most_together=2, distinct=True) for _ in range(1000))
    return [tree for tree in trees if tree.valid.sum() >= LEAST_VALID][:number]


def parameters(module: Any, *args: Any) -> Any:
    """Random ones, biases too."""
    shapes = jax.eval_shape(module.init, jax.random.key(0), *args)
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), shapes)


def states(tree: TaskTree) -> list[TaskState]:
    """At every node that is not the end, with nothing blocked, and with the first open edge blocked."""
    result = []
    for node in np.flatnonzero(tree.valid & ~tree.accepting):
        blocked = np.zeros(N, bool)
        for first in (blocked, (tree.parent == node) & (np.cumsum(tree.parent == node) == 1)):
            result.append(initial(on_device(tree)).replace(node=jnp.int32(node), blocked=jnp.asarray(first)))
    return result


def descendants(tree: TaskTree, node: int) -> set[int]:
    children = [k for k in range(N) if tree.valid[k] and tree.parent[k] == node and k != node]
    return {node}.union(*(descendants(tree, child) for child in children))


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0.0)


def test_below() -> None:
    found = quick_jit(below)
    for tree in some_trees(10):
        for node in np.flatnonzero(tree.valid):
            assert set(np.flatnonzero(found(on_device(tree), jnp.int32(node)))) == descendants(tree, int(node))


def test_latents_down_the_tree_are_predictions_of_predictions() -> None:
    module = Transition(HIDDEN, LATENT)
    latent = jax.random.normal(jax.random.key(1), (LATENT,))
    params = parameters(module, latent, jnp.zeros(P, bool))
    down = quick_jit(lambda tree, root: module.apply(params, latent, tree, root, method="down"))
    predict = quick_jit(lambda latent, reach: module.apply(params, latent, reach))
    for tree in some_trees(6):
        for root in np.flatnonzero(tree.valid & ~tree.accepting):
            found = np.asarray(down(on_device(tree), jnp.int32(root)))
            expected = {int(root): latent}
            for node in sorted(descendants(tree, int(root)) - {int(root)}):
                expected[node] = predict(expected[int(tree.parent[node])], jnp.asarray(tree.reach[node]))
            for node, one in expected.items():
                np.testing.assert_allclose(found[node], one, rtol=1e-3, atol=1e-3)


def read_rounds(params: Any, x: np.ndarray, tree: TaskTree, state: TaskState) -> dict[int, np.ndarray]:
    """As many messages and updates as there are rounds, of the nodes that remain."""
    p = jax.tree.map(np.asarray, params["params"])
    to_child, to_parent, to_own = np.split(p["features"], 3, 1)
    goal_child, goal_parent, goal_own = np.split(p["goal"]["kernel"], 3, 1)
    goal, avoid = tree.reach.astype(float), np.asarray(subtask_avoid(on_device(tree))).astype(float)
    remain, node = descendants(tree, int(state.node)), int(state.node)
    features = {k: x[k] for k in remain}
    for _ in range(ROUNDS):
        incoming = {k: np.zeros(F) for k in remain}
        for child in remain - {node}:
            if state.blocked[child]:
                continue
            parent = int(tree.parent[child])
            hidden = features[child] @ to_child + goal[child] @ goal_child
            hidden = hidden + features[parent] @ to_parent + goal[parent] @ goal_parent
            hidden = hidden + np.concatenate([goal[child], avoid[child]]) @ p["edge"]["kernel"] + p["bias"][0]
            incoming[parent] = incoming[parent] + relu(hidden) @ p["send"]
        for k in remain:
            hidden = features[k] @ to_own + goal[k] @ goal_own + incoming[k] @ p["receive"] + p["bias"][1]
            new = relu(hidden) @ p["end"] + p["end_bias"]
            features[k] = (new - new.mean()) / np.sqrt(new.var() + 1e-6)
    return features


def read_sweep(params: Any, x: np.ndarray, tree: TaskTree, state: TaskState) -> dict[int, np.ndarray]:
    """Each node after its children."""
    p = jax.tree.map(np.asarray, params["params"])
    avoid = np.asarray(subtask_avoid(on_device(tree)))
    known = np.concatenate([x, tree.reach], 1)

    def embed(node: int) -> np.ndarray:
        total = known[node] @ p["own"]["kernel"] + p["own"]["bias"]
        for child in np.flatnonzero(tree.valid & (tree.parent == node) & ~np.asarray(state.blocked)):
            edge = np.concatenate([tree.reach[child], avoid[child]]) @ p["edge"]["kernel"]
            hidden = known[node] @ p["parent"]["kernel"] + p["parent"]["bias"] + edge + embed(child) @ p["child"]
            total = total + relu(hidden) @ p["message"]
        return relu(total)

    return {k: embed(k) for k in descendants(tree, int(state.node))}


@pytest.mark.parametrize(("module", "read"), [(Rounds(F, ROUNDS), read_rounds), (Sweep(F), read_sweep)])
def test_messages_and_updates(module: Any, read: Any) -> None:
    """One tree at a time, and many: where most nodes are behind or padding, and where most remain."""
    cases = [(tree, state) for tree in some_trees(8) for state in states(tree)]
    rng = np.random.default_rng(1)
    x = rng.normal(size=(len(cases), N, F)).astype(np.float32)
    params = parameters(module, x[0], on_device(cases[0][0]), cases[0][1])
    expected = [read(params, one, *case) for one, case in zip(x, cases, strict=True)]
    remaining = np.array([len(one) for one in expected])
    embed = quick_jit(lambda *args: module.apply(params, *args))
    batched = quick_jit(jax.vmap(lambda *args: module.apply(params, *args)))

    def check(found: Any, which: int) -> None:
        for node, one in expected[which].items():
            np.testing.assert_allclose(found[node], one, rtol=2e-3, atol=2e-3)

    for which in range(0, len(cases), 5):
        check(np.asarray(embed(x[which], on_device(cases[which][0]), cases[which][1])), which)
    size = 6
    most, fewest = np.argsort(-remaining)[:size], np.argsort(remaining)[:size]
    assert remaining[most].sum() > 3 * N * size // 8 >= remaining[fewest].sum()
    for rows in (most, fewest):
        trees, at = jax.tree.map(lambda *leaf: jnp.stack(leaf), *(cases[i] for i in rows))
        for found, which in zip(np.asarray(batched(x[rows], trees, at)), rows, strict=True):
            check(found, which)


@pytest.mark.parametrize("advice", [0.0, 2.0])
def test_many_trees_are_planned_as_each_alone(advice: float) -> None:
    """Where few edges are open, and where so many are that all are computed."""
    sizes = PlannerConfig(features=F, hidden=HIDDEN, policy=(5, 4), rounds=ROUNDS, advice=advice)
    planner = Planner(sizes, NetworkConfig(latent=LATENT, encoder_mlp=(6,)))
    cases = [(tree, state) for tree in some_trees(8) for state in states(tree)]
    rng = np.random.default_rng(1)
    views = [tuple(rng.normal(size=shape).astype(np.float32) for shape in ((P, 3), (2,))) for _ in cases]
    advices = rng.normal(size=(len(cases), N)).astype(np.float32)
    params = parameters(planner, views[0], on_device(cases[0][0]), cases[0][1], advices[0])
    num_open = np.array([int(open_edges(on_device(tree), state).sum()) for tree, state in cases])
    alone = quick_jit(lambda *args: planner.apply(params, *args))
    together = quick_jit(jax.vmap(lambda *args: planner.apply(params, *args)))
    size = 4
    most, fewest = np.argsort(-num_open)[:size], np.argsort(num_open)[:size]
    assert num_open[most].sum() > N * size // 4 >= num_open[fewest].sum()
    for rows in (most, fewest):
        inputs = [(views[i], *cases[i], advices[i]) for i in rows]
        logits, value = map(np.asarray, together(*jax.tree.map(lambda *leaf: jnp.stack(leaf), *inputs)))
        for i, one in enumerate(inputs):
            expected = alone(one[0], on_device(one[1]), *one[2:])
            np.testing.assert_allclose(logits[i], expected[0], rtol=2e-3, atol=2e-3)
            np.testing.assert_allclose(value[i], expected[1], rtol=2e-3, atol=2e-3)
