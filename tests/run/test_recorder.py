"""Layouts and tasks as they are recorded: all of one size. What is recorded then: tests/run/test_play.py."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from hrlspec.run.replay.recorder import draw_layouts
from hrlspec.run.replay.tasks import USUAL_NODES, Language, read_task
from hrlspec.spec import SpecError
from tests.run.replays import LETTER

NUMBER = 3


def test_layouts_are_those_of_the_world() -> None:
    keys = jax.random.split(jax.random.key(7), NUMBER)
    wanted = jax.vmap(LETTER.sample_layout, (0, None))(keys, LETTER.default_params)
    np.testing.assert_array_equal(draw_layouts(LETTER, 7, NUMBER, kept=False), wanted)


@pytest.mark.parametrize(
    ("language", "texts"),
    [("spec", ("achieve a", "achieve a; (achieve b or achieve c) ensuring not d")), ("ltl", ("F a", "F a & G !b"))],
)
def test_tasks_are_of_one_size(language: Language, texts: tuple[str, str]) -> None:
    one, other = (read_task("task", language, text, LETTER)[1] for text in texts)
    assert jax.tree.map(np.shape, one) == jax.tree.map(np.shape, other)


def test_larger_tasks_have_a_size_of_their_own_unless_only_usual_ones_are_wanted() -> None:
    text = "; ".join(["(achieve a or achieve b)"] * 6)
    assert read_task("task", "spec", text, LETTER)[1].parent.shape == (1, 256)
    with pytest.raises(SpecError, match=f"127 nodes, max_nodes is {USUAL_NODES}"):
        read_task("task", "spec", text, LETTER, usual=True)
    wide = " & ".join(f"F ({x} & X F ({y} & X F {z}))" for x, y, z in ("abc", "bcd", "cde", "dea"))
    assert len(read_task("task", "ltl", wide, LETTER)[1].status) > 64
    with pytest.raises(SpecError, match="states, 64 are possible"):
        read_task("task", "ltl", wide, LETTER, usual=True)


def test_a_task_over_several_lines_with_comments() -> None:
    formula, _ = read_task("task", "spec", "achieve a;  # first\n\n  achieve b", LETTER)
    assert formula == "achieve a; achieve b"
    with pytest.raises(SpecError) as refused:
        read_task("task", "spec", "  achieve z", LETTER)
    assert refused.value.column == 11
