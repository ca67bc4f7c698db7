"""Conditions in words say what the table says, label by label."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hrlspec.spec.ltl.guards import guards

NAMES = ("a", "b", "c")
ALL = np.array(list(itertools.product((False, True), repeat=3)))
ONE_AT_MOST = np.vstack([np.zeros((1, 3), bool), np.eye(3, dtype=bool)])


def true_of(condition: str, row: np.ndarray) -> bool:
    return condition == "always" or bool(eval(condition, {}, dict(zip(NAMES, row.tolist(), strict=True))))


@given(st.sampled_from([ALL, ONE_AT_MOST]), st.data())
def test_each_label_meets_the_condition_of_where_it_leads_alone(holds: np.ndarray, data: st.DataObject) -> None:
    leads = np.array(data.draw(st.lists(st.integers(0, 3), min_size=len(holds), max_size=len(holds))))
    found = guards(holds, leads, NAMES)
    assert found.keys() == {*leads.tolist()}
    for row, place in zip(holds, leads, strict=True):
        assert [other for other, condition in found.items() if true_of(condition, row)] == [place]


def test_conditions_are_short() -> None:
    assert guards(ALL, np.zeros(8, int), NAMES) == {0: "always"}
    assert guards(ONE_AT_MOST, np.array([0, 1, 0, 2]), NAMES) == {0: "not a and not c", 1: "a", 2: "c"}
    assert guards(ALL, (ALL[:, 0] & ~ALL[:, 1]).astype(int), NAMES) == {0: "b or not a", 1: "a and not b"}
