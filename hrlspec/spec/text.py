"""Syntax tree to text, and a task tree back to SPECTRL."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from hrlspec.spec.syntax import (
    MAX_TEXT,
    Achieve,
    And,
    Choice,
    Condition,
    Ensuring,
    Formula,
    Not,
    Or,
    Prop,
    SpecError,
    Then,
    check,
)
from hrlspec.spec.tree import TaskTree


def to_text(formula: Formula) -> str:
    """The formula in SPECTRL, on one line, with no more parentheses than reading it back takes.

    ``parse(to_text(formula)) == formula`` for every formula.

    Raises:
        SpecError: if the formula is malformed or its text would be too long to read back.
    """
    check(formula)
    text = _task(formula)
    if len(text) > MAX_TEXT:
        raise formula.error(f"the text has {len(text):,} characters, at most {MAX_TEXT:,} can be read back")
    return text


def tree_to_text(tree: TaskTree, propositions: Sequence[str]) -> str:
    """SPECTRL for a task tree; compiled again it gives a tree with the same ``task_hash``.

    Args:
        tree: one task.
        propositions: names of the P propositions.

    Raises:
        SpecError: see :func:`tree_to_formula` and :func:`to_text`.
    """
    return to_text(tree_to_formula(tree, propositions))


def tree_to_formula(tree: TaskTree, propositions: Sequence[str]) -> Formula:
    """The syntax tree for a task tree: a choice between its first sub-tasks, each followed by what remains.

    Raises:
        SpecError: if the number of names is not P, the tree has no edge, an edge reaches nothing or a leaf does
            not accept.
    """
    tree = jax.tree.map(np.asarray, tree)
    if len(propositions) != tree.num_propositions:
        raise SpecError(f"found {len(propositions)} names, the tree is over {tree.num_propositions} propositions")
    branches: list[list[Formula]] = [[] for _ in range(tree.num_nodes)]
    # Children come after their parents: going backwards, what follows a node is complete when it is needed.
    for node in np.flatnonzero(tree.valid & (tree.parent >= 0))[::-1].tolist():
        reach, avoid = (
            [Prop(propositions[p]) for p in np.flatnonzero(row[node]).tolist()] for row in (tree.reach, tree.avoid)
        )
        if not reach:
            raise SpecError(f"the edge into node {node} reaches nothing")
        task: Formula = Achieve(And(tuple(reach)) if len(reach) > 1 else reach[0])
        if avoid:
            task = Ensuring(task, And(tuple(map(Not, avoid))) if len(avoid) > 1 else Not(avoid[0]))
        if branches[node]:
            rest = _choice(branches[node])
            task = Then((task, *rest.parts) if isinstance(rest, Then) else (task, rest))
        elif not tree.accepting[node]:
            raise SpecError(f"node {node} is a leaf but does not accept")
        branches[tree.parent[node]].append(task)
    if not branches[TaskTree.ROOT]:
        raise SpecError("the tree has no edge")
    return _choice(branches[TaskTree.ROOT])


def _choice(parts: list[Formula]) -> Formula:
    return Choice(tuple(reversed(parts))) if len(parts) > 1 else parts[0]


def _task(formula: Formula) -> str:
    match formula:
        case Achieve(goal=goal):
            return f"achieve {_condition(goal)}"
        case Ensuring(task=task, condition=condition):
            inner = _task(task)
            return f"{_wrap(inner, isinstance(task, Then | Choice))} ensuring {_condition(condition)}"
        case Then(parts=parts):
            return "; ".join(_wrap(_task(part), isinstance(part, Then | Choice)) for part in parts)
        case Choice(parts=parts):
            return " or ".join(_wrap(_task(part), isinstance(part, Choice)) for part in parts)
        case _:
            raise TypeError(type(formula).__name__)


def _condition(condition: Condition) -> str:
    match condition:
        case Prop(name=name):
            return name
        case Not(operand=operand):
            return f"not {_wrap(_condition(operand), isinstance(operand, And | Or))}"
        case And(parts=parts):
            return " and ".join(_wrap(_condition(part), isinstance(part, And | Or)) for part in parts)
        case Or(parts=parts):
            return " or ".join(_wrap(_condition(part), isinstance(part, Or)) for part in parts)
        case _:
            raise TypeError(type(condition).__name__)


def _wrap(text: str, needed: bool) -> str:
    return f"({text})" if needed else text
