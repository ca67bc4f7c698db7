"""Automata of tasks that go on for ever, against the meaning of formulas on words u·vvv..."""

from __future__ import annotations

import functools
import random
from collections.abc import Iterator, Sequence

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
    """Whether with some choice of jumps transitions accept again and again on the word."""
    column = {label: number for number, label in enumerate(automaton.labels)}
    assert automaton.marks is not None

    def after(state: int, step: int) -> Iterator[tuple[tuple[int, int], bool]]:
        """Where a state and a step of the word may lead, and whether that accepts."""
        for target in automaton.jumps[state] if automaton.jumps else ():
            yield (target, step), False
        read = state, column[word[step]]
        assert automaton.marks is not None
        yield (int(automaton.successors[read]), step + 1 if step + 1 < len(word) else loop), bool(automaton.marks[read])

    def reached(start: tuple[int, int]) -> set[tuple[int, int]]:
        found, queue = {start}, [start]
        for place in queue:
            for target, _ in after(*place):
                if target not in found:
                    found.add(target)
                    queue.append(target)
        return found

    accepting = ((place, to) for place in reached((0, 0)) for to, marked in after(*place) if marked)
    return any(place in reached(to) for place, to in accepting)


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
    """Conjunctions of disjunctions of conjunctions, some of them from some step on, implied, or denied."""
    if depth == 0:
        return random_part(rng)
    kind = rng.randrange(8)
    if kind == 0:
        return Unary("F", random_round(rng, depth - 1))
    if kind == 1:  # both sides can be denied
        sides = [Unary(rng.choice("GF"), Unary(rng.choice("GF"), Proposition(rng.choice(NAMES)))) for _ in range(2)]
        return rng.choice(
            [Binary("->", *sides), Binary("<->", *sides), Unary("!", Nary(rng.choice("&|"), tuple(sides)))]
        )
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
def test_the_fields_infinite_formulas_are_read(large: bool) -> None:
    """All of them; what asks to stay leaves a choice. SemLTL's take a second each."""
    kinds = {"recurrence": 0, "persistence": 0, "reactivity": 0}
    for row in (row for row in PEERS if row["kind"] == "infinite" and row["suite"].startswith("semltl") == large):
        formula = parse_ltl(row["formula"])
        kinds[row["class"]] += 1
        automaton = to_buchi(formula, *possible_labels(row["suite"], formula))
        assert automaton.marks is not None
        assert automaton.marks.any()
        assert automaton.num_states < 2000
        assert (len(automaton.jumps) > 0) == (row["class"] != "recurrence")
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
        ("GF (a & G b)", "G F \\(a & G b\\) is none of what is read for ever"),
        ("GF b | F (a & X GF b & GF c)", "X G F b is none"),
        ("GF z", "'z' is no proposition"),
    ],
)
def test_what_is_not_read(text: str, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        to_buchi(parse_ltl(text), NAMES)


ONE_AT_MOST = [frozenset(), *(frozenset(name) for name in "abc")]


def test_one_jump_leads_into_a_copy_that_leaving_violates() -> None:
    """As by hand: F G a waits whatever holds; after the jump each a is a round, and anything else the end."""
    found = to_buchi(parse_ltl("FG a"), "abc", ONE_AT_MOST)
    assert (found.jumps, found.rejecting) == (((1,), (), ()), 2)
    assert found.successors.tolist() == [[0, 0, 0, 0], [2, 1, 2, 2], [2, 2, 2, 2]]
    assert found.marks is not None
    assert np.argwhere(found.marks).tolist() == [[1, 1]]


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("!GF a", "FG !a"),
        ("!(FG a)", "GF !a"),
        ("GF a -> GF b", "FG !a | GF b"),
        ("!(GF a | FG b)", "FG !a & GF !b"),
        ("!(GF a -> GF b)", "GF a & FG !b"),
        ("FG a & F (b & F c)", "F (b & F c) & FG a"),
    ],
)
def test_said_in_two_ways(text: str, same: str) -> None:
    one, other = (to_buchi(parse_ltl(some), "abc", ONE_AT_MOST) for some in (text, same))
    np.testing.assert_array_equal(one.successors, other.successors)
    np.testing.assert_array_equal(one.marks, other.marks)
    assert one.jumps == other.jumps


def test_what_no_continuation_satisfies_is_rejecting() -> None:
    """Who must stay in b or c and owes a cannot pay: after the jump b is the end, and no round."""
    found = to_buchi(parse_ltl("G (b -> F a) & FG (b | c)"), "abc", ONE_AT_MOST)
    (copy,) = found.jumps[0]
    after = dict(zip("_abc", found.successors[copy].tolist(), strict=True))
    assert after == {"_": found.rejecting, "a": found.rejecting, "b": found.rejecting, "c": copy}
    assert found.marks is not None
    assert np.flatnonzero(found.marks[copy]).tolist() == [3]


def test_whatever_is_rejecting_accepts_nothing_and_all_else_something() -> None:
    for _, automaton in cases(150):
        dead = automaton.rejecting
        assert automaton.marks is not None
        table, marks = automaton.successors, automaton.marks
        if dead is not None:
            assert (table[dead] == dead).all()
            assert not marks[dead].any()
            assert not marks[table == dead].any()
        for state in range(automaton.num_states):
            found, queue = {state}, [state]
            for one in queue:
                for target in (*table[one].tolist(), *(automaton.jumps[one] if automaton.jumps else ())):
                    if target not in found:
                        found.add(target)
                        queue.append(target)
            assert (state == dead) == (not marks[sorted(found)].any())
