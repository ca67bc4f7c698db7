"""Test suites: named lists of tasks, read from SPECTRL text or made of trees.

Axes: **M** tasks, **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int, Int32, Shaped, UInt32

from hrlspec import spec
from hrlspec.spec import SpecError, TaskTree, bare_lines, parse, task_hashes, tree_to_text

MAX_NODES = 256
"""Default for the largest tree of a suite."""

NODES_MULTIPLE = 8
"""Suites are padded to a multiple of this, so that most of them share one compiled program."""


@dataclasses.dataclass(frozen=True)
class Suite:
    """M tasks to evaluate on.

    Attributes:
        name: under which results are reported.
        formulas: SPECTRL of each task.
        trees: the tasks, numpy leaves with leading axis M.
    """

    name: str
    formulas: tuple[str, ...]
    trees: TaskTree

    def __len__(self) -> int:
        """M."""
        return len(self.formulas)

    @property
    def depths(self) -> Int32[np.ndarray, " M"]:
        """Edges on each task's longest path, int ``[M]``."""
        return np.asarray(self.trees.depth).max(-1)

    @property
    def hashes(self) -> UInt32[np.ndarray, " M"]:
        """``task_hash`` of each task, uint32 ``[M]``."""
        return task_hashes(self.trees)

    def take(self, rows: Sequence[int] | Int[np.ndarray, " _"]) -> Suite:
        """Some of the tasks, under the same name and with the same N."""
        rows = np.asarray(rows)
        trees: TaskTree = jax.tree.map(lambda x: x[rows], self.trees)
        return Suite(self.name, tuple(self.formulas[row] for row in rows), trees)

    def padded(self, num_nodes: int) -> Suite:
        """The same tasks with N = ``num_nodes``, or more if they need it."""
        return Suite(self.name, self.formulas, _stack(_each(self.trees), num_nodes))


def suite_from_text(name: str, text: str, propositions: Sequence[str], *, max_nodes: int = MAX_NODES) -> Suite:
    """Reads a suite: one formula a line; ``#`` begins a comment, blank lines are skipped.

    Args:
        name: of the suite, and of the text in errors.
        text: the lines.
        propositions: names of the P propositions.
        max_nodes: tasks with larger trees are refused.

    Raises:
        SpecError: with the line and column in ``text`` of the first mistake, or if there is no formula.
    """
    formulas, trees = [], []
    for number, line in enumerate(bare_lines(text), 1):
        if not line.strip():
            continue
        try:
            trees.append(spec.compile_task(parse(line, line=number), propositions, max_nodes, on_host=True))
        except SpecError as error:
            raise SpecError(error.message, number, error.column or 1, name) from None
        formulas.append(" ".join(line.split()))
    if not formulas:
        raise SpecError("found no formula, expected one on each line", source=name)
    return Suite(name, tuple(formulas), _stack(trees))


def suite_from_trees(name: str, trees: TaskTree, propositions: Sequence[str]) -> Suite:
    """A suite of given trees (leading axis M), such as a sampler's."""
    each = _each(trees)
    return Suite(name, tuple(tree_to_text(tree, propositions) for tree in each), _stack(each))


def _each(trees: TaskTree) -> list[TaskTree]:
    """The trees of a stack, numpy leaves."""
    trees = jax.tree.map(np.asarray, trees)
    return [jax.tree.map(lambda x, i=i: x[i], trees) for i in range(trees.parent.shape[0])]


def _stack(trees: Sequence[TaskTree], least: int = 0) -> TaskTree:
    """One stack with the smallest N that holds them all, rounded up, and is at least so large."""
    numpy_trees = [jax.tree.map(np.asarray, tree) for tree in trees]
    # Parents come before their children and padding last, so nodes beyond the last valid one can go.
    needed = max(int(np.flatnonzero(tree.valid).max()) + 1 for tree in numpy_trees)
    size = max(-(-needed // NODES_MULTIPLE) * NODES_MULTIPLE, least)
    stacked: TaskTree = jax.tree.map(lambda *leaves: np.stack(leaves), *[_resize(tree, size) for tree in numpy_trees])
    return stacked


def _resize(tree: TaskTree, size: int) -> TaskTree:
    """The same task with N = ``size``, cutting or adding padding."""

    def fit(leaf: Shaped[np.ndarray, "before ..."], fill: int) -> Shaped[np.ndarray, "after ..."]:
        fitted = np.full((size, *leaf.shape[1:]), fill, leaf.dtype)
        rows = min(size, len(leaf))
        fitted[:rows] = leaf[:rows]
        return fitted

    leaves: dict[str, Any] = {name: fit(getattr(tree, name), 0) for name in ("reach", "avoid", "depth")}
    leaves |= {name: fit(getattr(tree, name), False) for name in ("accepting", "valid")}
    return TaskTree(parent=fit(np.asarray(tree.parent), TaskTree.NO_NODE), **leaves)  # type: ignore[arg-type]
