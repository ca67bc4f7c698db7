"""Formula to minimal automaton, by progression: what is left of a formula after a step.

In negation normal form a formula is monotone in its temporal subformulas, so what is left of it is a disjunction of
conjunctions of those, without redundant ones: a set of minimal sets, of which there is one for each meaning. Such a set
is a state; states that no continuation tells apart are merged at the end.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Sequence
from typing import TypeAlias

import numpy as np

from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.ltl.syntax import Binary, Constant, Formula, Nary, Proposition, Unary, propositions_of
from hrlspec.spec.syntax import SpecError

MAX_STATES = 10_000
"""Most states before states are merged."""
MAX_WORK = 20_000_000
"""Most comparisons of alternatives; some ten seconds of work."""
MAX_FREE = 12
"""Most propositions of a formula for which all combinations are tried as labels."""

Remainder: TypeAlias = frozenset[int]
"""What is left: alternatives, each a set of obligations as bits of an integer."""
NOTHING_OWED: Remainder = frozenset({0})
_FALSE: Remainder = frozenset()

_Term: TypeAlias = tuple[str | int, ...]
"""An interned formula in negation normal form: its kind, then the numbers of its operands (of literals, the name)."""


def to_automaton(
    formula: Formula,
    propositions: Sequence[str],
    possible_labels: Iterable[Collection[str]] | None = None,
) -> Automaton:
    """The minimal automaton of the finite reading: a trace is accepted when one of its non-empty prefixes satisfies.

    Args:
        formula: of linear temporal logic.
        propositions: all that labels may name.
        possible_labels: the sets of propositions that can hold together; all subsets of the formula's own if not given.

    Raises:
        SpecError: the formula names other propositions, or its automaton is too large; the message says how large.
        ValueError: a possible label names other propositions, or there is none.
    """
    labels, distinct, columns = labels_of(formula, propositions, possible_labels)
    successors = _explore(Progression(distinct), formula)
    successors, accepting, rejecting = minimal(successors)
    return Automaton(labels, successors[:, columns], accepting, rejecting)


def labels_of(
    formula: Formula, propositions: Sequence[str], possible_labels: Iterable[Collection[str]] | None
) -> tuple[tuple[frozenset[str], ...], list[frozenset[str]], list[int]]:
    """The possible labels, those that the formula tells apart, and which of these each of the former is.

    Raises:
        SpecError: the formula names other propositions, or too many to try all combinations.
        ValueError: a possible label names other propositions, or there is none.
    """
    used = propositions_of(formula)
    for name in used:
        if name not in propositions:
            raise SpecError(f"{name!r} is no proposition, expected some of {', '.join(propositions)}")
    labels = _labels(used, propositions, possible_labels)
    # What the formula does not name makes no difference: labels that differ in nothing else share their successors.
    seen = [label & frozenset(used) for label in labels]
    distinct = list(dict.fromkeys(seen))
    return labels, distinct, [distinct.index(label) for label in seen]


def _labels(
    used: Sequence[str], propositions: Sequence[str], possible: Iterable[Collection[str]] | None
) -> tuple[frozenset[str], ...]:
    if possible is None:
        if len(used) > MAX_FREE:
            raise SpecError(
                f"the formula has {len(used)} propositions, of which at most {MAX_FREE} are tried in all combinations; "
                "say which labels can occur"
            )
        subsets = (itertools.combinations(used, size) for size in range(len(used) + 1))
        return tuple(map(frozenset, itertools.chain.from_iterable(subsets)))
    labels = tuple(dict.fromkeys(map(frozenset, possible)))
    if not labels:
        raise ValueError("there is no possible label; the empty set is one where nothing may hold")
    for name in sorted(frozenset().union(*labels) - set(propositions)):
        raise ValueError(f"possible labels name {name!r}, which is no proposition")
    return labels


class Progression:
    """Terms, their progression by labels, and what is left of them."""

    def __init__(self, labels: Sequence[frozenset[str]]) -> None:
        self.labels = labels
        self._terms: list[_Term] = []
        self._numbers: dict[_Term, int] = {}
        self._bits: dict[int, int] = {}
        self._obligations: list[int] = []
        self._done_when_over = 0  # bits of the obligations that hold when no step is left
        self._steps: dict[tuple[int, int], Remainder] = {}
        self._clauses: dict[tuple[int, int], Remainder] = {}
        self._normals: dict[tuple[int, bool], tuple[Formula, int]] = {}
        self._work = 0

    def start(self, formula: Formula) -> Remainder:
        """Everything is owed, and a step must come."""
        return frozenset({self._obligation(self._intern("some", self._normal(formula, True)))})

    def after(self, remainder: Remainder, label: int) -> Remainder:
        """What is left after one more label, by its number."""
        return self._minimise(frozenset().union(*(self._clause(clause, label) for clause in remainder)))

    def holds_when_over(self, remainder: Remainder) -> bool:
        """Whether nothing is owed if no step is left."""
        return any(not clause & ~self._done_when_over for clause in remainder)

    def _intern(self, *term: str | int) -> int:
        if term not in self._numbers:
            self._numbers[term] = len(self._terms)
            self._terms.append(term)
        return self._numbers[term]

    def _normal(self, formula: Formula, positive: bool) -> int:
        """The number of a formula, or of its negation, in negation normal form."""
        key = id(formula), positive
        if key not in self._normals:
            # With the formula, so that no other one comes to have its identity.
            self._normals[key] = formula, self._normalised(formula, positive)
        return self._normals[key][1]

    def _normalised(self, formula: Formula, positive: bool) -> int:
        match formula:
            case Constant(value):
                return self._intern("true" if value == positive else "false")
            case Proposition(name):
                return self._intern("is" if positive else "not", name)
            case Unary("!", operand):
                return self._normal(operand, not positive)
            case Unary("X", operand):
                # The negation of "there is a next step, and φ then" is "if there is one, not φ then".
                return self._intern("next" if positive else "weak next", self._normal(operand, positive))
            case Unary(operator, operand):
                inner = self._normal(operand, positive)
                if (operator == "F") == positive:  # true U φ
                    return self._intern("until", self._intern("true"), inner)
                return self._intern("release", self._intern("false"), inner)  # G φ is false R φ
            case Nary(operator, parts):
                inner_parts = [self._normal(part, positive) for part in parts]
                return self._intern("and" if (operator == "&") == positive else "or", *inner_parts)
            case Binary(operator, left, right):
                return self._binary(operator, left, right, positive)
        raise TypeError(f"to_automaton takes a formula, found {type(formula).__name__}")

    def _binary(self, operator: str, left: Formula, right: Formula, positive: bool) -> int:
        first, second = self._normal(left, positive), self._normal(right, positive)
        if operator in ("->", "<->"):
            if operator == "->":
                return self._intern("or" if positive else "and", self._normal(left, not positive), second)
            # Of "if and only if" the negation is that exactly one holds.
            one = self._normal(left, True), self._normal(right, positive)
            other = self._normal(left, False), self._normal(right, not positive)
            return self._intern("or", self._intern("and", *one), self._intern("and", *other))
        until = (operator in ("U", "M")) == positive
        if operator == "W":  # φ W ψ is ψ R (φ | ψ)
            first, second = second, self._intern("or" if positive else "and", first, second)
        elif operator == "M":  # φ M ψ is ψ U (φ & ψ)
            first, second = second, self._intern("and" if positive else "or", first, second)
        return self._intern("until" if until else "release", first, second)

    def _obligation(self, term: int) -> int:
        """The bit of a term that is owed from the next step on."""
        if term not in self._bits:
            self._bits[term] = 1 << len(self._obligations)
            self._obligations.append(term)
            if self._terms[term][0] in ("release", "any"):
                self._done_when_over |= self._bits[term]
        return self._bits[term]

    def _spend(self, comparisons: int) -> None:
        self._work += comparisons
        if self._work > MAX_WORK:
            raise SpecError(f"the formula is too large: more than {MAX_WORK:,} alternatives to compare")

    def _minimise(self, clauses: Collection[int]) -> Remainder:
        """Without the alternatives that owe all that another owes, and more."""
        kept: list[int] = []
        for clause in sorted(set(clauses), key=int.bit_count):
            self._spend(1 + len(kept))
            if all(smaller & ~clause for smaller in kept):
                kept.append(clause)
        return frozenset(kept)

    def _either(self, first: Remainder, second: Remainder) -> Remainder:
        return self._minimise(first | second)

    def both(self, first: Remainder, second: Remainder) -> Remainder:
        """All that either owes."""
        self._spend(len(first) * len(second))
        return self._minimise([x | y for x in first for y in second])

    def _owed(self, kind: str, *operands: int) -> Remainder:
        return frozenset({self._obligation(self._intern(kind, *operands))})

    def _clause(self, clause: int, label: int) -> Remainder:
        """What is left of obligations that are all owed."""
        key = clause, label
        if key not in self._clauses:
            result = NOTHING_OWED
            for number, term in enumerate(self._obligations):
                if clause >> number & 1:
                    result = self.both(result, self._step(term, label))
            self._clauses[key] = result
        return self._clauses[key]

    def _step(self, term: int, label: int) -> Remainder:
        """What is left of a term after a label."""
        key = term, label
        if key not in self._steps:
            self._steps[key] = self._stepped(*self._terms[term], label=label)
        return self._steps[key]

    def _stepped(self, kind: str | int, *operands: str | int, label: int) -> Remainder:
        if kind in ("is", "not"):
            return NOTHING_OWED if (operands[0] in self.labels[label]) == (kind == "is") else _FALSE
        if kind in ("true", "false"):
            return NOTHING_OWED if kind == "true" else _FALSE
        terms = [operand for operand in operands if isinstance(operand, int)]
        if kind in ("next", "weak next"):
            return self._owed("some" if kind == "next" else "any", *terms)
        left = [self._step(term, label) for term in terms]
        if kind == "until":
            return self._either(left[1], self.both(left[0], self._owed("until", *terms)))
        if kind == "release":
            return self.both(left[1], self._either(left[0], self._owed("release", *terms)))
        result = left[0]
        for other in left[1:]:
            result = self.both(result, other) if kind == "and" else self._either(result, other)
        return result  # "some" and "any" differ only when no step is left


def _explore(progression: Progression, formula: Formula) -> np.ndarray:
    """Successors int ``[Q, L]`` of all states that can be reached; 0 is the initial state, 1 the accepting one."""
    num_labels = len(progression.labels)
    start = progression.start(formula)
    numbers, rows = {start: 0}, [[0] * num_labels, [1] * num_labels]
    states = [start, NOTHING_OWED]
    at = 0
    while at < len(states):
        if at != 1:
            for label in range(num_labels):
                left = progression.after(states[at], label)
                if progression.holds_when_over(left):
                    rows[at][label] = 1
                    continue
                if left not in numbers:
                    if len(states) == MAX_STATES:
                        raise SpecError(f"the formula is too large: its automaton has more than {MAX_STATES:,} states")
                    numbers[left] = len(states)
                    states.append(left)
                    rows.append([0] * num_labels)
                rows[at][label] = numbers[left]
        at += 1
    return np.array(rows)


def minimal(successors: np.ndarray) -> tuple[np.ndarray, int | None, int | None]:
    """Merges states that no continuation tells apart, and numbers the rest in the order in which they are reached.

    Returns:
        Successors int32, the accepting state and the rejecting one, ``None`` where there is none.
    """
    alive = np.arange(len(successors)) == 1
    while not np.array_equal(wider := alive | alive[successors].any(1), alive):
        alive = wider
    kind = np.where(np.arange(len(successors)) == 1, 1, np.where(alive, 0, 2))
    while True:
        _, finer = np.unique(np.column_stack([kind, kind[successors]]), axis=0, return_inverse=True)
        finer = finer.reshape(-1)
        if finer.max() == len(np.unique(kind)) - 1:
            break
        kind = finer
    merged = np.zeros((finer.max() + 1, successors.shape[1]), np.int64)
    merged[finer] = finer[successors]
    number, order = {int(finer[0]): 0}, [int(finer[0])]
    for state in order:
        for after in merged[state].tolist():
            if after not in number:
                number[after] = len(order)
                order.append(after)
    dead = np.flatnonzero(~alive)
    accepting = number.get(int(finer[1]))
    rejecting = number.get(int(finer[dead[0]])) if len(dead) else None
    final = np.array([[number[after] for after in merged[state].tolist()] for state in order], np.int32)
    return final, accepting, rejecting
