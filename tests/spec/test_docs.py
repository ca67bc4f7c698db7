"""The examples of docs/semantics.md, docs/language.md and docs/tasks.md."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import jax.numpy as jnp
import pytest

from hrlspec.presets.peers import peer_suites
from hrlspec.spec import (
    RUNNING,
    SATISFIED,
    VIOLATED,
    SpecError,
    TaskTree,
    advance,
    compile_task,
    compiler,
    conditions,
    graph,
    initial,
    parse,
    satisfies,
    syntax,
    task_hash,
)
from hrlspec.spec.dfa import from_json
from hrlspec.spec.ltl import parse_ltl, satisfies_ltl, to_automaton, to_buchi
from hrlspec.spec.readings import committed_automaton, exact_automaton
from tests.spec.tasks import NAMES

DOCS = Path(__file__).parents[2] / "docs"


def _blocks(page: str, kind: str) -> list[list[str]]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return [block.strip().splitlines() for block in re.findall(rf"^```{kind}\n(.*?)^```$", text, re.M | re.S)]


def _rows(kind: str) -> list[tuple[str, str]]:
    rows = [line.split("|") for block in _blocks("language.md", kind) for line in block]
    return [(left.strip(), right.strip()) for left, right in rows]


EXAMPLES = _blocks("semantics.md", "spectrl")


def _monitor(text: str, trace: list[set[str]]) -> str:
    try:
        tree = compile_task(parse(text), NAMES, 16)
    except SpecError:
        return "refused"
    state = initial(tree)
    for now in trace:
        state = advance(tree, state, jnp.array([name in now for name in NAMES]), TaskTree.NO_NODE)
    return {RUNNING: "running", SATISFIED: "satisfied", VIOLATED: "violated"}[int(state.status)]


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
@pytest.mark.parametrize("lines", EXAMPLES, ids=" | ".join)
def test_example_means_what_the_page_says(lines: list[str]) -> None:
    text, second = lines
    steps, verdicts = second.split("->")
    monitor, exact = (word.strip() for word in verdicts.split(","))
    trace = [set(re.findall(r"\w+", step)) for step in re.findall(r"\{(.*?)\}", steps)]
    assert _monitor(text, trace) == monitor
    assert satisfies(parse(text), trace) == {"true": True, "false": False}[exact]


def test_every_kind_of_example_is_there() -> None:
    verdicts = {lines[1].split("->")[1].strip() for lines in EXAMPLES}
    assert {"violated, true", "running, true", "violated, false", "satisfied, true", "running, false"} <= verdicts
    assert len(EXAMPLES) >= 20


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
@pytest.mark.parametrize(("text", "same"), _rows("equal"))
def test_equal_tasks(text: str, same: str) -> None:
    assert int(task_hash(compile_task(parse(text), NAMES, 16))) == int(task_hash(compile_task(parse(same), NAMES, 16)))


@pytest.mark.parametrize(("text", "reason"), _rows("refused"))
def test_refused_tasks(text: str, reason: str) -> None:
    with pytest.raises(SpecError) as caught:
        compile_task(parse(text), NAMES, 16)
    assert str(caught.value).startswith(reason)


def test_limits_are_as_written() -> None:
    page = (DOCS / "language.md").read_text(encoding="utf-8").partition("## Limits")[2]
    table = re.findall(r"^\| .*\| \D*(\d[\d,]*)[^|]*\|$", page, re.M)
    expected = [
        syntax.MAX_TEXT,
        syntax.MAX_NESTING,
        syntax.MAX_TERMS,
        conditions.MAX_ALTERNATIVES,
        graph.MAX_STEPS,
        syntax.MAX_WORK,
        compiler.MAX_NODES,
    ]
    assert [int(number.replace(",", "")) for number in table] == expected


# --- docs/tasks.md ---

LABELS = [frozenset(some) for size in range(4) for some in itertools.combinations("abcd", size)]
STATUS = {RUNNING: "running", SATISFIED: "satisfied", VIOLATED: "violated"}


def _split(line: str) -> tuple[list[set[str]], str]:
    """The trace and what is said of it."""
    before, _, after = line.partition("->")
    return [set(re.findall(r"\w", label)) for label in re.findall(r"\{(.*?)\}", before)], after.strip()


@pytest.mark.parametrize("lines", _blocks("tasks.md", "ltl"), ids=" | ".join)
def test_a_formula_means_what_the_page_says(lines: list[str]) -> None:
    formula, (trace, said) = parse_ltl(lines[0]), _split(lines[1])
    assert STATUS[to_automaton(formula, "abcd", LABELS).run(trace)] == said
    assert satisfies_ltl(formula, trace) == (said == "satisfied")


@pytest.mark.parametrize("lines", _blocks("tasks.md", "forever"), ids=" | ".join)
def test_rounds_are_as_many_as_the_page_says(lines: list[str]) -> None:
    """Where it has ε the automaton jumps."""
    automaton, (trace, said) = to_buchi(parse_ltl(lines[0]), "abcd", LABELS), _split(lines[1])
    assert automaton.marks is not None
    before_jump = [len(re.findall(r"\{", part)) for part in lines[1].split("ε")[:-1]]
    state = rounds = 0
    for step, label in enumerate(trace):
        if step in before_jump:
            (state,) = automaton.jumps[state]
        column = automaton.labels.index(frozenset(label))
        rounds += bool(automaton.marks[state, column])
        state = int(automaton.successors[state, column])
    assert str(rounds) == said


@pytest.mark.parametrize("lines", _blocks("tasks.md", "twins"), ids=" | ".join)
def test_twins_agree_and_differ_where_the_page_says(lines: list[str]) -> None:
    (text, _, ltl), (trace, said) = lines[0].partition(" | "), _split(lines[1])
    automaton = to_automaton(parse_ltl(ltl), "abcd", LABELS)
    assert f"{_monitor(text, trace)}, {STATUS[automaton.run(trace)]}" == said


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
@pytest.mark.parametrize("lines", _blocks("tasks.md", "readings"), ids=" | ".join)
def test_readings_differ_where_the_page_says(lines: list[str]) -> None:
    formula, (trace, said) = parse(lines[0]), _split(lines[1])
    try:
        committed = STATUS[committed_automaton(compile_task(formula, list("abcd"), 16), "abcd", LABELS).run(trace)]
    except SpecError:
        committed = "refused"
    exact = STATUS[exact_automaton(formula, "abcd", LABELS).run(trace)]
    assert f"committed {committed}, exact {exact}" == said
    assert committed == _monitor(lines[0], trace)
    assert satisfies(formula, trace) == (exact == "satisfied")


@pytest.mark.parametrize("lines", _blocks("tasks.md", "dfa"), ids=" | ".join)
def test_a_dictionary_means_what_the_page_says(lines: list[str]) -> None:
    trace, said = _split(lines[1])
    assert STATUS[from_json(lines[0], "ab", [set(), "a", "b"]).run(trace)] == said


def test_the_page_names_all_published_suites() -> None:
    page = (DOCS / "tasks.md").read_text(encoding="utf-8")
    assert set(re.findall(r"`(\w+/\w+_\w+)`", page)) == set(peer_suites())
