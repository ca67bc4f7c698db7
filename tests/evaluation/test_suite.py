"""Suites as text: reading, mistakes, padding."""

from __future__ import annotations

import numpy as np
import pytest

from hrlspec.evaluation import suite_from_text, suite_from_trees
from hrlspec.spec import SpecError
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
        ("# nothing\n\n", "no formula"),
        ("", "no formula"),
    ],
)
def test_mistakes_say_where(text, place):
    with pytest.raises(SpecError, match=place):
        suite_from_text("wrong", text, LETTERS)


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
