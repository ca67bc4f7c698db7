"""Automata from and to dictionaries of the library ``dfa``."""

from __future__ import annotations

import json
import random
from typing import Any

import numpy as np
import pytest

from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, SpecError
from hrlspec.spec.dfa import from_dict, from_json, to_dict
from hrlspec.spec.ltl import Automaton, parse_ltl, to_automaton, to_buchi
from tests.spec.ltl.test_automaton import ALL, random_cases

NAMES = ("a", "b", "c")
ONE = (frozenset(), *(frozenset({name}) for name in NAMES))
# a, then b without c: as a program writes it that knows of tokens alone.
TOKENS: dict[Any, Any] = {
    "begin": (False, {0: "half", 1: "begin", 2: "begin"}),
    "half": (False, {0: "half", 1: "done", 2: "lost"}),
    "done": (True, {0: "done", 1: "done", 2: "done"}),
    "lost": (False, {0: "lost", 1: "lost", 2: "lost"}),
}


def same(one: Automaton, other: Automaton) -> None:
    assert one.labels == other.labels
    np.testing.assert_array_equal(one.successors, other.successors)
    assert (one.accepting, one.rejecting) == (other.accepting, other.rejecting)


def test_tokens_are_propositions_by_number_and_nothing_changes_nothing() -> None:
    automaton = from_dict(TOKENS, "begin", NAMES, ONE)
    assert automaton.run(["b", "", "a", "", "b"]) == SATISFIED
    assert (automaton.run(["a", "", "c"]), automaton.run(["c", "a"])) == (VIOLATED, RUNNING)
    same(automaton, to_automaton(parse_ltl("!a U (a & X (!c U b))"), NAMES, ONE))


def test_the_first_accepted_word_satisfies() -> None:
    """Also where the automaton would leave its accepting state again, or begins in one."""
    flips = {0: (True, {"a": 1, "b": 0, "c": 0}), 1: (False, {"a": 0, "b": 1, "c": 1})}
    automaton = from_dict(flips, 0, NAMES, ONE)
    assert [automaton.run(trace) for trace in ([], ["b"], ["a"], ["a", "a", "a"])] == [
        RUNNING,
        SATISFIED,
        RUNNING,
        SATISFIED,
    ]


@pytest.mark.parametrize("text", ["F (a & F b)", "!a U (b & (!c U a))", "G !c & F a", "false", "X !a"])
def test_what_is_written_is_read_again(text: str) -> None:
    for labels in (ONE, ALL):
        automaton = to_automaton(parse_ltl(text), NAMES, labels)
        same(from_dict(*to_dict(automaton), NAMES, labels), automaton)
        same(from_json(json.dumps(to_dict(automaton)), NAMES, labels), automaton)
    letters = to_dict(automaton)[0][0][1]
    assert {"", "a", "b", "c", "a&b", "a&c", "b&c", "a&b&c"} == letters.keys()


def test_letters_may_be_sets_of_names() -> None:
    rows = {
        0: (False, {(): 0, frozenset("a"): 0, ("b", "a"): 1, "c": 0, "b": 0}),
        1: (True, {"": 1, "a": 1, "a&b": 1, "c": 1, "b": 1}),
    }
    labels = [*ONE, {"a", "b"}]
    same(from_dict(rows, 0, NAMES, labels), to_automaton(parse_ltl("F (a & b)"), NAMES, labels))


def test_rounds_have_no_place() -> None:
    with pytest.raises(ValueError, match="a task that goes on for ever"):
        to_dict(to_buchi(parse_ltl("GF a"), NAMES, ONE))


def changed(**change: Any) -> dict[Any, Any]:
    return {**TOKENS, **change}


