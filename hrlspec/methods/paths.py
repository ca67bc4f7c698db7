"""The paths on from where a task stands: each a sequence of sub-tasks, which is valued by itself.

A path is the tree under commitment: all edges beside it are blocked. Most tasks have few, so all are valued side by
side.

Axes: **N** tree nodes, **L** paths, **D** sub-tasks of a path, **P** atomic propositions.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.networks.tree import routes
from hrlspec.spec import TaskState, TaskTree, open_edges, subtask_avoid


class Paths(NamedTuple):
    """Paths from the current node of a task to its leaves, by their first open edge."""

    known: Bool[Array, "*lead L"]  # there are as many
    leaf: Int32[Array, "*lead L"]
    nodes: Int32[Array, "*lead L D"]  # the first edge, then those after it; `NO_NODE` after the end

    @property
    def edge(self) -> Int32[Array, "*lead L"]:
        """The first edge."""
        return self.nodes[..., 0]


def open_paths(tree: TaskTree, state: TaskState, most: int, length: int) -> Paths:
    """The paths that are open in one environment.

    Args:
        tree: the task.
        state: where it stands.
        most: L, how many are told apart. Those beyond are left out in turn by first edge; in a small tree, by their
            leaf.
        length: D, sub-tasks of a path; those beyond them are left out.
    """
    num_nodes = tree.num_nodes
    nodes = routes(tree, state.node, length)
    leads = tree.accepting & (nodes[:, 0] >= 0) & open_edges(tree, state)[nodes[:, 0]]
    if num_nodes <= 2 * most:  # about as many leaves as are told apart
        leaf = jnp.nonzero(leads, size=min(most, num_nodes), fill_value=num_nodes)[0].astype(jnp.int32)
        at = jnp.minimum(leaf, num_nodes - 1)
        return Paths(known=leaf < num_nodes, leaf=at, nodes=nodes[at])
    # In turn by their first edge, so that each has a path among those told apart.
    number = jnp.arange(num_nodes, dtype=jnp.int32)
    before = (leads & (nodes[:, :1] == nodes[:, 0]) & (number < number[:, None])).sum(1, dtype=jnp.int32)
    leaf = jnp.argsort(jnp.where(leads, before * num_nodes + number, num_nodes**2 + number))[:most].astype(jnp.int32)
    return Paths(known=leads[leaf], leaf=leaf, nodes=nodes[leaf])


def sequence(tree: TaskTree, node: Int32[Array, ""], path: Int32[Array, " D"]) -> TaskTree:
    """A path on from ``node`` as a task of its own, of 1 + D nodes.

    What its sub-tasks must avoid (eq. 2) is what they had to avoid in the tree: the edges beside them are still there.
    """
    on_path = jnp.concatenate([jnp.ones(1, bool), path >= 0])
    place = jnp.arange(1 + path.shape[0], dtype=jnp.int32)
    nodes = jnp.where(on_path, jnp.concatenate([node[None], path]), 0)
    return TaskTree(
        parent=jnp.where(on_path, place - 1, TaskTree.NO_NODE),
        reach=tree.reach[nodes] & on_path[:, None],
        avoid=subtask_avoid(tree)[nodes] & on_path[:, None],
        accepting=tree.accepting[nodes] & on_path,
        valid=on_path,
        depth=place * on_path,
    )


def best_of_edges(
    paths: Paths, values: Float32[Array, " L"], num_nodes: int
) -> tuple[Float32[Array, " N"], Int32[Array, " N"], Bool[Array, " N"]]:
    """What each edge is worth: as much as the best path through it.

    Args:
        paths: of one environment.
        values: float32 ``[L]``, of the paths.
        num_nodes: N.

    Returns:
        The values ``[N]``, where an edge has no path the worst of all paths; the row of its best path ``[N]``; and
        whether it has one ``[N]``.
    """
    through = (paths.edge == jnp.arange(num_nodes, dtype=jnp.int32)[:, None]) & paths.known
    score = jnp.where(through, values, -jnp.inf)
    worst = jnp.where(paths.known.any(), jnp.where(paths.known, values, jnp.inf).min(), 0.0)
    has_one = through.any(1)
    return jnp.where(has_one, score.max(1), worst), score.argmax(1).astype(jnp.int32), has_one
