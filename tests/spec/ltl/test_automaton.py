"""Automata against the definition of what they stand for, and against the sizes known for the field's formulas."""

from __future__ import annotations

import functools
import itertools
import random
from collections.abc import Sequence

import pytest

from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, SpecError
from hrlspec.spec.ltl import Automaton, Formula, parse_ltl, propositions_of, satisfies_ltl, to_automaton, translate
from hrlspec.spec.ltl.syntax import Binary, Constant, Nary, Proposition, Unary, subformulas
from tests.spec.ltl.test_parser import PEERS

NAMES = ("a", "b", "c")
ALL = tuple(frozenset(x) for n in range(len(NAMES) + 1) for x in itertools.combinations(NAMES, n))
FLATWORLD = [
    frozenset(label.split("+")) - {""}
    for label in (
        *("", "red", "magenta", "red+magenta", "blue", "green", "aqua", "blue+green", "green+aqua", "blue+aqua"),
        *("blue+green+aqua", "yellow", "orange"),
    )
]
WAREHOUSE = [
    frozenset({*place, *thing})
    for place in ((), ("region_a",), ("region_b",), ("door",))
    for thing in ((), ("vase",), ("crate",), ("vase", "crate"))
]


def possible_labels(suite: str, formula: Formula) -> tuple[Sequence[str], list[frozenset[str]]]:
    """Propositions of a suite's world, as far as they matter here, and which can hold together."""
    names = propositions_of(formula)
    if suite.startswith(("flatworld", "warehouse")):
        labels = FLATWORLD if suite.startswith("flatworld") else WAREHOUSE
        return sorted(frozenset().union(*labels)), labels
    return names, [frozenset(), *(frozenset({name}) for name in names)]


