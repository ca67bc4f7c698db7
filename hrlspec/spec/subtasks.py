"""The sub-tasks that a node of a task tree offers (paper, "Sub-task Definition", eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool

from hrlspec.spec.tree import TaskTree, subtask_avoid


class Subtask(NamedTuple):
    """Reach all of ``reach`` at once without touching ``avoid``.

    Attributes:
        node: where the edge leads.
        reach: p₊, names of propositions.
        avoid: p₋, the edge's own ``ensuring`` part and what the edges beside it reach, minus p₊.
    """

    node: int
    reach: tuple[str, ...]
    avoid: tuple[str, ...]


def subtasks(tree: TaskTree, node: int, propositions: Sequence[str] | None = None) -> list[Subtask]:
    """The sub-tasks of the edges out of ``node``, in order; none where the task is satisfied.

    Args:
        tree: one task, outside of any jit.
        node: a valid node of it.
        propositions: names of the P propositions; their indices, as text, if left out.

    Raises:
        ValueError: if there is no such node or the number of names is not P.
    """
    tree = jax.tree.map(np.asarray, tree)
    if not 0 <= node < tree.num_nodes or not tree.valid[node]:
        raise ValueError(f"the tree has no node {node}")
    names = tuple(map(str, range(tree.num_propositions))) if propositions is None else tuple(propositions)
    if len(names) != tree.num_propositions:
        raise ValueError(f"found {len(names)} names, the tree is over {tree.num_propositions} propositions")
    avoid = np.asarray(subtask_avoid(tree))

    def members(row: Bool[np.ndarray, " P"]) -> tuple[str, ...]:
        return tuple(name for name, holds in zip(names, row, strict=True) if holds)

    children = np.flatnonzero(tree.valid & (tree.parent == node)).tolist()
    return [Subtask(child, members(np.asarray(tree.reach)[child]), members(avoid[child])) for child in children]
