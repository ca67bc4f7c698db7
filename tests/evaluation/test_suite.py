"""Suites as text: reading, mistakes, padding."""

from __future__ import annotations

import numpy as np
import pytest

from hrlspec.evaluation import suite_from_text, suite_from_trees
from hrlspec.spec import SpecError, SpecWarning
from hrlspec.tasks.sampling import sample_trees

LETTERS = ("a", "b", "c", "d", "e")


def test_comments_blank_lines_and_depths():
    suite = suite_from_text("some", "# first\n\nachieve a # why not\r\n  achieve b; achieve c or achieve d\n", LETTERS)
    assert suite.formulas == ("achieve a", "achieve b; achieve c or achieve d")
    assert suite.depths.tolist() == [1, 2]
    assert len(suite) == 2
    assert suite.trees.parent.shape == (2, 8)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("achieve a\n  achieve z\n", "line 2, column"),
        ("achieve a\n\n  achieve a and and b", "line 3, column 17"),
        ("\ufeff# marked\n\nachieve z", "^wrong, line 3, column 9: unknown proposition 'z'"),
        ("achieve a\fachieve b", "^wrong, line 1, column 11: found 'achieve'"),
        ("achieve a\r\n \tachieve (b or c", r"line 2, column 18: .* for the '\(' at line 2, column 11"),
        ("# nothing\n\n", "^wrong: found no formula"),
        ("", "no formula"),
    ],
)
def test_mistakes_say_where(text, place):
    with pytest.raises(SpecError, match=place):
        suite_from_text("wrong", text, LETTERS)


@pytest.mark.parametrize("mark", ["", "\ufeff"])
@pytest.mark.parametrize("first", ["# a comment", "", " ", "achieve c"])
@pytest.mark.parametrize("end", ["\n", "\r", "\r\n"])
def test_lines_end_where_the_language_says(mark, first, end):
    """Other white space separates words, and a byte order mark means nothing; the formula is kept on one line."""
    space = "\f\v\u2028\u2029\x85\x1c\x1d\x1e\u00a0"
    text = mark + first + end + space.join(["", "achieve", "a;", "achieve", "b", ""]) + end
    assert suite_from_text("odd", text, LETTERS).formulas[-1] == "achieve a; achieve b"
    assert len(suite_from_text("odd", text, LETTERS)) == (2 if "achieve" in first else 1)


def test_warnings_say_the_line():
    with pytest.warns(SpecWarning, match="line 2, column 18: alternatives left out"):
        suite_from_text("warned", "achieve c\nachieve (a or b) ensuring not a", LETTERS)


def test_too_large_a_tree_is_refused_with_its_line():
    text = "achieve a\nachieve a; achieve b; achieve c"
    with pytest.raises(SpecError, match="line 2"):
        suite_from_text("large", text, LETTERS, max_nodes=3)


def test_trees_to_text_and_back_are_the_same_tasks():
    trees = sample_trees(
        np.random.default_rng(0),
        num_tasks=30,
        num_propositions=5,
        max_nodes=20,
        min_depth=1,
        max_depth=4,
        max_branching=3,
    )
    suite = suite_from_trees("drawn", trees, LETTERS)
    back = suite_from_text("drawn", "\n".join(suite.formulas), LETTERS)
    np.testing.assert_array_equal(back.hashes, suite.hashes)
    np.testing.assert_array_equal(back.depths, np.asarray(trees.depth).max(-1))
    assert back.trees.parent.shape == suite.trees.parent.shape == (30, 24)


def test_a_part_of_a_suite():
    suite = suite_from_text("three", "achieve a\nachieve b\nachieve c; achieve d", LETTERS)
    part = suite.take([2, 0])
    assert part.formulas == ("achieve c; achieve d", "achieve a")
    np.testing.assert_array_equal(part.hashes, suite.hashes[[2, 0]])
