"""Cases: layouts of a task, and what is left out."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

import envs_jax
from hrlspec.evaluation import make_branch_cases, make_cases, suite_from_text
from hrlspec.evaluation.cases import draw_layouts, task_of
from hrlspec.exact import solver
from hrlspec.tasks.rewards import reward_machine

LETTER = envs_jax.make("letter")
HURRY = envs_jax.make("letter", horizon=6)
TASKS = "achieve a; achieve b ensuring not c\nachieve d\nachieve e; achieve d; achieve b or achieve c; achieve a"


@functools.cache
def _suite():
    return suite_from_text("tasks", TASKS, LETTER.propositions)


def test_pairs_beyond_the_horizon_are_replaced_and_counted():
    cases = make_cases(HURRY, _suite(), layouts_per_task=12)
    assert np.bincount(cases.task).tolist() == [12, 12, 12]
    assert cases.excluded > 0
    assert (cases.optimum <= 6).all()
    optimum = solver.optimal_steps(solver.tabulate(HURRY, cases.layouts[:12]), task_of(_suite(), 0))
    np.testing.assert_array_equal(optimum, cases.optimum[:12])
    # The kept ones are the first possible ones of those that are drawn, and all impossible ones are counted.
    drawn = [solver.tabulate(HURRY, draw_layouts(HURRY, _suite(), 12, draw=draw)) for draw in range(8)]
    excluded = 0
    for row in range(3):
        steps = np.concatenate(
            [solver.optimal_steps(graph[12 * row : 12 * row + 12], task_of(_suite(), row)) for graph in drawn]
        )
        np.testing.assert_array_equal(steps[steps <= 6][:12], cases.optimum[cases.task == row])
        rounds = -(-(np.flatnonzero(steps <= 6)[11] + 1) // 12)
        excluded += (steps[: 12 * rounds] > 6).sum()
    assert cases.excluded == excluded


def test_the_myopic_agent_is_never_better():
    cases = make_cases(LETTER, _suite(), layouts_per_task=12)
    assert cases.excluded == 0
    assert (cases.myopic >= cases.optimum).all()


def test_an_impossible_task_is_refused():
    with pytest.raises(ValueError, match=r"'achieve a; achieve b' can be satisfied within 1 steps in only 0 of 200"):
        make_cases(
            envs_jax.make("letter", horizon=1), suite_from_text("one", "achieve a; achieve b", LETTER.propositions)
        )


def test_layouts_belong_to_the_task_and_the_seed():
    whole, part = _suite(), _suite().take([2])
    one = draw_layouts(LETTER, whole, 5)
    np.testing.assert_array_equal(one[10:], draw_layouts(LETTER, part, 5))
    assert not np.array_equal(one, draw_layouts(LETTER, whole, 5, seed=1))
    assert not np.array_equal(one, draw_layouts(LETTER, whole, 5, draw=1))
    assert len(np.unique(one.reshape(15, -1), axis=0)) == 15
    # A task's layouts are the same however many are asked for.
    np.testing.assert_array_equal(one[:5], draw_layouts(LETTER, whole, 20)[:5])


def test_branch_cases_are_those_where_the_branch_matters():
    machine = reward_machine(LETTER.propositions, subtask=1.0)
    suite = suite_from_text(
        "two", "achieve a or achieve b; achieve c\nachieve a; achieve b or achieve c; achieve d", LETTER.propositions
    )
    cases = make_branch_cases(LETTER, suite, machine, layouts_per_task=8)
    # Returns 2 and 3 differ by a third; two branches of two sub-tasks pay the same.
    assert (cases.task == 0).all()
    assert len(cases) == 8 == cases.excluded
    assert (cases.optimum == 3).all()
    assert (cases.random == 2.5).all()
    assert (cases.longest == 3).all()
    assert jax.tree.leaves(cases.layouts)[0].shape[0] == jax.tree.leaves(cases.trees)[0].shape[0] == 8
    with pytest.raises(ValueError, match="the branch matters in none of 8 cases"):
        make_branch_cases(LETTER, suite.take([1]), machine, layouts_per_task=8)