@pytest.mark.parametrize(
    ("rows", "start", "message"),
    [
        ({}, 0, "found no state 0, with which it starts"),
        (TOKENS, "end", "found no state 'end', with which it starts"),
        (changed(half=(2, {})), "begin", "state 'half' has the label 2, expected true or false"),
        (changed(half=(None, {})), "begin", "state 'half' has the label None, expected true or false"),
        (changed(lost=(False, {0: "lost", 1: "lost"})), "begin", "state 'lost' has no letter for {c}, which can hold"),
        (changed(half=(False, {0: "gone"})), "begin", "found no state 'gone', to which 0 leads from state 'half'"),
        (
            changed(half=(False, {3: "half"})),
            "begin",
            "letter 3: 3 is no proposition, expected some of a, b, c, or a number below 3",
        ),
        (changed(half=(False, {-1: "half"})), "begin", "letter -1: -1 is no proposition"),
        (changed(half=(False, {"a&z": "half"})), "begin", "letter 'a&z': 'z' is no proposition"),
        (changed(half=(False, {"a&": "half"})), "begin", "letter 'a&': '' is no proposition"),
        (changed(half=(False, {None: "half"})), "begin", "letter None: None is no proposition"),
        (changed(half=(False, {0: "half", "a": "lost"})), "begin", "state 'half' has two letters for what 'a' says"),
        ({n: (False, {}) for n in range(10_001)}, 0, "the automaton has 10,001 states, at most 10,000 are read"),
    ],
)
def test_what_is_refused(rows: dict[Any, Any], start: Any, message: str) -> None:
    with pytest.raises(SpecError) as caught:
        from_dict(rows, start, NAMES, ONE)
    assert message in str(caught.value)


JSON = json.dumps([TOKENS, "begin"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (JSON, "", "line 1, column 1: no JSON: Expecting value"),
        ("[{", "[[", "no JSON"),
        (', "begin"]', "]", "expected a list of two"),
        (JSON, '{"states": {}, "start": 0}', "expected a list of two"),
        (JSON, "[" * 100_000, "nested too deep"),
        ('"begin"]', "null]", "a state is a whole number or a text, found None"),
        ('"begin"]', '["begin"]]', "a state is a whole number or a text, found ['begin']"),
        ('"done": [true', '"half": [true', "'half' is there twice"),
        ("[true, ", "[true, 1, ", "state 'done': expected a list of two"),
        ('[true, {"0"', '[true, {"0" : "done", "0"', "'0' is there twice"),
        ("[true", "[{}", "state 'done' has the label {}, expected true or false"),
        ('"1": "done"', '"1": 1.5', "a state is a whole number or a text, found 1.5"),
        (JSON, "1" * 5000, "expected a list of two"),
    ],
)
def test_json_that_is_refused(old: str, new: str, message: str) -> None:
    assert old in JSON
    with pytest.raises(SpecError) as caught:
        from_json(JSON.replace(old, new, 1), NAMES, ONE)
    assert message in str(caught.value)


def test_json_is_read_or_refused() -> None:
    rng = random.Random(0)
    same(from_json(JSON, NAMES, ONE), from_dict(TOKENS, "begin", NAMES, ONE))
    for _ in range(1000):
        at = rng.randrange(len(JSON))
        try:
            from_json(
                JSON[:at] + rng.choice(["", '"', "[", "}", "0", ",", "true"]) + JSON[at + rng.randrange(4) :],
                NAMES,
                ONE,
            )
        except SpecError:
            continue


def test_the_library_reads_and_writes_the_same() -> None:
    """Words accepted by the library's automaton are the traces that satisfy ours; and its own dictionaries are read."""
    library = pytest.importorskip("dfa")
    rng = random.Random(0)
    for _, automaton in random_cases(60, 8):
        theirs = library.dict2dfa(*to_dict(automaton))
        for _ in range(10):
            trace = [rng.choice(automaton.labels) for _ in range(rng.randrange(1, 7))]
            word = ["&".join(sorted(label)) for label in trace]
            assert theirs.label(word) == (automaton.run(trace) == SATISFIED)
        assert len(theirs.minimize().states()) == automaton.num_states
        same(from_dict(*library.dfa2dict(theirs.minimize(), reindex=True), NAMES, automaton.labels), automaton)
