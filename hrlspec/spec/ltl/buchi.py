"""Infinite tasks: from a formula to a deterministic automaton whose accepting transitions count.

A formula is read as conjunctions and disjunctions of parts. Each part is one of

* **co-safe** (no ``G``): satisfied once and for all by some finite trace;
* **safety** (no ``F``, ``U``, ``M``): violated by some finite trace, or never;
* **recurrence** ``G F φ``, φ co-safe: again and again;
* **response** ``G φ``, φ co-safe: what is owed is paid, again and again.

A transition accepts when a round of the conjunction is complete: each part that is not safety has been met since the
last one, in the order of the text, at most one round a step. A part is met by the step with which it is satisfied, a
disjunction by a round of one of its alternatives; one that was met begins anew with the next step; a step may meet
several parts that follow one another.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np
from jaxtyping import Bool, Int, Int32

from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.ltl.syntax import Binary, Formula, Nary, Unary
from hrlspec.spec.ltl.text import ltl_text
from hrlspec.spec.ltl.translate import MAX_STATES, NOTHING_OWED, Progression, labels_of
from hrlspec.spec.syntax import SpecError

_PartState: TypeAlias = tuple[Any, ...]
"""What a part remembers: remainders, places in rounds, states of its own parts; hashable."""


class _Part(Protocol):
    """A part of a formula, as an automaton of its own."""

    @property
    def start(self) -> _PartState:
        """Where it begins."""

    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        """Where it is after a label and whether that met it; ``None`` where it is violated."""


@dataclasses.dataclass(frozen=True)
class _Once:
    """A co-safe part: met by the step that satisfies it and all after that; or again and again, by that step alone."""

    progression: Progression
    formula: Formula
    again: bool = False

    @property
    def start(self) -> _PartState:
        return (self.progression.start(self.formula),)

    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        left = self.progression.after(state[0], label)
        if left == NOTHING_OWED:
            return (self.start if self.again else (left,)), True
        return ((left,), False) if left else None


@dataclasses.dataclass(frozen=True)
class _Safety:
    """A safety part, by its negation, whose satisfaction violates it. No round waits for it."""

    progression: Progression
    negation: Formula

    @property
    def start(self) -> _PartState:
        return (self.progression.start(self.negation),)

    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        left = self.progression.after(state[0], label)
        return None if left == NOTHING_OWED else ((left,), True)


@dataclasses.dataclass(frozen=True)
class _Response:
    """A response: met when all is paid that was owed when it was met before (Miyano and Hayashi's breakpoints)."""

    progression: Progression
    formula: Formula

    @property
    def start(self) -> _PartState:
        return NOTHING_OWED, NOTHING_OWED

    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        progression = self.progression
        old, new = (progression.after(owed, label) for owed in state)
        new = progression.both(new, progression.after(progression.start(self.formula), label))
        if not old or not new:
            return None
        if old == NOTHING_OWED:
            return (new, old), True
        return (old, new), False


def to_buchi(
    formula: Formula,
    propositions: Sequence[str],
    possible_labels: Iterable[Collection[str]] | None = None,
) -> Automaton:
    """A deterministic automaton with accepting transitions; see the module for what is read and what counts.

    Args:
        formula: of linear temporal logic.
        propositions: all that labels may name.
        possible_labels: the sets of propositions that can hold together; all subsets of the formula's own if not given.

    Raises:
        SpecError: the formula names other propositions; a part is none of those that are read, and the message says
            which; or the automaton is too large.
        ValueError: a possible label names other propositions, or there is none.
    """
    labels, distinct, columns = labels_of(formula, propositions, possible_labels)
    root = _round(Progression(distinct), formula)
    successors, marks, rejecting = _merged(*_explore(root, len(distinct)))
    return Automaton(labels, successors[:, columns], None, rejecting, marks[:, columns])


def _parts(operator: str, formula: Formula) -> list[Formula]:
    """What a conjunction or disjunction is made of, nested ones included."""
    if isinstance(formula, Nary) and formula.operator == operator:
        return [part for each in formula.parts for part in _parts(operator, each)]
    return [formula]


def _round(progression: Progression, formula: Formula) -> _Round:
    return _Round(tuple(_part(progression, part) for part in _parts("&", formula)))


def _part(progression: Progression, part: Formula) -> _Part:
    """What kind of part a conjunct is."""
    if _is_cosafe(part):
        return _Once(progression, part)
    if _is_safety(part):
        return _Safety(progression, Unary("!", part))
    alternatives = _parts("|", part)
    if len(alternatives) > 1:
        return _Either(tuple(_round(progression, some) for some in alternatives))
    match part:
        case Unary("G", Unary("F", inner)) if _is_cosafe(inner):
            return _Once(progression, Unary("F", inner), again=True)
        case Unary("G", inner) if _is_cosafe(inner):
            return _Response(progression, inner)
        case Unary("F", Unary("G", inner)) if _is_safety(inner):
            raise SpecError(f"{ltl_text(part)} asks to stay for ever, which is not among what is learned")
    raise SpecError(
        f"{ltl_text(part)} is none of what is read for ever: parts without G, parts without F and U, and G F φ or G φ "
        "with a φ that has no G"
    )


def _is_cosafe(formula: Formula, positive: bool = True) -> bool:
    """Whether it has no ``G``, ``R`` or ``W`` once negations stand before propositions alone."""
    match formula:
        case Unary("!", operand):
            return _is_cosafe(operand, not positive)
        case Unary("F", _) if not positive:
            return False
        case Unary("G", _) if positive:
            return False
        case Binary("U" | "M", _, _) if not positive:
            return False
        case Binary("R" | "W", _, _) if positive:
            return False
        case Binary("->", left, right):
            return _is_cosafe(left, not positive) and _is_cosafe(right, positive)
        case Binary("<->", left, right):
            return all(_is_cosafe(side, sign) for side in (left, right) for sign in (True, False))
    return all(_is_cosafe(child, positive) for child in formula.children)


def _is_safety(formula: Formula) -> bool:
    return _is_cosafe(formula, positive=False)


@dataclasses.dataclass(frozen=True)
class _Round:
    """A conjunction: met when all of its parts but safety have been met, one after the other."""

    parts: tuple[_Part, ...]

    @property
    def start(self) -> _PartState:
        return (0, *(part.start for part in self.parts))

    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        at, *before = state
        waited = [number for number, part in enumerate(self.parts) if not isinstance(part, _Safety)]
        places, met = [], []
        for number, (part, place) in enumerate(zip(self.parts, before, strict=True)):
            # What comes again and again is followed only while it is waited for.
            follows = not _comes_again(part) or number == waited[at]
            step = part.after(place, label) if follows else (place, False)
            if step is None:
                return None
            places.append(step[0])
            met.append(step[1])
        complete = not waited
        while not complete and met[waited[at]]:
            at += 1
            complete = at == len(waited)
            if not complete and _comes_again(part := self.parts[waited[at]]):
                first = part.after(part.start, label)
                met[waited[at]] = first is not None and first[1]
        return (0 if complete else at, *places), complete


@dataclasses.dataclass(frozen=True)
class _Either:
    """A disjunction: met by each round of an alternative, violated when all of them are."""

    alternatives: tuple[_Round, ...]

    @property
    def start(self) -> _PartState:
        return tuple(some.start for some in self.alternatives)

    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        steps = [
            None if before is None else some.after(before, label)
            for some, before in zip(self.alternatives, state, strict=True)
        ]
        if not any(steps):
            return None
        return tuple(step and step[0] for step in steps), any(step and step[1] for step in steps)


def _comes_again(part: _Part) -> bool:
    return isinstance(part, _Once) and part.again


def _explore(root: _Part, num_labels: int) -> tuple[Int[np.ndarray, "Q L"], Bool[np.ndarray, "Q L"]]:
    """Successors and marks of all states that can be reached; state 1 is where the formula is violated."""
    numbers, states = {root.start: 0}, [root.start, root.start]
    successors, marks = [[1] * num_labels, [1] * num_labels], [[False] * num_labels, [False] * num_labels]
    at = 0
    while at < len(states):
        for label in range(num_labels) if at != 1 else ():
            found = root.after(states[at], label)
            if found is None:
                continue
            after, marks[at][label] = found
            if after not in numbers:
                if len(states) == MAX_STATES:
                    raise SpecError(f"the formula is too large: its automaton has more than {MAX_STATES:,} states")
                numbers[after] = len(states)
                states.append(after)
                successors.append([1] * num_labels)
                marks.append([False] * num_labels)
            successors[at][label] = numbers[after]
        at += 1
    return np.array(successors), np.array(marks)


def _merged(
    successors: Int[np.ndarray, "Q L"], marks: Bool[np.ndarray, "Q L"]
) -> tuple[Int32[np.ndarray, "Q L"], Bool[np.ndarray, "Q L"], int | None]:
    """Merges states that no continuation tells apart, numbered as they are reached; and which one is rejecting, if any.

    Also rejecting is a state from which no accepting transition can be reached.
    """
    alive: Bool[np.ndarray, " Q"] = np.asarray(marks.any(1))
    while not np.array_equal(wider := alive | alive[successors].any(1), alive):
        alive = wider
    marks = marks & alive[:, None]
    kind = np.unique(np.column_stack([alive, marks]), axis=0, return_inverse=True)[1].reshape(-1)
    while True:
        finer = np.unique(np.column_stack([kind, kind[successors]]), axis=0, return_inverse=True)[1].reshape(-1)
        if finer.max() == kind.max():
            break
        kind = finer
    example = dict(zip(*np.unique(kind, return_index=True), strict=True))
    number, order = {int(kind[0]): 0}, [int(kind[0])]
    for group in order:  # Grows while it is read.
        for after in kind[successors[example[group]]].tolist():
            if after not in number:
                number[after] = len(order)
                order.append(after)
    rows = [int(example[group]) for group in order]
    dead = [place for place, row in enumerate(rows) if not alive[row]]
    table = np.array([[number[group] for group in kind[successors[row]].tolist()] for row in rows], np.int32)
    return table, marks[rows], dead[0] if dead else None
