"""Message passing from children to parents, and the low level's embedding of remaining tasks.

Axes: **N** tree nodes, **P** atomic propositions, **F** features.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.networks.encoder import initializer
from hrlspec.spec import TaskTree


def sum_to_parents(
    messages: Float32[Array, "N F"], parent: Int32[Array, " N"], sends: Bool[Array, " N"]
) -> Float32[Array, "N F"]:
    """Sum of the messages ``[N, F]`` that arrive at each node, ``[N, F]``; nodes where ``sends`` is false send none."""
    return jnp.zeros_like(messages).at[parent].add(jnp.where(sends[:, None], messages, 0.0))


def sweep_up(visit: Callable[..., Any], carry: Any) -> Any:
    """Visits the nodes from the last to the root, so that children come before their parents.

    The messages of a node are then complete when it is visited: one visit a node does what as many rounds as
    the tree is deep would do, at a fraction of the arithmetic, and look-ahead has no limit.

    Args:
        visit: ``(carry, node) -> (carry, output)``; ``carry`` holds the messages, leading axis N.
        carry: messages before the first visit.

    Returns:
        The outputs, leading axis N.
    """
    num_nodes = jax.tree.leaves(carry)[0].shape[0]
    return jax.lax.scan(visit, carry, jnp.arange(num_nodes, dtype=jnp.int32), reverse=True)[1]


def lookahead(tree: TaskTree, depth: int) -> Bool[Array, "N D P"]:
    """What may be reached 1, 2, ... sub-tasks after each node, over all branches, bool ``[N, depth, P]``."""
    ahead = []
    reach = tree.reach.astype(jnp.float32)
    for _ in range(depth):
        reach = sum_to_parents(reach, tree.parent, tree.edges)
        ahead.append(reach > 0)
    return jnp.stack(ahead, 1) if ahead else jnp.zeros((tree.num_nodes, 0, tree.num_propositions), bool)


def with_stays(tree: TaskTree, ahead: Float32[Array, "N D P"]) -> Float32[Array, "N D P"]:
    """What lies ahead of each edge, ``[N, D, P]``: where p₊ must hold for a while that is p₊ itself.

    No other sub-task has its own goal before it, so that this says what is meant.
    """
    if tree.hold is None:
        return ahead
    return jnp.where((tree.hold > 1)[:, None, None], tree.reach[:, None].astype(ahead.dtype), ahead)


def forks(tree: TaskTree) -> Bool[Array, " N"]:
    """Whether more than one way leads on from a node or from one below it, bool ``[N]``."""
    several = jnp.zeros(tree.num_nodes, jnp.int32).at[tree.parent].add(tree.edges.astype(jnp.int32)) > 1

    def visit(fork: Bool[Array, " N"], node: Int32[Array, ""]) -> tuple[Bool[Array, " N"], Bool[Array, ""]]:
        return fork.at[tree.parent[node]].max(fork[node] & tree.edges[node]), fork[node]

    found: Bool[Array, " N"] = sweep_up(visit, several)
    return found


def lookback(tree: TaskTree, depth: int) -> Bool[Array, "N D P"]:
    """What was reached 1, 2, ... sub-tasks before each edge, bool ``[N, depth, P]``; nothing before the first."""
    behind = []
    node = tree.parent
    for _ in range(depth):
        behind.append(tree.reach[node] & (node >= 0)[:, None])
        node = jnp.where(node >= 0, tree.parent[node], node)
    return jnp.stack(behind, 1) if behind else jnp.zeros((tree.num_nodes, 0, tree.num_propositions), bool)


def routes(tree: TaskTree, node: Int32[Array, ""], length: int) -> Int32[Array, "N length"]:
    """The path from ``node`` to every node below it: its first ``length`` nodes, int32 ``[N, length]``.

    ``NO_NODE`` after the end of the path, and everywhere for nodes that are not below.
    """
    place = jnp.arange(length, dtype=jnp.int32)
    nothing = jnp.full((tree.num_nodes, length), TaskTree.NO_NODE, jnp.int32)

    def climb(_: Any, carry: Any) -> tuple[Int32[Array, " N"], Int32[Array, "N length"]]:
        here, way = carry
        steps = tree.depth[here] - tree.depth[node] - 1
        way = jnp.where(place == steps[:, None], here[:, None], way)
        return jnp.where(tree.parent[here] >= 0, tree.parent[here], here), way

    start = jnp.arange(tree.num_nodes, dtype=jnp.int32)
    _, way = jax.lax.fori_loop(0, tree.depth.max() + 1, climb, (start, nothing))
    below = tree.valid & (tree.parent[way[:, 0]] == node) & (way[:, 0] >= 0)
    return jnp.where(below[:, None], way, TaskTree.NO_NODE)


class TaskEmbedding(nn.Module):
    """GCN over a task tree with zero node features and p₊ on the edges (paper, "DAG Processing").

    Information flows from children to parents alone, so one pass embeds every progression at once: row k is
    the embedding of what remains after node k is reached. Weights are shared between rounds.

    Attributes:
        features: F.
        rounds: rounds of message passing, or 0 for one sweep from the leaves to the root.
        negatives: whether what an edge forbids by itself is on it too, as in LTL2Action.
    """

    features: int
    rounds: int
    negatives: bool = False

    def setup(self) -> None:
        """Declares the weights: of a node's own features, and of the message along an edge."""
        self.own = nn.Dense(self.features, kernel_init=initializer(1.0))
        self.message = self.param("message", initializer(1.0), (self.features, self.features))
        self.edge = nn.Dense(self.features, use_bias=False, kernel_init=initializer(1.0))

    def __call__(self, tree: TaskTree) -> Float32[Array, "N F"]:
        """Embeds all progressions of one task, float32 ``[N, F]``."""
        if not self.rounds:
            return self._sweep(tree)[0]
        sends = tree.edges
        edge = self._edge(tree)
        x = jnp.zeros((tree.num_nodes, self.features), jnp.float32)
        for _ in range(self.rounds):
            x = nn.tanh(self.own(x) + sum_to_parents(nn.tanh(x @ self.message + edge), tree.parent, sends))
        return x

    def messages(self, tree: TaskTree) -> Float32[Array, "N F"]:
        """The message sent along each edge, float32 ``[N, F]``, for `of_edges`."""
        return self._sweep(tree)[1]

    def of_edges(
        self, messages: Float32[Array, "*lead N F"], edges: Bool[Array, "*lead N"]
    ) -> Float32[Array, "*lead F"]:
        """Embeds the task that begins with some edges (bool ``[..., N]``) of one node, ``[..., F]``."""
        return nn.tanh(self.own(jnp.zeros(self.features, jnp.float32)) + (messages * edges[..., None]).sum(-2))

    def _edge(self, tree: TaskTree) -> Float32[Array, "N F"]:
        parts = [tree.reach, tree.avoid] if self.negatives else [tree.reach]
        return self.edge(jnp.concatenate(parts, -1).astype(jnp.float32))

    def _sweep(self, tree: TaskTree) -> tuple[Float32[Array, "N F"], Float32[Array, "N F"]]:
        """Embeddings of all progressions, and the message sent along each edge, ``[N, F]`` each."""
        sends = tree.edges
        edge = self._edge(tree)
        nothing = jnp.zeros((tree.num_nodes, self.features), jnp.float32)
        bias = self.own(nothing[0])

        def visit(incoming: Float32[Array, "N F"], node: Int32[Array, ""]) -> tuple[Float32[Array, "N F"], Any]:
            here = nn.tanh(bias + incoming[node])
            sent = nn.tanh(here @ self.message + edge[node]) * sends[node]
            return incoming.at[tree.parent[node]].add(sent), (here, sent)

        return sweep_up(visit, nothing)

    def of_sequence(self, ahead: Float32[Array, "D P"]) -> Float32[Array, " F"]:
        """Embeds a sequence of sub-tasks as the sweep would, ``[F]``; p₊ is ``[D, P]``, empty rows after its end."""
        bias = self.own(jnp.zeros(self.features, jnp.float32))
        x = nn.tanh(bias)
        for reach in ahead[::-1]:
            x = nn.tanh(bias + reach.any() * nn.tanh(x @ self.message + self.edge(reach)))
        return x
