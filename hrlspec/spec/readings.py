"""A SPECTRL formula as an automaton, in either of its readings (``docs/semantics.md``).

The exact one allows what was begun to be begun again; it is that of an LTL formula. The committed one is the monitor.

Axes: **Q** states, **L** labels, **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Hashable, Iterable, Sequence
from typing import Any

import jax
import numpy as np

from hrlspec.spec.ltl import syntax as ltl
from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.ltl.translate import MAX_STATES, minimal, to_automaton
from hrlspec.spec.monitor import RUNNING, SATISFIED, VIOLATED, TaskState, advance, initial
from hrlspec.spec.syntax import (
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

MAX_STEPS = 64
"""Longest chain of sub-tasks in the exact reading; what reads formulas in LTL is recursive."""


@dataclasses.dataclass(frozen=True)
class _Goal:
    """What must hold from some step on: a formula in LTL, and how many sub-tasks follow one another in it."""

    formula: ltl.Formula
    steps: int


def to_ltl(formula: Formula) -> ltl.Formula:
    """The formula in LTL over finite traces that says the same: `satisfies_ltl` of it is `satisfies`.

    Where alternatives go on with the same sub-tasks they share these, so that the tree is small; its text may not be.

    Args:
        formula: any formula, also such as ``compile_task`` refuses.

    Raises:
        SpecError: if the formula is malformed, has more than `MAX_STEPS` sub-tasks in a row, or a proposition's name
            reads as an operator of LTL.
    """
    check(formula)
    return _goal(formula, None, None).formula


def exact_automaton(
    formula: Formula, propositions: Sequence[str], possible_labels: Iterable[Collection[str]] | None = None
) -> Automaton:
    """The minimal automaton of the exact semantics: it accepts a trace exactly if `satisfies` does.

    Args:
        formula: any formula, also such as ``compile_task`` refuses.
        propositions: all that labels may name.
        possible_labels: the sets of propositions that can hold together; all subsets of the formula's own if not given.

    Raises:
        SpecError: see `to_ltl`; the formula names other propositions, or its automaton is too large.
        ValueError: a possible label names other propositions, or there is none.
    """
    return to_automaton(to_ltl(formula), propositions, possible_labels)


def committed_automaton(
    tree: TaskTree, propositions: Sequence[str], possible_labels: Iterable[Collection[str]]
) -> Automaton:
    """The minimal automaton of the committed reading, made of `monitor_automaton`.

    It is violated where no possible label helps any more, which the monitor, who knows nothing of these, may not see.

    Args:
        tree: one task over these propositions.
        propositions: names of the P propositions.
        possible_labels: the sets of them that can hold together.

    Raises:
        SpecError: there are too many states.
    """
    found, _ = monitor_automaton(tree, propositions, possible_labels)
    return Automaton(found.labels, *minimal(found.successors))


def monitor_automaton(
    tree: TaskTree, propositions: Sequence[str], possible_labels: Iterable[Collection[str]]
) -> tuple[Automaton, TaskTree]:
    """The monitor state by state, as it runs while no sub-task is assigned.

    An automaton does not know what is assigned, which for the monitor decides between edges that are met at once.

    Args:
        tree: one task over these propositions.
        propositions: names of the P propositions.
        possible_labels: the sets of them that can hold together.

    Returns:
        The automaton, of which a state is a node and which of its edges are blocked; and what the agent is to see in
        each state, with which `automata_of` makes it act as on the tree: leading axis Q, numpy leaves.

    Raises:
        SpecError: there are too many states.
    """
    labels = tuple(dict.fromkeys(map(frozenset, possible_labels)))
    holds = np.array([[name in label for name in propositions] for label in labels])
    start: TaskState = jax.device_get(initial(tree))
    states = [start, dataclasses.replace(start, status=np.int32(SATISFIED))]  # type: ignore[arg-type]
    numbers = {_key(state): number for number, state in enumerate(states)}
    rows = [[0] * len(labels), [1] * len(labels)]
    for number, state in enumerate(states):  # grows while it is read
        if state.status != RUNNING:
            continue
        after = jax.device_get(_after_each(tree, state, holds, TaskTree.NO_NODE))
        for column in range(len(labels)):
            onward = jax.tree.map(lambda x, column=column: x[column], after)
            if _key(onward) not in numbers:
                if len(states) == MAX_STATES:
                    raise SpecError(f"the task is too large: its automaton has more than {MAX_STATES:,} states")
                numbers[_key(onward)] = len(states)
                states.append(onward)
                rows.append([numbers[_key(onward)]] * len(labels))
            rows[number][column] = numbers[_key(onward)]
    host: TaskTree = jax.tree.map(np.asarray, tree)
    trees: TaskTree = jax.tree.map(lambda *x: np.stack(x), *(_remaining(host, state) for state in states))
    return Automaton(labels, np.array(rows, np.int32), 1, numbers.get(VIOLATED)), trees


_after_each = jax.jit(jax.vmap(advance, in_axes=(None, None, 0, None)))


def _key(state: TaskState) -> Hashable:
    """All that counts of a state of the monitor; of one that has ended, how."""
    if state.status != RUNNING:
        return int(state.status)
    return int(state.node), np.asarray(state.blocked).tobytes()


def _remaining(tree: TaskTree, state: TaskState) -> TaskTree:
    """The subtree at the current node without its blocked edges; a root alone where the task has ended."""
    node, ended = (int(state.node), False) if state.status == RUNNING else (TaskTree.ROOT, True)
    kept = np.arange(tree.num_nodes) == node
    for child in np.flatnonzero(tree.edges & ~(ended | np.asarray(state.blocked))):  # parents come first
        kept[child] |= kept[tree.parent[child]]
    order = np.flatnonzero(kept)
    beside = np.asarray(tree.parent == node)
    # What a blocked edge would reach still belongs to the p₋ of those beside it.
    closed = np.asarray(tree.reach)[beside & state.blocked].any(0)
    avoid = tree.avoid | (beside[:, None] & closed & ~tree.reach)
    number = np.full(tree.num_nodes, TaskTree.NO_NODE, np.int32)
    number[order[1:]] = np.searchsorted(order, tree.parent[order[1:]])
    below = kept & (np.arange(tree.num_nodes) != node)
    leaves = {
        "parent": number,
        "reach": tree.reach & below[:, None],
        "avoid": avoid & below[:, None],
        "accepting": tree.accepting & below,
        "valid": kept,
        "depth": np.where(kept, tree.depth - tree.depth[node], 0),
    }
    padding = np.setdiff1d(np.arange(tree.num_nodes), order)
    moved: dict[str, Any] = {name: leaf[np.concatenate([order, padding])] for name, leaf in leaves.items()}
    return TaskTree(**moved)


def _goal(formula: Formula, always: ltl.Formula | None, then: _Goal | None) -> _Goal:
    """What holds at a step exactly if from there on the formula is done under ``always``, and then ``then``."""
    match formula:
        case Achieve(goal=goal):
            return _achieved(formula, _condition(goal), always, then)
        case Ensuring(task=task, condition=condition):
            own = _condition(condition)
            return _goal(task, own if always is None else ltl.Nary("&", (always, own)), then)
        case Then(parts=parts):
            for part in reversed(parts):
                then = _goal(part, always, then)
            assert then is not None
            return then
        case Choice(parts=parts):
            goals = [_goal(part, always, then) for part in parts]
            return _Goal(ltl.Nary("|", tuple(one.formula for one in goals)), max(one.steps for one in goals))
        case _:
            raise TypeError(type(formula).__name__)


def _achieved(formula: Formula, goal: ltl.Formula, always: ltl.Formula | None, then: _Goal | None) -> _Goal:
    """``always U (goal & always & X (always U then))``: φ lasts until what follows it begins."""
    steps = 1 if then is None else 1 + then.steps
    if steps > MAX_STEPS:
        raise formula.error(f"more than {MAX_STEPS} sub-tasks in a row")
    parts = [goal] if always is None else [goal, always]
    if then is not None:
        parts.append(ltl.Unary("X", _until(always, then.formula)))
    return _Goal(_until(always, parts[0] if len(parts) == 1 else ltl.Nary("&", tuple(parts))), steps)


def _until(always: ltl.Formula | None, goal: ltl.Formula) -> ltl.Formula:
    """``always U goal``; what is that already stays as it is."""
    if always is None:
        return goal if isinstance(goal, ltl.Unary) and goal.operator == "F" else ltl.Unary("F", goal)
    return goal if isinstance(goal, ltl.Binary) and goal.left is always else ltl.Binary("U", always, goal)


def _condition(condition: Condition) -> ltl.Formula:
    match condition:
        case Prop(name=name):
            return ltl.Proposition(name, position=condition.position)
        case Not(operand=operand):
            return ltl.Unary("!", _condition(operand))
        case And(parts=parts):
            return ltl.Nary("&", tuple(map(_condition, parts)))
        case Or(parts=parts):
            return ltl.Nary("|", tuple(map(_condition, parts)))
        case _:
            raise TypeError(type(condition).__name__)
