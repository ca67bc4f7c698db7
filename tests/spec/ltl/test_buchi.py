"""Automata of tasks that go on for ever, against the meaning of formulas on words u·vvv..."""

from __future__ import annotations

import functools
import random
from collections.abc import Sequence

import numpy as np
import pytest

from hrlspec.spec.ltl import Automaton, Formula, parse_ltl, propositions_of
from hrlspec.spec.ltl.buchi import to_buchi
from hrlspec.spec.ltl.syntax import Binary, Constant, Nary, Proposition, Unary
from hrlspec.spec.syntax import SpecError
from tests.spec.ltl.test_automaton import ALL, NAMES, possible_labels
from tests.spec.ltl.test_parser import PEERS

Word = Sequence[frozenset[str]]
SEMLTL = 54, 10
"""Formulas of its suites: recurrence and persistence."""


def holds(formula: Formula, word: Word, loop: int) -> list[bool]:  # noqa: C901  # a case an operator
    """At each step of ``word``, whose steps from ``loop`` on are repeated for ever: by definition, as fixed points."""
    steps = range(len(word))
    after = [*steps[1:], loop]
    below = [holds(child, word, loop) for child in formula.children]

    def fixed(first: bool, here: Sequence[bool], onward: Sequence[bool]) -> list[bool]:
        found = [first] * len(word)
        for _ in steps:
            found = [here[i] or (onward[i] and found[after[i]]) for i in reversed(steps)][::-1]
        return found

    match formula:
        case Constant(value):
            return [value for _ in steps]
        case Proposition(name):
            return [name in label for label in word]
        case Unary("!", _):
            return [not x for x in below[0]]
        case Unary("X", _):
            return [below[0][after[i]] for i in steps]
        case Unary("F", _):
            return fixed(False, below[0], [True] * len(word))
        case Unary("G", _):
            return [not x for x in fixed(False, [not x for x in below[0]], [True] * len(word))]
        case Nary("&", _):
            return [all(column) for column in zip(*below, strict=True)]
        case Nary("|", _):
            return [any(column) for column in zip(*below, strict=True)]
        case Binary("->", _, _):
            return [not x or y for x, y in zip(*below, strict=True)]
        case Binary("<->", _, _):
            return [x == y for x, y in zip(*below, strict=True)]
        case Binary("U", _, _):
            return fixed(False, below[1], below[0])
        case Binary("W", _, _):
            return fixed(True, below[1], below[0])
        case Binary("M", _, _):
            return fixed(False, [x and y for x, y in zip(*below, strict=True)], below[1])
        case Binary("R", _, _):
            return fixed(True, [x and y for x, y in zip(*below, strict=True)], below[1])
    raise AssertionError(formula)


def accepts(automaton: Automaton, word: Word, loop: int) -> bool:
    """Whether transitions accept again and again on the word."""
    column = {label: number for number, label in enumerate(automaton.labels)}
    assert automaton.marks is not None
    state = 0
    for label in word[:loop]:
        state = int(automaton.successors[state, column[label]])
    seen: dict[int, int] = {}
    marked: list[bool] = []
    while state not in seen:
        seen[state] = len(marked)
        found = False
        for label in word[loop:]:
            found |= bool(automaton.marks[state, column[label]])
            state = int(automaton.successors[state, column[label]])
        marked.append(found)
    return any(marked[seen[state] :])


def random_cosafe(rng: random.Random, size: int) -> Formula:
    if size <= 0:
        literal: Formula = Proposition(rng.choice(NAMES))
        return literal if rng.random() < 0.8 else Unary("!", literal)
    if rng.random() < 0.35:
        return Unary(rng.choice("XF"), random_cosafe(rng, size - 1))
    left = rng.randrange(size)
    parts = random_cosafe(rng, left), random_cosafe(rng, size - 1 - left)
    operator = rng.choice(["U", "M", "&", "|"])
    return Nary(operator, parts) if operator in "&|" else Binary(operator, *parts)


def random_part(rng: random.Random) -> Formula:
    inner = random_cosafe(rng, rng.randrange(4))
    kind = rng.randrange(5)
    if kind == 0:
        return inner
    if kind == 1:
        return Unary("!", inner)
    if kind == 2:
        return Unary("G", Binary("->", Proposition(rng.choice(NAMES)), inner))
    return Unary("G", Unary("F", inner))


