from __future__ import annotations

import io
import sys

import jax.numpy as jnp
import pytest
from matplotlib.figure import Figure

from hrlspec.spec import SATISFIED, VIOLATED, advance, compile_task, draw_task, initial, parse
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


def test_missing_libraries_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "networkx", None)
    with pytest.raises(ImportError, match=r"hrlspec\[plot\]"):
        draw_task(TASK, NAMES)
