"""The planner's GNN: messages M from children to parents, and updates U (paper, "Backward Pass", eq. 3).

M and U are perceptrons of one hidden layer. The linear end of M, the sum over children and U's first layer are linear:
one matrix, applied to what the hidden layers add up to. Axes: **N** tree nodes, **F** features, **B** environments,
**R** rows: nodes of one tree or of several, one after the other.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.networks.encoder import initializer
from hrlspec.agent.networks.rows import where_needed
from hrlspec.agent.networks.tree import sweep_up
from hrlspec.spec import TaskState, TaskTree, subtask_avoid

_GAIN = 2.0**0.5


class Graph(NamedTuple):
    """Nodes and what flows between them; a leading axis R."""

    parent: Int32[Array, " R"]
    sends: Bool[Array, " R"]  # a message goes to the parent
    message: Float32[Array, "R F"]  # what M's hidden layer is given besides both nodes' features
    own: Float32[Array, "R F"]  # what U's hidden layer is given besides the node's features and messages


class Rounds(nn.Module):
    """As many rounds as are asked for, with the same weights; look-ahead ends at this depth.

    Attributes:
        features: F.
        rounds: how many.
    """

    features: int
    rounds: int

    @nn.compact
    def __call__(self, x: Float32[Array, "N F"], tree: TaskTree, state: TaskState) -> Float32[Array, "N F"]:
        """Embeds the nodes that remain, ``[N, F]``, from features ``x``; meaningless for all others."""
        size = self.features
        goal = tree.reach.astype(jnp.float32)
        child, parent, own = jnp.split(self._linear("goal", 3 * size, 1.0)(goal), 3, -1)
        edge = self._linear("edge", size, 1.0)(_edge(tree))
        bias = self.param("bias", nn.initializers.zeros, (2, size), jnp.float32)
        receive = self.param("receive", initializer(1.0), (size, size))
        weights = {
            "features": self.param("features", initializer(1.0), (size, 3 * size)),
            "incoming": self.param("send", initializer(_GAIN), (size, size)) @ receive,
            "end": self.param("end", initializer(_GAIN), (size, size)),
            "end_bias": self.param("end_bias", nn.initializers.zeros, (size,), jnp.float32),
        }
        remains = below(tree, state.node)
        graph = Graph(
            parent=jnp.maximum(tree.parent, 0),
            sends=_sends(tree, state) & remains,
            message=child + parent[tree.parent] + edge + bias[0],
            own=own + bias[1],
        )
        embeddings: Float32[Array, "N F"] = _passes(self.rounds)(weights, x, graph, remains)
        return embeddings

    def _linear(self, name: str, size: int, gain: float) -> nn.Dense:
        return nn.Dense(size, use_bias=False, kernel_init=initializer(gain), name=name)


class Sweep(nn.Module):
    """One visit of each node, from the leaves to the root, which looks ahead without limit.

    U is its hidden layer alone. What does not come from below is computed for all nodes at once, which leaves two
    matrix products to a visit.

    Attributes:
        features: F.
    """

    features: int

    @nn.compact
    def __call__(self, x: Float32[Array, "N F"], tree: TaskTree, state: TaskState) -> Float32[Array, "N F"]:
        """Embeds the nodes that remain, ``[N, F]``, from features ``x``; meaningless for all others."""
        square = (self.features, self.features)
        x = jnp.concatenate([x, tree.reach.astype(jnp.float32)], -1)
        own = nn.Dense(self.features, kernel_init=initializer(_GAIN), name="own")(x)
        parent = nn.Dense(self.features, kernel_init=initializer(_GAIN), name="parent")(x)[tree.parent]
        edge = nn.Dense(self.features, use_bias=False, kernel_init=initializer(_GAIN), name="edge")(_edge(tree))
        child = self.param("child", initializer(_GAIN), square)
        message = self.param("message", initializer(1.0), square)
        known, sends = parent + edge, _sends(tree, state)

        def visit(
            incoming: Float32[Array, "N F"], node: Int32[Array, ""]
        ) -> tuple[Float32[Array, "N F"], Float32[Array, " F"]]:
            here = nn.relu(own[node] + incoming[node])
            sent = nn.relu(known[node] + here @ child) @ message
            receives = (jnp.arange(tree.num_nodes, dtype=jnp.int32) == tree.parent[node]) & sends[node]
            return incoming + receives[:, None] * sent, here

        embeddings: Float32[Array, "N F"] = sweep_up(visit, jnp.zeros_like(own))
        return embeddings


def _edge(tree: TaskTree) -> Float32[Array, "N _"]:
    """Features of the edges: what they reach and what their sub-tasks must avoid."""
    return jnp.concatenate([tree.reach, subtask_avoid(tree)], -1).astype(jnp.float32)


def below(tree: TaskTree, node: Int32[Array, ""]) -> Bool[Array, " N"]:
    """Which nodes are ``node`` or below it, bool ``[N]``."""
    found = jnp.arange(tree.num_nodes, dtype=jnp.int32) == node
    ancestor = jnp.maximum(tree.parent, 0)
    for _ in range(tree.num_nodes.bit_length()):  # each doubles how far up it is looked
        found, ancestor = found | found[ancestor], ancestor[ancestor]
    return found & tree.valid


def _sends(tree: TaskTree, state: TaskState) -> Bool[Array, " N"]:
    """Which nodes send a message to their parent: not the current one, nor those behind a blocked edge."""
    return tree.edges & ~state.blocked & (jnp.arange(tree.num_nodes, dtype=jnp.int32) != state.node)


@functools.cache
def _passes(rounds: int) -> Callable[..., Any]:
    """So many rounds over a tree, given weights, features, what flows, and which nodes remain."""

    @jax.custom_batching.custom_vmap
    def one(weights: Any, x: Float32[Array, "N F"], graph: Graph, remains: Bool[Array, " N"]) -> Float32[Array, "N F"]:
        del remains
        return _rounds(weights, x, graph, rounds)

    @one.def_vmap
    def many(
        size: int, batched: Any, weights: Any, x: Any, graph: Graph, remains: Any
    ) -> tuple[Float32[Array, "B N F"], bool]:
        if any(jax.tree.leaves(batched[0])) or not all(jax.tree.leaves(batched[1:])):
            axes = jax.tree.map(lambda yes: 0 if yes else None, batched)
            return jax.vmap(one.fun, in_axes=tuple(axes))(weights, x, graph, remains), True
        num_nodes = remains.shape[1]
        graph = graph._replace(parent=graph.parent + num_nodes * jnp.arange(size, dtype=jnp.int32)[:, None])
        flat_x, graph, remains = jax.tree.map(lambda leaf: leaf.reshape((-1, *leaf.shape[2:])), (x, graph, remains))

        def of_rows(rows: tuple[Any, Graph], place: Int32[Array, " R"]) -> Float32[Array, "r F"]:
            few_x, few = rows
            return _rounds(weights, few_x, few._replace(parent=place[few.parent]), rounds)

        found = where_needed(of_rows, remains, (flat_x, graph), most=3 * remains.size // 8)
        return found.reshape(x.shape), True

    return one


def _rounds(weights: Any, x: Float32[Array, "R F"], graph: Graph, rounds: int) -> Float32[Array, "R F"]:
    """Rounds over all rows."""
    for _ in range(rounds):
        child, parent, own = jnp.split(x @ weights["features"], 3, -1)
        hidden = nn.relu(child + parent[graph.parent] + graph.message) * graph.sends[:, None]
        incoming = jnp.zeros_like(hidden).at[graph.parent].add(hidden)
        x = nn.relu(own + incoming @ weights["incoming"] + graph.own) @ weights["end"] + weights["end_bias"]
        # The rounds share their weights: what grows in one grows in all, at first to a hundredfold.
        x = _normalised(x)
    return x


def _normalised(x: Float32[Array, "R F"]) -> Float32[Array, "R F"]:
    """Features with mean 0 and standard deviation 1 at each node."""
    x = x - x.mean(-1, keepdims=True)
    return x * jax.lax.rsqrt((x**2).mean(-1, keepdims=True) + 1e-6)
