"""Automata from and to HOA text."""

from __future__ import annotations

import random

import numpy as np
import pytest

from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, SpecError
from hrlspec.spec.hoa import from_hoa, to_hoa, until_accepting
from hrlspec.spec.ltl import Automaton, parse_ltl, to_automaton, to_buchi
from tests.spec.ltl.test_buchi import accepts, holds

NAMES = ("a", "b", "c")
LABELS = (frozenset(), *(frozenset(name) for name in NAMES))

# GF a & GF b, as another program would print it: with aliases, comments, names, and labels of states.
ROUNDS = """HOA: v1
tool: "some" "1.0"  /* a comment
over two lines */
name: "GFa & \\"GFb\\""
States: 2
Start: 0
AP: 2 "b" "a"
acc-name: Buchi
Acceptance: 1 Inf(0)
Alias: @both 0 & 1
properties: trans-labels explicit-labels trans-acc deterministic
--BODY--
State: 0 "waits for a"
[!1] 0
[1 & !@both] 1
[@both] 0 {0}
State: 1
[!0] 1
[(0 | f) & t] 0 {0}
--END--
"""
# Of two states the second accepts; what is not said leads nowhere.
UNTIL = """HOA: v1 States: 2 Start: 0 AP: 2 "a" "b" Acceptance: 1 Inf(0) --BODY--
State: 0 [!0 & !1] 0 [1 & !0] 1
State: [t] 1 {0} 1
--END--"""


def follow(automaton: Automaton, trace: str) -> list[bool]:
    """Which steps accept."""
    assert automaton.marks is not None
    state, found = 0, []
    for step in trace:
        column = automaton.labels.index(frozenset(step.replace(".", "")))
        found.append(bool(automaton.marks[state, column]))
        state = int(automaton.successors[state, column])
    return found


def test_rounds_of_a_given_automaton() -> None:
    automaton = from_hoa(ROUNDS, NAMES, LABELS)
    assert automaton.rejecting is None
    assert follow(automaton, "bab.ab") == [False, False, True, False, False, True]
    expected = to_buchi(parse_ltl("GF a & GF b"), NAMES, LABELS)
    np.testing.assert_array_equal(automaton.successors, expected.successors)
    np.testing.assert_array_equal(automaton.marks, expected.marks)


def test_a_finite_task_is_satisfied_with_the_first_accepting_transition() -> None:
    automaton = until_accepting(from_hoa(UNTIL, NAMES, LABELS))
    assert (automaton.run(["", "c", "b", ""]), automaton.run(["", "a"])) == (SATISFIED, VIOLATED)
    assert (automaton.run(["c"]), automaton.run(["b"])) == (RUNNING, RUNNING)


@pytest.mark.parametrize(
    "text",
    [
        "GF a & GF (b & F c)",
        "G (a -> F b) & GF c",
        "(!a U b) & GF c",
        "G !a",
        "GF a | GF b",
        "FG a",
        "FG a & GF b | FG (b | c)",
        "F (a & GF b & G !c) & FG !a",
    ],
)
def test_what_is_written_is_read_again(text: str) -> None:
    automaton = to_buchi(parse_ltl(text), NAMES, LABELS)
    again = from_hoa(to_hoa(automaton, text), NAMES, LABELS)
    np.testing.assert_array_equal(again.successors, automaton.successors)
    np.testing.assert_array_equal(again.marks, automaton.marks)
    assert (again.rejecting, again.jumps) == (automaton.rejecting, automaton.jumps)


# FG a, limit-deterministic in two ways: with a transition that takes no step, and with a second one open to a.
STAY = """HOA: v1 States: 2 Start: 0 AP: 1 "a" Acceptance: 1 Inf(0) --BODY--
State: 0 [t] 0 %s
State: 1 [0] 1 {0}
--END--"""
# Whether b or c is to come again and again is chosen with an a, which without a choice is the former.
WHICH = """HOA: v1 States: 3 Start: 0 AP: 3 "a" "b" "c" Acceptance: 1 Inf(0) --BODY--
State: 0 [!0] 0 [0] 1 [0] 2
State: 1 [!1] 1 [1] 1 {0}
State: 2 [!2] 2 [2] 2 {0}
--END--"""


@pytest.mark.parametrize("choice", ["1", "[0] 1"])
def test_limit_deterministic_automata(choice: str) -> None:
    """Another transition for the same label is taken after a jump to a state that reads this label alone."""
    automaton = from_hoa(STAY % choice, NAMES, LABELS)
    (copy,) = automaton.jumps[0]
    assert automaton.successors[0].tolist() == [0] * 4
    after = automaton.successors[copy]
    assert [int(after[column]) == automaton.rejecting for column in range(4)] == [True, False, True, True]
    stayed = int(after[1])
    assert automaton.marks is not None
    assert (automaton.marks[stayed, 1], int(automaton.successors[stayed, 1])) == (True, stayed)
    with pytest.raises(SpecError, match="the automaton leaves choices, which are for tasks that go on for ever"):
        until_accepting(automaton)


