"""The monitor: runs a task tree along a trace of labels, inside the jit.

This is the *committed* reading of the abstract graph: the first visit decides. ``docs/semantics.md``
shows where it differs from the existential semantics of :func:`hrlspec.spec.satisfies`.
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Int32

from envs_jax.arrays import Array
from hrlspec.spec.tree import TaskTree

RUNNING = 0
SATISFIED = 1
VIOLATED = 2


@struct.dataclass
class TaskState:
    """Progress of a task: the progression is the subtree at ``node`` without the blocked edges.

    Attributes:
        node: int32 ``[]``, the current node.
        blocked: bool ``[N]``, edges out of ``node`` whose ``ensuring`` part was violated.
        status: int32 ``[]``, ``RUNNING``, ``SATISFIED`` or ``VIOLATED``.
        held: int32 ``[N]``, for how many steps in a row p₊ of each edge has held; ``None`` where that does not count.
    """

    node: Int32[Array, "*lead"]
    blocked: Bool[Array, "*lead N"]
    status: Int32[Array, "*lead"]
    held: Int32[Array, "*lead N"] | None = None


def initial(tree: TaskTree) -> TaskState:
    """The state before the first action: at the root, nothing blocked. No label counts yet."""
    return TaskState(
        node=jnp.int32(TaskTree.ROOT),
        blocked=jnp.zeros(tree.num_nodes, bool),
        status=jnp.int32(RUNNING),
        held=None if tree.hold is None else jnp.zeros(tree.num_nodes, jnp.int32),
    )


def open_edges(tree: TaskTree, state: TaskState) -> Bool[Array, " N"]:
    """Feasible sub-tasks, bool ``[N]``: the unblocked edges out of the current node."""
    return tree.valid & (tree.parent == state.node) & ~state.blocked


def holding(tree: TaskTree, state: TaskState, labels: Bool[Array, " P"]) -> Int32[Array, " N"] | None:
    """For how many steps in a row p₊ of each edge has held, int32 ``[N]``, after one more; where that counts."""
    if state.held is None:
        return None
    return jnp.where((~tree.reach | labels).all(-1), state.held + 1, 0).astype(jnp.int32)


def advance(tree: TaskTree, state: TaskState, labels: Bool[Array, " P"], assigned: Int32[Array, ""] | int) -> TaskState:
    """One step of the monitor on the labels that hold in the new environment state.

    Open edges whose ``avoid`` is hit become blocked; then at most one open edge whose ``reach`` holds is
    taken: the assigned one, else the most specific, else the one of lowest index. With no open edge left
    the task is violated. A task that is no longer running does not change.

    Args:
        tree: one task (unbatched; ``vmap`` for more).
        state: its state.
        labels: bool ``[P]``, the propositions that hold now.
        assigned: int32 ``[]``, the node whose edge is pursued, or ``TaskTree.NO_NODE``.
    """
    running = state.status == RUNNING
    candidates = open_edges(tree, state)
    harmed = (tree.avoid & labels).any(-1)
    reached = (~tree.reach | labels).all(-1)
    held = holding(tree, state, labels)
    if held is not None and tree.hold is not None:
        goes_on = (tree.hold > 1) & (tree.reach == tree.reach[tree.parent]).all(-1)
        harmed, reached = harmed | (goes_on & ~reached), held >= tree.hold
    still_open = candidates & ~harmed
    met = still_open & reached
    num_propositions = tree.reach.shape[-1]
    preference = tree.reach.sum(-1) + (num_propositions + 1) * (jnp.arange(tree.num_nodes, dtype=jnp.int32) == assigned)
    taken = jnp.argmax(jnp.where(met, preference, -1)).astype(jnp.int32)
    moved = met.any() & running
    node = jnp.where(moved, taken, state.node)
    status = jnp.where(
        moved,
        jnp.where(tree.accepting[node], SATISFIED, RUNNING),
        jnp.where(still_open.any(), RUNNING, VIOLATED),
    )
    blocked = jnp.where(moved, False, jnp.where(running, state.blocked | (candidates & harmed), state.blocked))
    status = jnp.where(running, status, state.status).astype(jnp.int32)
    held = None if held is None else jnp.where(moved, 0, held)
    return TaskState(node=node, blocked=blocked, status=status, held=held)