@functools.cache
def cases(count: int, seed: int = 0) -> list[tuple[Formula, Automaton]]:
    rng = random.Random(seed)
    formulas = [random_round(rng, rng.randrange(3)) for _ in range(count)]
    return [(formula, to_buchi(formula, NAMES)) for formula in formulas]


def random_round(rng: random.Random, depth: int) -> Formula:
    """Conjunctions of disjunctions of conjunctions."""
    if depth == 0:
        return random_part(rng)
    return Nary(rng.choice("&&|"), tuple(random_round(rng, depth - 1) for _ in range(rng.randrange(2, 4))))


@pytest.mark.parametrize("count", [150, pytest.param(3000, marks=pytest.mark.slow)])
def test_a_word_is_accepted_when_the_formula_holds_on_it(count: int) -> None:
    rng = random.Random(1)
    outcomes = []
    for formula, automaton in cases(count):
        names = propositions_of(formula)
        for _ in range(30):
            word = [rng.choice(ALL) & set(names) for _ in range(rng.randrange(1, 7))]
            loop = rng.randrange(len(word))
            expected = holds(formula, word, loop)[0]
            assert accepts(automaton, word, loop) == expected, (formula, word, loop)
            outcomes.append(expected)
    assert 0.05 < np.mean(outcomes) < 0.95


@pytest.mark.parametrize("large", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_fields_recurrent_formulas_are_read(large: bool) -> None:
    """All of them; those of staying are refused by name. SemLTL's take a second each."""
    kinds = {"recurrence": 0, "persistence": 0, "reactivity": 0}
    for row in (row for row in PEERS if row["kind"] == "infinite" and row["suite"].startswith("semltl") == large):
        formula = parse_ltl(row["formula"])
        kinds[row["class"]] += 1
        if row["class"] == "recurrence":
            automaton = to_buchi(formula, *possible_labels(row["suite"], formula))
            assert automaton.marks is not None
            assert automaton.marks.any()
            assert automaton.num_states < 2000
        else:
            with pytest.raises(SpecError, match="asks to stay for ever"):
                to_buchi(formula, *possible_labels(row["suite"], formula))
    everything = {"recurrence": 117, "persistence": 43, "reactivity": 7}
    of_semltl = {"recurrence": SEMLTL[0], "persistence": SEMLTL[1], "reactivity": 0}
    assert kinds == (of_semltl if large else {kind: everything[kind] - of_semltl[kind] for kind in kinds})


@pytest.mark.parametrize(
    ("text", "trace", "rounds"),
    [
        ("GF a", "a.aa", 3),
        ("GF a & GF b", "ab.ba.ab", 2),  # a b, then a b: the b before the second a does not count
        ("GF a & GF b & G !c", "abcab", 1),  # after c nothing counts
        ("F c & GF a", "aa.c.a", 1),  # a round waits for c; a was met before it and is not asked for again
        ("G (a -> F b) & GF a", "ab.a.b", 2),
        ("GF (a & F b)", "ba.a.bb", 1),
        ("G !a", "bcb", 3),  # nothing is waited for: every step counts
        ("F a", "b.a.b", 3),
        ("GF a | (GF b & GF c)", "abacb.c", 4),  # a, a, and b c twice: each alternative counts its own rounds
    ],
)
def test_rounds(text: str, trace: str, rounds: int) -> None:
    labels = [frozenset(), *(frozenset(name) for name in "abc")]
    automaton = to_buchi(parse_ltl(text), "a b c".split(), labels)
    state = found = 0
    assert automaton.marks is not None
    for step in trace:
        column = automaton.labels.index(frozenset(step.replace(".", "")))
        found += bool(automaton.marks[state, column])
        state = int(automaton.successors[state, column])
    assert found == rounds


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("FG a", "F G a asks to stay for ever"),
        ("GF a | FG b", "F G b asks to stay for ever"),
        ("GF (a & G b)", "is none of what is read for ever"),
        ("GF z", "'z' is no proposition"),
    ],
)
def test_what_is_not_read(text: str, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        to_buchi(parse_ltl(text), NAMES)
