"""The padded task tree: a SPECTRL task as arrays that can be jitted, vmapped and gathered.

Axes: **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from flax import struct
from jaxtyping import Bool, Int32

from envs_jax.arrays import Array


@struct.dataclass
class TaskTree:
    """A task unfolded into a tree and padded to N nodes (paper, "Sub-task Definition").

    Node 0 is the root; parents come before their children. Every other valid node *is* the edge that
    enters it, so "edge k" means the edge from ``parent[k]`` to node k. Padding rows are all zero with
    ``parent = NO_NODE``.

    Attributes:
        parent: int32 ``[N]``, index of the parent, ``NO_NODE`` for the root and for padding.
        reach: bool ``[N, P]``, propositions that must hold together to take the edge (p₊).
        avoid: bool ``[N, P]``, the ``ensuring`` part of the edge: if one of these holds, the edge is blocked.
        accepting: bool ``[N]``, arriving here satisfies the task. Accepting nodes have no children.
        valid: bool ``[N]``, false for padding.
        depth: int32 ``[N]``, edges from the root, 0 for the root and for padding.
        hold: int32 ``[N]``, for how many steps in a row p₊ must hold to take the edge; ``None`` if for one, everywhere.
            Where for more, and the edge before reached p₊, too, the edge is blocked as soon as p₊ does not hold.
    """

    NO_NODE: ClassVar[int] = -1
    ROOT: ClassVar[int] = 0

    parent: Int32[Array, "*lead N"]
    reach: Bool[Array, "*lead N P"]
    avoid: Bool[Array, "*lead N P"]
    accepting: Bool[Array, "*lead N"]
    valid: Bool[Array, "*lead N"]
    depth: Int32[Array, "*lead N"]
    hold: Int32[Array, "*lead N"] | None = None

    @property
    def num_nodes(self) -> int:
        """N, the padded number of nodes."""
        return self.parent.shape[-1]

    @property
    def num_propositions(self) -> int:
        """P, the number of atomic propositions."""
        return self.reach.shape[-1]

    @property
    def edges(self) -> Bool[Array, "*lead N"]:
        """Which nodes are entered by an edge, bool ``[..., N]``: all valid ones but the root."""
        return self.valid & (self.parent >= 0)


def subtask_avoid(tree: TaskTree) -> Bool[Array, "N P"]:
    """What each sub-task must avoid, bool ``[N, P]`` (eq. 2): own avoid, and what siblings reach, minus own reach.

    For siblings that reach conjunctions this forbids more than eq. (2) does: ¬(b∧c) becomes ¬b and ¬c.
    """
    others = _siblings(tree) & ~np.eye(tree.num_nodes, dtype=bool)
    reached_by_siblings = (others.astype(np.float32) @ tree.reach.astype(np.float32)) > 0
    return tree.avoid | (reached_by_siblings & ~tree.reach)


def forbidden(tree: TaskTree) -> Bool[Array, "N P"]:
    """What violates the task where each edge is open, bool ``[N, P]``: what the edge and all its siblings avoid.

    Any other part of `subtask_avoid` ends the sub-task alone: the task goes on along another edge.
    """
    allowed_by_any = (_siblings(tree).astype(np.float32) @ (~tree.avoid).astype(np.float32)) > 0
    return tree.avoid & ~allowed_by_any


def _siblings(tree: TaskTree) -> Bool[Array, "N N"]:
    """Which edges leave the same node; each is its own sibling."""
    return (tree.parent[:, None] == tree.parent[None, :]) & tree.edges[:, None] & tree.edges[None, :]
