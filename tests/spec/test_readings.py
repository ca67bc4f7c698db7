"""SPECTRL formulas as automata: the exact reading against the semantics, the committed one against the monitor."""

from __future__ import annotations

import functools
import itertools
import random
import warnings

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrlspec.spec import (
    RUNNING,
    SATISFIED,
    VIOLATED,
    Formula,
    SpecError,
    SpecWarning,
    TaskTree,
    advance,
    compile_task,
    initial,
    parse,
    satisfies,
)
from hrlspec.spec.automata import automata_of
from hrlspec.spec.ltl import ltl_text, parse_ltl, satisfies_ltl
from hrlspec.spec.readings import (
    MAX_STEPS,
    committed_automaton,
    exact_automaton,
    monitor_automaton,
    to_ltl,
)
from tests.spec.ltl.test_automaton import spread
from tests.spec.tasks import NAMES, formulas, random_formula
from tests.spec.test_monitor import reading

MAX_NODES = 24
ONE = (frozenset(), *(frozenset({name}) for name in NAMES))
ALL = tuple(frozenset(x) for size in range(len(NAMES) + 1) for x in itertools.combinations(NAMES, size))
OVERLAPPING = (*ONE, frozenset("ab"), frozenset("bc"), frozenset("abd"))


@functools.cache
def tasks(count: int, seed: int) -> list[tuple[Formula, TaskTree]]:
    """Random formulas with their trees, numpy leaves."""
    rng = np.random.default_rng(seed)
    found: list[tuple[Formula, TaskTree]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SpecWarning)
        while len(found) < count:
            formula = random_formula(rng, 4)
            try:
                found.append((formula, compile_task(formula, NAMES, MAX_NODES, on_host=True)))
            except SpecError:
                continue  # too large, or forbids what it has to reach
    return found


@pytest.mark.parametrize(("count", "traces"), [(120, 25), pytest.param(4000, 25, marks=pytest.mark.slow)])
def test_the_exact_automaton_accepts_what_satisfies_the_formula(count: int, traces: int) -> None:
    rng = random.Random(0)
    verdicts = []
    for formula, _ in tasks(count, 1):
        automaton = exact_automaton(formula, NAMES, OVERLAPPING)
        for _ in range(traces):
            trace = spread(automaton, rng)
            verdicts.append(satisfies(formula, trace))
            assert (automaton.run(trace) == SATISFIED) == verdicts[-1], (formula, trace)
    assert 0.2 < np.mean(verdicts) < 0.8


@settings(max_examples=150, deadline=None)
@given(formulas(NAMES[:3]), st.lists(st.frozensets(st.sampled_from(NAMES[:3])), max_size=6))
def test_the_formula_in_ltl_says_the_same(formula: Formula, trace: list[frozenset[str]]) -> None:
    """Whatever a tree can say of it: goals that must not hold, conditions that must."""
    assert satisfies_ltl(to_ltl(formula), trace) == satisfies(formula, trace)


@pytest.mark.parametrize(
    ("text", "ltl"),
    [
        ("achieve a; achieve b", "F (a & X F b)"),
        ("achieve a ensuring not c; achieve b", "!c U (a & !c & X (!c U F b))"),
        ("(achieve a; achieve b) ensuring not c", "!c U (a & !c & X (!c U (b & !c)))"),
        ("achieve a or achieve not b and c ensuring a", "(F a) | (a U ((!b & c) & a))"),
    ],
)
def test_formulas_in_ltl(text: str, ltl: str) -> None:
    assert to_ltl(parse(text)) == parse_ltl(ltl)
    assert parse_ltl(ltl_text(to_ltl(parse(text)))) == parse_ltl(ltl)


def test_alternatives_share_what_follows_them() -> None:
    """40 choices in a row: written out they would be 2^40 ways."""
    text = "; ".join(["(achieve a or achieve b)"] * 40)
    assert exact_automaton(parse(text), NAMES, ONE).num_states == 41


def test_what_is_no_formula_in_ltl_is_refused() -> None:
    chain = "; ".join(["achieve a"] * (MAX_STEPS + 1))
    with pytest.raises(SpecError, match=f"line 1, column 1: more than {MAX_STEPS} sub-tasks in a row"):
        to_ltl(parse(chain))
    assert exact_automaton(parse(chain.removesuffix("; achieve a")), NAMES, ONE).num_states == MAX_STEPS + 1
    with pytest.raises(SpecError, match="line 1, column 9: 'G' cannot name a proposition in LTL"):
        to_ltl(parse("achieve G"))
    with pytest.raises(SpecError, match="'z' is no proposition, expected some of a, b, c, d, e"):
        exact_automaton(parse("achieve z"), NAMES, ONE)


