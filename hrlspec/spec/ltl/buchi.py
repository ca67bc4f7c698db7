"""Infinite tasks: from a formula to an automaton whose accepting transitions count.

A formula is read as conjunctions and disjunctions of parts. Each part is one of

* **co-safe** (no ``G``): satisfied once and for all by some finite trace;
* **safety** (no ``F``, ``U``, ``M``): violated by some finite trace, or never;
* **recurrence** ``G F φ``, φ co-safe: again and again;
* **response** ``G φ``, φ co-safe: what is owed is paid, again and again;
* **persistence** ``F φ``, φ made of parts like the whole formula, such as ``F G a``: from some step on, φ holds.

When that step has come is for the agent to say, by a jump: until then φ asks for nothing, after that it must hold, and
each of its rounds meets the part. All else is deterministic.

A transition accepts when a round of the conjunction is complete: each part that is not safety has been met since the
last one, in the order of the text, at most one round a step. A part is met by the step with which it is satisfied, a
disjunction by a round of one of its alternatives; one that was met begins anew with the next step; a step may meet
several parts that follow one another.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Collection, Iterable, Iterator, Sequence
from typing import Any, TypeAlias

from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.ltl.merging import explore, merged
from hrlspec.spec.ltl.syntax import Binary, Formula, Nary, Unary
from hrlspec.spec.ltl.text import ltl_text
from hrlspec.spec.ltl.translate import NOTHING_OWED, Progression, labels_of
from hrlspec.spec.syntax import SpecError

_PartState: TypeAlias = tuple[Any, ...]
"""What a part remembers: remainders, places in rounds, states of its own parts; hashable."""


class _Part(abc.ABC):
    """A part of a formula, as an automaton of its own."""

    @property
    @abc.abstractmethod
    def start(self) -> _PartState:
        """Where it begins."""

    @abc.abstractmethod
    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        """Where it is after a label and whether that met it; ``None`` where it is violated."""

    def jumps(self, state: _PartState) -> Iterator[_PartState]:
        """Where it may be instead, before the next label."""
        yield from ()


@dataclasses.dataclass(frozen=True)
class _Once(_Part):
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
class _Safety(_Part):
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
class _Response(_Part):
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


@dataclasses.dataclass(frozen=True)
class _Eventually(_Part):
    """A persistence part: nothing is asked before the jump, the whole of what persists after it."""

    what: _Round

    @property
    def start(self) -> _PartState:
        return ()

    def after(self, state: _PartState, label: int) -> tuple[_PartState, bool] | None:
        return self.what.after(state, label) if state else (state, False)

    def jumps(self, state: _PartState) -> Iterator[_PartState]:
        if state:
            yield from self.what.jumps(state)
        else:
            yield self.what.start


def to_buchi(
    formula: Formula,
    propositions: Sequence[str],
    possible_labels: Iterable[Collection[str]] | None = None,
) -> Automaton:
    """An automaton with accepting transitions; see the module for what is read and what counts.

    Without persistence parts it is deterministic; with them it jumps into copies that wait for one of them less. It is
    limit-deterministic, for nothing accepts before the last jump, unless a disjunction has an alternative without them.

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
    start: _PartState | None = root.start

    def after(state: _PartState | None, label: int) -> tuple[_PartState | None, bool]:
        """``None`` once the formula is violated."""
        return (None if state is None else root.after(state, label)) or (None, False)

    def jumps_of(state: _PartState | None) -> Iterable[_PartState | None]:
        return () if state is None else root.jumps(state)

    successors, marks, jumps, rejecting = merged(*explore(start, after, jumps_of, len(distinct)))
    return Automaton(labels, successors[:, columns], None, rejecting, marks[:, columns], jumps if any(jumps) else ())


def _parts(operator: str, formula: Formula) -> list[Formula]:
    """What a conjunction or disjunction is made of, nested ones included."""
    formula = _opened(formula)
    if isinstance(formula, Nary) and formula.operator == operator:
        return [part for each in formula.parts for part in _parts(operator, each)]
    return [formula]


def _opened(formula: Formula) -> Formula:
    """A formula that is none of the simple parts, with no negation or implication in front."""
    return formula if _is_cosafe(formula) or _is_safety(formula) else _pushed(formula)


def _pushed(formula: Formula) -> Formula:
    match formula:
        case Binary("->", left, right):
            return Nary("|", (Unary("!", left), right))
        case Binary("<->", left, right):
            return Nary("&", (Binary("->", left, right), Binary("->", right, left)))
        case Unary("!", Unary("!", inner)):
            return _pushed(inner)
        case Unary("!", Unary("F", inner)):
            return Unary("G", _pushed(Unary("!", inner)))
        case Unary("!", Unary("G", inner)):
            return Unary("F", _pushed(Unary("!", inner)))
        case Unary("!", Nary(operator, parts)):
            return Nary("|" if operator == "&" else "&", tuple(Unary("!", part) for part in parts))
        case Unary("!", Binary("->" | "<->", _, _) as inner):
            return _pushed(Unary("!", _pushed(inner)))
    return formula


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
        case Unary("F", inner):
            return _Eventually(_round(progression, inner))
    raise SpecError(
        f"{ltl_text(part)} is none of what is read for ever: parts without G, parts without F and U, G F φ or G φ with "
        "a φ that has no G, and F φ with a φ made of such parts"
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
class _Round(_Part):
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

    def jumps(self, state: _PartState) -> Iterator[_PartState]:
        at, *places = state
        for number, (part, place) in enumerate(zip(self.parts, places, strict=True)):
            for target in part.jumps(place):
                yield at, *places[:number], target, *places[number + 1 :]


@dataclasses.dataclass(frozen=True)
class _Either(_Part):
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

    def jumps(self, state: _PartState) -> Iterator[_PartState]:
        for number, (some, place) in enumerate(zip(self.alternatives, state, strict=True)):
            for target in () if place is None else some.jumps(place):
                yield *state[:number], target, *state[number + 1 :]


def _comes_again(part: _Part) -> bool:
    return isinstance(part, _Once) and part.again
