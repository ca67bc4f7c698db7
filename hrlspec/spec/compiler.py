"""Formula to task tree: abstract graph, then its unfolding, padded (paper, "Sub-task Definition").

Axes: **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from hrlspec.spec.conditions import Vocabulary, forbidden, goals
from hrlspec.spec.graph import Graphs
from hrlspec.spec.syntax import (
    Achieve,
    Budget,
    Choice,
    Ensuring,
    Formula,
    SpecError,
    SpecWarning,
    Then,
    TooLarge,
    check,
)
from hrlspec.spec.tree import TaskTree

#: Largest N that ``compile_task`` pads to.
MAX_NODES = 4096


def compile_task(formula: Formula, propositions: Sequence[str], max_nodes: int, *, on_host: bool = False) -> TaskTree:
    """The task tree of a formula, padded to N nodes; children stand in the order of the text.

    Edges of one node with the same reach and avoid sets are one edge. An accepting node has no children: the task
    is satisfied on arrival. A sub-task that avoids what it reaches is unsatisfiable: such alternatives are left out
    with a warning, and refused where no other remains. A tree deeper than the planner's look-ahead is
    allowed; the look-ahead then ends at that depth.

    Args:
        formula: the task.
        propositions: names of the environment's P propositions, in its order.
        max_nodes: N.
        on_host: leave JAX alone, which starts its devices for its first array.

    Returns:
        One task with JAX arrays, or numpy's ``on_host``.

    Raises:
        SpecError: if the formula uses an unknown proposition, says what a task graph cannot (see
            ``docs/language.md``), or has a tree of more than N nodes.
        ValueError: if ``max_nodes`` is out of range.

    Warns:
        SpecWarning: where an edge shadows another ({a} beside {a, b}) or an alternative is unsatisfiable.
    """
    if not 2 <= max_nodes <= MAX_NODES:
        raise ValueError(f"max_nodes must be in 2..{MAX_NODES}, found {max_nodes}")
    check(formula)
    builder = _Builder(propositions)
    root = builder.whole(formula)
    graphs = builder.graphs
    size = graphs.tree_size(root)
    if size > max_nodes:
        shown = f"{size:,}" if size < 10**9 else "more than 1,000,000,000"
        raise formula.error(f"the task's tree has {shown} nodes, max_nodes is {max_nodes:,}")
    if shadow := builder.shadow(root):
        builder.notes.append(formula.error(f"one alternative shadows another: {shadow}; whichever holds first decides"))
    for note in builder.notes:
        warnings.warn(str(note), SpecWarning, stacklevel=2)
    tree = _unfold(root, graphs, len(propositions), max_nodes)
    if not on_host:
        tree = jax.tree.map(jnp.asarray, tree)
    return tree


class _Builder:
    """Builds the abstract graphs of a formula's parts and collects warnings."""

    def __init__(self, propositions: Sequence[str]) -> None:
        self.vocabulary = Vocabulary(propositions)
        self.budget = Budget()
        self.graphs = Graphs(self.budget)
        self.notes: list[SpecError] = []

    def whole(self, formula: Formula) -> int:
        """The graph of the whole formula; an accepting node ends the task."""
        try:
            return self.graphs.prune(self.build(formula))
        except TooLarge as error:
            raise formula.error(str(error)) from None

    def build(self, formula: Formula) -> int:
        """The graph of a part; its accepting nodes may have edges."""
        match formula:
            case Achieve(goal=goal):
                alternatives = goals(goal, self.vocabulary, self.budget)
                return self.graphs.node(False, {(reach, 0): self.graphs.DONE for reach in alternatives})
            case Ensuring(task=task, condition=condition):
                return self.ensure(formula, self.build(task), forbidden(condition, self.vocabulary))
            case Then(parts=parts):
                built = [self.build(part) for part in parts]
                result = built.pop()
                while built:
                    result = self.graphs.append(built.pop(), result)
                return result
            case Choice(parts=parts):
                return self.graphs.union([self.build(part) for part in parts])
            case _:
                raise TypeError(type(formula).__name__)

    def ensure(self, formula: Ensuring, task: int, avoid: int) -> int:
        """``ensuring`` on every edge; warns where alternatives become unsatisfiable, raises where all of them do."""
        result = self.graphs.ensure(task, avoid)
        if result == self.graphs.DEAD:
            raise formula.error("this task can never be done: 'ensuring' forbids what it has to reach")
        if any(reach & avoid for node in self.graphs.reachable(task) for reach, _ in self.graphs.edges[node]):
            self.notes.append(formula.error("alternatives left out: this 'ensuring' forbids what they have to reach"))
        return result

    def shadow(self, root: int) -> str:
        """An edge that reaches a strict part of what a sibling reaches, in words; empty if there is none."""
        for node in self.graphs.reachable(root):
            reaches = dict.fromkeys(reach for reach, _ in self.graphs.edges[node])
            for small in reaches:
                for large in reaches:
                    if small != large and small & large == small:
                        return f"{self.vocabulary.show(small)} beside {self.vocabulary.show(large)}"
        return ""


def _unfold(root: int, graphs: Graphs, num_propositions: int, max_nodes: int) -> TaskTree:
    """The tree in breadth-first order, numpy leaves."""
    parent = np.full(max_nodes, TaskTree.NO_NODE, np.int32)
    reach = np.zeros((max_nodes, num_propositions), bool)
    avoid = np.zeros((max_nodes, num_propositions), bool)
    accepting = np.zeros(max_nodes, bool)
    depth = np.zeros(max_nodes, np.int32)
    place = np.arange(num_propositions)

    def members(bits: int) -> Bool[np.ndarray, " P"]:
        return np.array([bits >> int(p) & 1 for p in place], bool)

    order = [root]
    for index, node in enumerate(order):
        for (goal, harm), to in graphs.edges[node].items():
            new = len(order)
            order.append(to)
            parent[new], depth[new] = index, depth[index] + 1
            reach[new], avoid[new] = members(goal), members(harm)
            accepting[new] = graphs.accepting[to]
    valid = np.arange(max_nodes) < len(order)
    return TaskTree(parent=parent, reach=reach, avoid=avoid, accepting=accepting, valid=valid, depth=depth)  # type: ignore[arg-type]
