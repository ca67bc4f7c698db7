from __future__ import annotations

import io
import sys

import jax.numpy as jnp
import pytest
from matplotlib.figure import Figure

from hrlspec.spec import SATISFIED, VIOLATED, advance, compile_task, draw_task, initial, parse
from hrlspec.spec.draw_automaton import MAX_DRAWN, draw_automaton
from hrlspec.spec.ltl import parse_ltl, to_automaton, to_buchi
from tests.spec.tasks import NAMES

TASK = compile_task(parse("achieve a ensuring not e; (achieve b or achieve c and d) or achieve d"), NAMES, 12)


def _after(*steps: str):
    state = initial(TASK)
    for now in steps:
        state = advance(TASK, state, jnp.array([name in now for name in NAMES]), -1)
    return state


def _texts(figure: Figure) -> set[str]:
    return {text.get_text() for text in figure.axes[0].texts}


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=40)
    return buffer.getvalue()


def test_edges_carry_their_subtasks() -> None:
    texts = _texts(draw_task(TASK, NAMES))
    assert {"a\n¬d\n¬e", "d\n¬a", "b\n¬c\n¬d", "c∧d\n¬b"} <= texts
    assert {"0", "1", "2", "3", "4"} <= texts


def test_progress_shows() -> None:
    states = [None, _after(), _after("e"), _after("a"), _after("a", "b"), _after("d")]
    pictures = [_png(draw_task(TASK, NAMES, state)) for state in states]
    assert len(set(pictures)) == len(pictures)
    assert int(states[4].status) == SATISFIED
    violated = compile_task(parse("achieve a ensuring not b"), NAMES, 4)
    state = advance(violated, initial(violated), jnp.array([False, True, False, False, False]), 1)
    assert int(state.status) == VIOLATED
    assert _png(draw_task(violated, NAMES, state)) != _png(draw_task(violated, NAMES))


def test_given_axes_are_used() -> None:
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert draw_task(TASK, NAMES, ax=right) is figure
    assert not left.texts
    assert right.texts


def test_names_must_match() -> None:
    with pytest.raises(ValueError, match="names"):
        draw_task(TASK, ["a"])


def test_an_automaton_carries_short_guards() -> None:
    labels = [set(), *NAMES]
    texts = _texts(draw_automaton(to_automaton(parse_ltl("!a U (b & (!c U d))"), NAMES, labels)))
    # Of the rejecting and the accepting state nothing more is said.
    assert texts == {*"01234", "", *"abcd", "↻ ¬a∧¬b", "↻ ¬a∧¬c∧¬d", "↻ ¬c∧¬d"}
    texts = _texts(draw_automaton(to_buchi(parse_ltl("GF (a | b) & GF c"), NAMES, labels)))
    assert {"a ∨\nb", "● c"} <= texts
    assert "ε" in _texts(draw_automaton(to_buchi(parse_ltl("FG a"), NAMES, labels)))
    one = draw_automaton(to_buchi(parse_ltl("GF a"), NAMES, labels))
    assert "↻ ¬a\n● a" in _texts(one)
    figure = Figure()
    assert draw_automaton(to_automaton(parse_ltl("false"), NAMES, labels), figure.subplots()) is figure
    assert _texts(figure) == {"0", ""}


def test_pictures_of_automata_tell_them_apart() -> None:
    labels = [set(), *NAMES]
    ways = [to_automaton, to_buchi]
    pictures = [_png(draw_automaton(way(parse_ltl(text), NAMES, labels))) for way in ways for text in ("F a", "!b U a")]
    assert len(set(pictures)) == 4


def test_an_automaton_too_large_for_a_picture_is_refused() -> None:
    large = to_automaton(parse_ltl(" & ".join(f"F ({name} & X F {name})" for name in "abcd")), NAMES)
    assert large.num_states > MAX_DRAWN
    with pytest.raises(ValueError, match=f"has {large.num_states} states, a picture shows {MAX_DRAWN} at most"):
        draw_automaton(large)


def test_missing_libraries_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "networkx", None)
    with pytest.raises(ImportError, match=r"hrlspec\[plot\]"):
        draw_task(TASK, NAMES)
    with pytest.raises(ImportError, match=r"hrlspec\[plot\]"):
        draw_automaton(to_automaton(parse_ltl("F a"), NAMES))