@pytest.mark.parametrize(("count", "traces"), [(60, 35), pytest.param(1500, 70, marks=pytest.mark.slow)])
def test_the_committed_automaton_is_the_monitor(count: int, traces: int) -> None:
    """By the rules in words, after every step of every trace."""
    rng = random.Random(1)
    last = []
    for formula, tree in tasks(count, 2):
        automaton = committed_automaton(tree, NAMES, ALL)
        for _ in range(traces):
            trace = spread(automaton, rng)
            expected = _statuses(tree, trace)
            assert [automaton.run(trace[: n + 1]) for n in range(len(trace))] == expected, (formula, trace)
            last.append(expected[-1])
    assert np.mean(np.array(last) == SATISFIED) > 0.2
    assert np.mean(np.array(last) == VIOLATED) > 0.1


def test_where_labels_cannot_occur_the_committed_automaton_knows_earlier_that_nothing_helps() -> None:
    """Of the monitor it is told state by state; the minimal automaton sees that a and b never hold together."""
    earlier = 0
    for _, tree in tasks(60, 5):
        automaton = committed_automaton(tree, NAMES, ONE)
        rng = random.Random(6)
        for _ in range(10):
            trace = spread(automaton, rng)
            expected, found = _statuses(tree, trace)[-1], automaton.run(trace)
            assert (found == SATISFIED) == (expected == SATISFIED)
            assert found == VIOLATED or expected != VIOLATED
            earlier += found != expected
    assert earlier > 0


def _statuses(tree: TaskTree, trace: list[frozenset[str]]) -> list[int]:
    """After every step, nothing assigned."""
    steps = [frozenset(map(NAMES.index, label)) for label in trace]
    return [status for _, status, _ in reading(tree, steps, [TaskTree.NO_NODE] * len(trace))]


def test_the_monitor_state_by_state_in_one_jitted_table() -> None:
    """Status after every step, of the monitor on the trees and of the automata, side by side."""
    rng = np.random.default_rng(3)
    count, length = 60, 12
    trees = [tree for _, tree in tasks(count, 4)]
    each = [monitor_automaton(tree, NAMES, OVERLAPPING) for tree in trees]
    shown = [trees for _, trees in each]
    together, cut, silent = automata_of([automaton for automaton, _ in each], NAMES, MAX_NODES, trees=shown)
    assert not np.any([cut, silent])
    columns = rng.integers(len(OVERLAPPING), size=(count, length))
    holds = np.array([[name in label for name in NAMES] for label in OVERLAPPING])[columns]

    def on_tree(tree: TaskTree, holds: jax.Array) -> jax.Array:
        def step(state, now):
            state = advance(tree, state, now, TaskTree.NO_NODE)
            return state, state.status

        return jax.lax.scan(step, initial(tree), holds)[1]

    def on_automaton(row: jax.Array, holds: jax.Array) -> jax.Array:
        def step(row, now):
            row, _ = together.advance(row, now)
            return row, jax.numpy.asarray(together.status)[row]

        return jax.lax.scan(step, row, holds)[1]

    stacked = jax.tree.map(lambda *x: np.stack(x), *trees)
    expected = jax.jit(jax.vmap(on_tree))(stacked, holds)
    np.testing.assert_array_equal(jax.jit(jax.vmap(on_automaton))(together.start, holds), expected)
    assert {RUNNING, SATISFIED, VIOLATED} == set(np.unique(expected).tolist())


def test_what_is_shown_is_the_rest_of_the_tree() -> None:
    text = "(achieve a; achieve b) ensuring not c or achieve d; achieve e"
    tree = compile_task(parse(text), NAMES, 8, on_host=True)
    automaton, trees = monitor_automaton(tree, NAMES, ONE)

    def shown(*trace: str) -> list[tuple[int, str, str]]:
        state = 0
        for label in trace:
            state = int(automaton.successors[state, ONE.index(frozenset(label))])
        here = jax.tree.map(lambda x: x[state], trees)
        rows = np.flatnonzero(here.valid)[1:]
        names = ["".join(np.array(NAMES)[row]) for row in here.reach]
        avoided = ["".join(np.array(NAMES)[row]) for row in here.avoid]
        assert here.accepting[rows].any() or not len(rows)
        assert here.depth[rows].tolist() == [1 + int(here.depth[here.parent[row]]) for row in rows]
        return [(int(here.parent[row]), names[row], avoided[row]) for row in rows]

    assert shown() == [(0, "a", "c"), (0, "d", ""), (1, "b", "c"), (2, "e", "")]
    # Blocked, what the edge would reach is avoided still, as on the tree.
    assert shown("c") == [(0, "d", "a"), (1, "e", "")]
    assert shown("a") == [(0, "b", "c")]
    assert shown("d") == [(0, "e", "")]
    assert shown("a", "c") == shown("d", "e") == []


def test_too_many_states_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hrlspec.spec.readings.MAX_STATES", 4)
    tree = compile_task(parse("achieve a; achieve b; achieve c; achieve d"), NAMES, 8)
    with pytest.raises(SpecError, match="its automaton has more than 4 states"):
        monitor_automaton(tree, NAMES, ONE)