def test_choices_of_a_given_automaton_are_its_language() -> None:
    """Against F (a & X ...) with the one or the other, on random words that repeat."""
    rng = random.Random(0)
    automaton = from_hoa(WHICH, NAMES, LABELS)
    once = parse_ltl("F a & (GF b | GF c)")
    outcomes = []
    for _ in range(300):
        word = [rng.choice(LABELS) for _ in range(rng.randrange(1, 7))]
        loop = rng.randrange(len(word))
        outcomes.append(holds(once, word, loop)[0])
        assert accepts(automaton, word, loop) == outcomes[-1], (word, loop)
    assert 0.2 < np.mean(outcomes) < 0.8


@pytest.mark.parametrize("text", ["F (a & F b)", "!a U (b & (!c U a))", "F a & F b & G !c"])
def test_finite_tasks_too(text: str) -> None:
    automaton = to_automaton(parse_ltl(text), NAMES, LABELS)
    again = until_accepting(from_hoa(to_hoa(automaton), NAMES, LABELS))
    np.testing.assert_array_equal(again.successors, automaton.successors)
    assert (again.accepting, again.rejecting) == (automaton.accepting, automaton.rejecting)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("v1", "v2", "line 1, column 6: found 'v2', expected v1"),
        ("HOA:", "HOB:", "expected 'HOA:'"),
        ("Start: 0", "Start: 7", "found no state 7, with which it starts"),
        ("Start: 0", "", "expected 'Start:' in the header"),
        ("Start: 0", "Start: 0 & 1", "no alternation"),
        ("Start: 0", "Start: 0 Start: 1", "expected one initial state"),
        ('AP: 2 "b" "a"', 'AP: 2 "b"', "expected the name of a proposition"),
        ('"b"', '"z"', "line 7, column 7: 'z' is no proposition, expected some of a, b, c"),
        ("1 Inf(0)", "1 Fin(0)", "found the acceptance 1 Fin ( 0 ), expected Büchi: 1 Inf(0)"),
        ("1 Inf(0)", "2 Inf(0)&Inf(1)", "expected Büchi"),
        ("[!1] 0", "[!1] 0 {1}", "the acceptance set of a Büchi automaton"),
        ("[!1] 0", "[!2] 0", "found '2', expected a label: t, f, !, an alias, or a number below 2"),
        ("[!1] 0", "[!1 0", "found '0', expected ']'"),
        ("[!1] 0", "[!1] 5", "found no state 5, to which a transition leads"),
        ("[!1] 0", "[!1] 0 & 1", "no alternation"),
        ("[!0] 1\n[(0 | f) & t] 0 {0}", "1 0", "no transition of the state has a label: implicit ones are not read"),
        ("[!1] 0", "0 {0}", "a transition without a label takes no step and cannot accept"),
        ("[!1] 0", "[" + "(" * 300 + "0" + ")" * 300 + "] 0", "nested more than 200 deep"),
        ("State: 1", "State: 0", "state 0 is there twice"),
        ("--END--", "", "found the end of the text, expected '--END--'"),
        ("--END--", "--END-- HOA: v1", "expected the end of the text: one automaton"),
        ("--BODY--", "", "expected"),
        ("State: 1", "State: 20000", "found no state 1"),
        ("\\n", "\\x00", "expected a word of the HOA format"),
    ],
)
def test_what_is_refused(old: str, new: str, message: str) -> None:
    old, new = (text.encode().decode("unicode_escape") for text in (old, new))
    assert old in ROUNDS
    with pytest.raises(SpecError, match="line") as caught:
        from_hoa(ROUNDS.replace(old, new, 1), NAMES, LABELS)
    assert message in str(caught.value)


def test_whatever_is_made_of_a_text_is_read_or_refused() -> None:
    rng = random.Random(0)
    words = [*ROUNDS.split(), "[", "]", "{", "}", "(", ")", "&", "|", "!", "999999999", "@x", '"', "--ABORT--"]
    for _ in range(1000):
        text = ROUNDS
        for _ in range(rng.randrange(1, 4)):
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice(["", " " + rng.choice(words) + " "]) + text[at + rng.randrange(0, 6) :]
        try:
            from_hoa(text, NAMES, LABELS)
        except SpecError:
            continue