@pytest.mark.parametrize("large", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_automata_of_the_fields_finite_formulas_have_their_known_size(large: bool) -> None:
    """The larger ones take seconds each."""
    rows = [row for row in PEERS if row["kind"] == "finite" and (int(row["dfa_states"]) > 100) == large]
    assert len(rows) == (39 if large else 348)
    for row in rows:
        formula = parse_ltl(row["formula"])
        automaton = to_automaton(formula, *possible_labels(row["suite"], formula))
        found = automaton.num_states, automaton.rejecting is not None
        assert found == (int(row["dfa_states"]), row["rejecting_sink"] == "1"), (row["suite"], row["index"])


def random_formula(rng: random.Random, size: int) -> Formula:
    """A formula of about so many operators."""
    if size <= 0:
        return Constant(rng.random() < 0.5) if rng.random() < 0.05 else Proposition(rng.choice(NAMES))
    if rng.random() < 0.4:
        return Unary(rng.choice("!XFG"), random_formula(rng, size - 1))
    left = rng.randrange(size)
    parts = random_formula(rng, left), random_formula(rng, size - 1 - left)
    operator = rng.choice(["U", "R", "W", "M", "->", "<->", "&", "|"])
    return Nary(operator, parts) if operator in "&|" else Binary(operator, *parts)


@functools.cache
def random_cases(count: int, seed: int) -> list[tuple[Formula, Automaton]]:
    rng = random.Random(seed)
    formulas = [random_formula(rng, rng.randrange(1, 7)) for _ in range(count)]
    return [(formula, to_automaton(formula, NAMES)) for formula in formulas]


def spread(automaton: Automaton, rng: random.Random) -> list[frozenset[str]]:
    """A trace that does not decide the task at once, if there is one of three."""
    labels = automaton.labels
    traces = [[rng.choice(labels) for _ in range(rng.randrange(1, 9))] for _ in range(3)]
    return max(traces, key=lambda trace: sum(automaton.run(trace[:n]) == RUNNING for n in range(len(trace))))


@pytest.mark.parametrize(("count", "traces"), [(150, 8), pytest.param(2500, 40, marks=pytest.mark.slow)])
def test_an_automaton_accepts_what_satisfies_the_formula(count: int, traces: int) -> None:
    rng = random.Random(1)
    verdicts = []
    for formula, automaton in random_cases(count, 0):
        for _ in range(traces):
            trace = spread(automaton, rng)
            verdicts.append(satisfies_ltl(formula, trace))
            assert (automaton.run(trace) == SATISFIED) == verdicts[-1], (formula, trace)
    assert 0.2 < sum(verdicts) / len(verdicts) < 0.8
    with_next = sum(
        any(isinstance(x, Unary) and x.operator == "X" for x in subformulas(f)) for f, _ in random_cases(count, 0)
    )
    assert with_next > 0.2 * count


@pytest.mark.parametrize("count", [60, pytest.param(1500, marks=pytest.mark.slow)])
def test_what_is_violated_no_continuation_can_satisfy(count: int) -> None:
    """Continuations of up to as many steps as there are states: more cannot be needed."""
    rng = random.Random(2)
    violated = 0
    for formula, automaton in random_cases(count, 3):
        if automaton.num_states > 4:
            continue
        trace = [rng.choice(automaton.labels) for _ in range(rng.randrange(4))]
        more = range(automaton.num_states + 1)
        endings = itertools.chain.from_iterable(itertools.product(automaton.labels, repeat=n) for n in more)
        can_be = any(satisfies_ltl(formula, [*trace, *ending]) for ending in endings)
        assert (automaton.run(trace) == VIOLATED) == (not can_be), (formula, trace)
        violated += not can_be
    assert violated > 0.1 * count


def test_states_are_told_apart_by_some_continuation() -> None:
    for _, automaton in random_cases(150, 0):
        n = automaton.num_states
        pairs = list(itertools.product(range(n), repeat=2))
        different = {(x, y) for x, y in pairs if (x == automaton.accepting) != (y == automaton.accepting)}
        while True:
            more = {
                (x, y)
                for x, y in pairs
                if any((int(s), int(t)) in different for s, t in zip(*automaton.successors[[x, y]], strict=True))
            }
            if more <= different:
                break
            different |= more
        assert len(different) == n * (n - 1)


def test_as_many_states_as_the_minimal_one_of_a_library() -> None:
    """What progression finds, made smaller by automata-lib."""
    library = pytest.importorskip("automata.fa.dfa")
    for formula, automaton in random_cases(80, 5):
        progression = translate.Progression(automaton.labels)
        rows: dict[str, dict[str, str]] = {"done": {str(column): "done" for column in range(len(automaton.labels))}}
        pending = [progression.start(formula)]
        while pending:
            state = pending.pop()
            row = rows.setdefault(str(sorted(state)), {})
            for column in range(len(automaton.labels)):
                after = progression.after(state, column)
                over = progression.holds_when_over(after)
                row[str(column)] = "done" if over else str(sorted(after))
                if row[str(column)] not in rows:
                    rows[row[str(column)]] = {}
                    pending.append(after)
        whole = library.DFA(
            states=set(rows),
            input_symbols={str(column) for column in range(len(automaton.labels))},
            transitions=rows,
            initial_state=str(sorted(progression.start(formula))),
            final_states={"done"},
        )
        assert len(whole.minify().states) == automaton.num_states, formula


@pytest.mark.parametrize(
    ("text", "trace", "status"),
    [
        ("F a", [], RUNNING),
        ("true", [], RUNNING),  # nothing is accepted before the first step
        ("true", [""], SATISFIED),
        ("false", [""], VIOLATED),
        ("G a", ["a"], SATISFIED),  # the prefix of one step satisfies it
        ("G a", ["b", "a"], VIOLATED),
        ("X a", ["a"], RUNNING),
        ("X a", ["", "a"], SATISFIED),
        ("!X a", ["a"], SATISFIED),  # there is no next step
        ("X !a & G b", ["b", "b"], SATISFIED),
        ("!a U (b & (!c U d))", ["b", "c", "b", "d"], SATISFIED),  # the inner until only withdraws progress
        ("!a U (b & (!c U d))", ["b", "c", "a"], VIOLATED),
    ],
)
def test_status(text: str, trace: list[str], status: int) -> None:
    formula = parse_ltl(text)
    automaton = to_automaton(formula, "abcd", [set(), *"abcd"])
    assert automaton.run(map(set, trace)) == status
    assert satisfies_ltl(formula, [set(label) for label in trace]) == (status == SATISFIED)


def test_impossible_labels_are_refused() -> None:
    automaton = to_automaton(parse_ltl("F (a & b)"), "ab", [set(), {"a"}, {"b"}])
    assert automaton.rejecting == 0  # the two never hold together
    with pytest.raises(ValueError, match=r"step 1 of the trace has the label {a, b}, which cannot occur"):
        automaton.run([{"a"}, {"a", "b"}])
    with pytest.raises(ValueError, match="possible labels name 'z', which is no proposition"):
        to_automaton(parse_ltl("F a"), "ab", [{"z"}])
    with pytest.raises(ValueError, match="there is no possible label"):
        to_automaton(parse_ltl("F a"), "ab", [])


def test_what_is_too_large_or_unknown_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SpecError, match="'c' is no proposition, expected some of a, b"):
        to_automaton(parse_ltl("F c"), "ab")
    many = " & ".join(f"F p{i}" for i in range(20))
    names = [f"p{i}" for i in range(20)]
    with pytest.raises(SpecError, match="has 20 propositions, of which at most 12"):
        to_automaton(parse_ltl(many), names)
    monkeypatch.setattr(translate, "MAX_STATES", 500)
    monkeypatch.setattr(translate, "MAX_WORK", 100_000)
    with pytest.raises(SpecError, match="its automaton has more than 500 states"):
        to_automaton(parse_ltl(many), names, [set(), *({name} for name in names)])
    either = " & ".join(f"(F a{i} | F b{i})" for i in range(14))
    with pytest.raises(SpecError, match="more than 100,000 alternatives to compare"):
        to_automaton(parse_ltl(either), [f"{x}{i}" for x in "ab" for i in range(14)], [set()])
