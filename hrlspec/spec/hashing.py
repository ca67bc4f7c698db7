"""Hashes of tasks, invariant under the order and the padding of their trees' nodes.

Held-out tasks are recognised by their hashes: every sampler, the relabeller included, rejects a task whose hash is
reserved. Two trees with the same hash are the same task up to collisions of 32 bits.

Axes: **M** tasks, **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

from types import ModuleType
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt32

from envs_jax.arrays import Array
from hrlspec.spec.tree import TaskTree

A = TypeVar("A", jax.Array, np.ndarray)

_REACH, _AVOID, _ACCEPTING, _LEAF = 0x9E3779B9, 0x7F4A7C15, 0xC2B2AE35, 0x27D4EB2F


@jax.jit
def task_hash(tree: TaskTree) -> UInt32[Array, ""]:
    """Hash of one task, uint32 ``[]``; ``vmap`` for more.

    It depends on the reach and avoid sets of the edges, on which nodes accept and on how the edges follow
    each other; not on the order of the nodes, on padding, or on where padding stands.
    """
    edge = tree.valid & (tree.parent >= 0)
    own = _own_words(tree, jnp)
    index = jnp.arange(tree.num_nodes, dtype=jnp.int32)

    def absorb(below: UInt32[Array, " N"], node: tuple[Array, ...]) -> tuple[UInt32[Array, " N"], None]:
        i, parent, is_edge, word = node
        message = jnp.where(is_edge, _message(word, below[i]), jnp.uint32(0))
        return below + jnp.where(index == parent, message, jnp.uint32(0)), None

    # Children come after their parents: going backwards, a node is complete when it is passed on.
    below, _ = jax.lax.scan(
        absorb, jnp.zeros(tree.num_nodes, jnp.uint32), (index, tree.parent, edge, own), reverse=True
    )
    return _mix(below[TaskTree.ROOT])


def task_hashes(trees: TaskTree) -> UInt32[np.ndarray, " M"]:
    """:func:`task_hash` of a stack of tasks on the host, without compiling anything.

    Args:
        trees: leading axis M; any array type that NumPy reads.

    Returns:
        uint32 ``[M]``.
    """
    trees = jax.tree.map(np.asarray, trees)
    edge = trees.valid & (trees.parent >= 0)
    own = np.asarray(_own_words(trees, np))
    below = np.zeros(edge.shape, np.uint32)
    index = np.arange(edge.shape[-1])
    for i in reversed(range(edge.shape[-1])):
        message = np.where(edge[:, i], _message(own[:, i], below[:, i]), np.uint32(0))
        below += np.where(index == trees.parent[:, i, None], message[:, None], np.uint32(0))
    return _mix(below[:, TaskTree.ROOT])


def _own_words(tree: TaskTree, xp: ModuleType) -> UInt32[Array, "*lead N"]:
    """Hash of each edge by itself, uint32 ``[..., N]``; ``xp`` is ``numpy`` or ``jax.numpy``."""
    propositions = np.arange(1, tree.num_propositions + 1, dtype=np.uint32)
    zero = np.uint32(0)
    reach = xp.where(tree.reach, _mix(propositions ^ np.uint32(_REACH)), zero).sum(-1, dtype=np.uint32)
    avoid = xp.where(tree.avoid, _mix(propositions ^ np.uint32(_AVOID)), zero).sum(-1, dtype=np.uint32)
    return _mix(reach) + avoid + xp.where(tree.accepting, np.uint32(_ACCEPTING), zero)


def _message(own: UInt32[A, "*lead"], below: UInt32[A, "*lead"]) -> UInt32[A, "*lead"]:
    """What an edge adds to the hash of its parent: its own hash and, mixed first, the sum over its children."""
    return _mix(_mix(below ^ np.uint32(_LEAF)) + own)


def _mix(x: UInt32[A, "*lead"]) -> UInt32[A, "*lead"]:
    """A bijection of uint32 with full avalanche (xor-shifts and odd multipliers)."""
    x = x ^ (x >> np.uint32(16))
    x = x * np.uint32(0x85EBCA6B)
    x = x ^ (x >> np.uint32(13))
    x = x * np.uint32(0xC2B2AE35)
    return x ^ (x >> np.uint32(16))
