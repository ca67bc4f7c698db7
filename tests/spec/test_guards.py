"""Guards of automata, and automata as text for Graphviz."""

from __future__ import annotations

import itertools
import random
import re

import pytest

from hrlspec.spec.dot import to_dot
from hrlspec.spec.guards import transitions
from hrlspec.spec.ltl import Automaton, parse_ltl, satisfies_ltl, to_automaton, to_buchi
from tests.spec.ltl.test_automaton import ALL, NAMES, random_formula

ONE = (frozenset(), *(frozenset({name}) for name in "abcde"))


def guards(automaton: Automaton) -> list[tuple[int, int, str]]:
    return [(move.source, move.target, move.guard + " !" * move.accepting) for move in transitions(automaton)]


def test_guards_of_labels_of_one_proposition_at_most() -> None:
    assert guards(to_automaton(parse_ltl("!a U (b & (!c U d))"), "abcde", ONE))[:8] == [
        (0, 0, "!a & !b"),
        (0, 1, "a"),
        (0, 2, "b"),
        (1, 1, "true"),
        (2, 2, "!a & !c & !d"),
        (2, 3, "a"),
        (2, 0, "c"),
        (2, 4, "d"),
    ]


def test_accepting_transitions_are_apart() -> None:
    assert guards(to_buchi(parse_ltl("GF (a | b)"), "abcde", ONE)) == [(0, 0, "!a & !b"), (0, 0, "a | b !")]


def test_guards_of_labels_that_overlap() -> None:
    found = guards(to_automaton(parse_ltl("F (a & (b | !c))"), NAMES, ALL))
    assert found == [(0, 0, "!a | !b & c"), (0, 1, "a & b | a & !c"), (1, 1, "true")]


def test_what_is_true_of_all_labels_that_can_occur_is_not_said() -> None:
    """b never without a: of a and b, b says it."""
    labels = [set(), {"a"}, {"a", "b"}]
    assert guards(to_automaton(parse_ltl("F (a & b)"), NAMES, labels))[1] == (0, 1, "b")


@pytest.mark.parametrize("seed", range(12))
def test_guards_mean_the_labels_and_are_the_shortest(seed: int) -> None:
    """Against all disjunctions of conjunctions of literals of three propositions."""
    rng = random.Random(seed)
    labels = rng.sample(ALL, rng.randrange(3, len(ALL) + 1))
    automaton = to_automaton(random_formula(rng, 8), NAMES, labels)
    for state in range(automaton.num_states):
        moves = [move for move in transitions(automaton) if move.source == state]
        for column, label in enumerate(automaton.labels):
            taken = [move for move in moves if satisfies_ltl(parse_ltl(move.guard), [label])]
            assert [move.target for move in taken] == [int(automaton.successors[state, column])]
        for move in moves:
            on = frozenset(
                label for label, to in zip(labels, automaton.successors[state], strict=True) if to == move.target
            )
            conjunctions = move.guard.split(" | ")
            size = len(conjunctions), len(re.findall(r"[abc]", move.guard))
            assert size == _least(on, frozenset(labels))


def _least(on: frozenset[frozenset[str]], labels: frozenset[frozenset[str]]) -> tuple[int, int]:
    """How many conjunctions, and literals, are needed to say which of the labels."""
    cubes = []
    for signs in itertools.product([None, True, False], repeat=len(NAMES)):
        wanted = [(name, sign) for name, sign in zip(NAMES, signs, strict=True) if sign is not None]
        held = frozenset(label for label in labels if all((name in label) == sign for name, sign in wanted))
        if held and held <= on:
            cubes.append((held, len(wanted)))
    for count in itertools.count(1):
        sizes = [
            sum(literals for _, literals in some)
            for some in itertools.combinations(cubes, count)
            if frozenset().union(*(held for held, _ in some)) == on
        ]
        if sizes:
            return count, min(sizes)
    raise AssertionError


def test_jumps_are_transitions_without_a_guard() -> None:
    automaton = to_buchi(parse_ltl("FG a"), "abcde", ONE)
    expected = [(0, 0, "true"), (0, 1, "ε"), (1, 1, "a !"), (1, 2, "!a"), (2, 2, "true")]
    assert sorted(guards(automaton)) == expected
    assert '  0 -> 1 [label="ε", style=dashed]' in to_dot(automaton).splitlines()


def test_text_for_graphviz() -> None:
    text = to_dot(to_buchi(parse_ltl("GF a & G !c"), "abcde", ONE), 'GF a & G !c "')
    assert (
        text
        == """digraph {
  rankdir=LR
  label="GF a & G !c \\""
  node [shape=circle]
  start [shape=point, label=""]
  start -> 0
  0 []
  1 [style=dashed]
  0 -> 0 [label="!a & !c"]
  0 -> 0 [label="a {0}", style=bold]
  0 -> 1 [label="c"]
  1 -> 1 [label="true"]
}
"""
    )
    assert "  1 [shape=doublecircle]\n" in to_dot(to_automaton(parse_ltl("F a"), "abcde", ONE))
