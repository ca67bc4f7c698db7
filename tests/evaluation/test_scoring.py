"""Scores worked out by hand, their JSON form, and aggregates over runs."""

from __future__ import annotations

import dataclasses
import json

import jax
import numpy as np
import pytest

import envs_jax
from hrlspec.evaluation import BranchCases, Cases, Score, SuiteResult, aggregate, suite_from_text
from hrlspec.evaluation.episodes import Episodes
from hrlspec.evaluation.scoring import path_ratio, score_choices, score_returns, score_suite
from hrlspec.evaluation.stats import Interval, bounded_interval, interquartile_mean, mean_interval, rate_interval
from hrlspec.exact.contested import ContestedSuite
from hrlspec.tasks.rewards import reward_machine

LETTERS = envs_jax.make("letter").propositions
SUITE = suite_from_text("two", "achieve a\nachieve b; achieve c", LETTERS)
TASK = np.array([0, 0, 1, 1])
EPISODES = Episodes(
    success=np.array([True, True, False, True]),
    violated=np.array([False, False, True, False]),
    steps=np.array([2, 8, 3, 5], np.int32),
    returns=np.array([1.0, 1.0, 0.5, 2.0], np.float32),
    rounds=np.zeros(4, np.int32),
    ended=np.zeros(4, bool),
)
MACHINE = reward_machine(LETTERS, subtask=0.5)
CASES = Cases(
    suite=SUITE,
    task=TASK,
    layouts=np.zeros((4, 7, 7), np.int8),
    optimum=np.array([2, 4, 3, 5], np.float32),
    myopic=np.array([2, 5, np.inf, 80], np.float32),
    excluded=3,
)


def _score(cases: Cases = CASES, episodes: Episodes = EPISODES) -> SuiteResult:
    return score_suite(cases, episodes, MACHINE, horizon=75, greedy=True, shield=False)


def test_path_ratio():
    taken, optimum = np.array([4, 2, 9, 3]), np.array([2.0, 2.0, 3.0, 4.0])
    ratio = path_ratio(np.array([True, True, False, True]), taken, optimum)
    np.testing.assert_allclose(ratio, [0.5, 1, 0, 1])


def test_totals_by_hand():
    result = _score()
    total = result.total
    assert (total.episodes, result.excluded, result.suite) == (4, 3, "two")
    assert total.success_rate == rate_interval([1, 1, 0, 1])
    assert total.violation_rate.estimate == 0.25
    assert total.return_mean == bounded_interval([1, 1, 0.5, 2], 0, 2)
    assert total.steps_mean.estimate == 5  # of 2, 8 and 5: the failed episode does not count
    assert total.spl.estimate == pytest.approx((1 + 0.5 + 0 + 1) / 4)
    assert 0 <= total.spl.low <= total.spl.high <= 1
    assert total.optimal_steps_mean == pytest.approx((2 + 4 + 5) / 3)
    assert total.myopic_success_rate == 0.5  # 80 steps are beyond the horizon
    assert total.myopic_spl == pytest.approx((1 + 0.8) / 4)


def test_depths_and_tasks_by_hand():
    result = _score()
    assert [(each.task, each.depth) for each in result.per_task] == [("achieve a", 1), ("achieve b; achieve c", 2)]
    assert result.per_task[0].score == result.per_depth[1]
    assert result.per_task[1].score.spl.estimate == 0.5
    # Episodes of a single task are independent given the task; the most that this one can give is 1.5.
    assert result.per_task[0].score.return_mean == bounded_interval([1, 1], 0, 1.5)
    assert result.per_task[0].score.intervals_over == "episodes"


def _outcomes(success: np.ndarray, steps: np.ndarray) -> Episodes:
    returns = success.astype(np.float32)
    return Episodes(
        success=success,
        violated=~success,
        steps=steps.astype(np.int32),
        returns=returns,
        rounds=np.zeros_like(steps),
        ended=~success,
    )


def _many(tasks: int, outcomes: Episodes) -> Score:
    """Of the outcomes of one task, repeated for several."""
    depth_two = suite_from_text("many", "achieve b; achieve c\n" * tasks, LETTERS)
    size = len(outcomes.success)
    cases = Cases(depth_two, np.arange(tasks).repeat(size), CASES.layouts, None, None, 0)
    repeated = jax.tree.map(lambda x: np.tile(x, tasks), outcomes)
    return score_suite(cases, repeated, MACHINE, horizon=75, greedy=True, shield=False).total


def test_from_ten_tasks_on_intervals_are_over_tasks():
    few, many = _many(9, EPISODES), _many(10, EPISODES)
    assert (few.intervals_over, many.intervals_over) == ("episodes", "tasks")
    assert few.success_rate == rate_interval(np.tile(EPISODES.success, 9))
    tasks = np.arange(10).repeat(4)
    assert many.success_rate == rate_interval(np.tile(EPISODES.success, 10), tasks=tasks)
    assert many.return_mean == mean_interval(np.tile(EPISODES.returns, 10), tasks=tasks)


@pytest.mark.parametrize("tasks", [1, 2, 3, 9, 10, 12])
def test_intervals_hold_nothing_impossible(tasks: int):
    """Tasks that differ much: the variance between two of them says next to nothing about others."""
    text = "".join(f"achieve {'b' if row % 2 else 'c'}\n" for row in range(tasks))
    suite, rng = suite_from_text("few", text, LETTERS), np.random.default_rng(tasks)
    task = np.arange(tasks).repeat(50)
    success = rng.random(task.size) < np.where(task % 2, 1, 0.9)
    steps = np.where(task % 2, 70, 3) + rng.integers(0, 6, task.size)
    optimum = np.full(task.size, 3, np.float32)
    cases = Cases(suite, task, np.zeros((task.size, 1)), optimum, optimum, 0)
    episodes = _outcomes(success, steps)
    machine = reward_machine(LETTERS)
    total = score_suite(cases, episodes, machine, horizon=75, greedy=True, shield=False).total
    possible = {"return_mean": (0, 1), "spl": (0, 1), "success_rate": (0, 1), "steps_mean": (1, 75)}
    for name, (low, high) in possible.items():
        found = getattr(total, name)
        assert low <= found.low < found.estimate < found.high <= high, name
    if total.intervals_over == "episodes":  # success and return are the same numbers here
        np.testing.assert_allclose(total.return_mean, total.success_rate, atol=0.01)


def test_steps_of_few_tasks_among_many_have_no_interval():
    tasks = np.arange(12)
    suite = suite_from_text("many", "achieve b\n" * 12, LETTERS)
    cases = Cases(suite, tasks, np.zeros((12, 1)), None, None, 0)
    success = tasks < 3
    total = score_suite(cases, _outcomes(success, tasks + 1), MACHINE, horizon=75, greedy=True, shield=False).total
    data = json.loads(json.dumps(total.to_json(), allow_nan=False))
    assert (data["intervals_over"], data["steps_mean"], data["steps_mean_interval"]) == ("tasks", 2.0, None)


def test_json_keys_and_round_trip():
    result = _score()
    data = json.loads(json.dumps(result.to_json(), allow_nan=False))
    for name in ("success_rate", "return_mean", "steps_mean", "spl"):
        assert isinstance(data[name], float)
        assert len(data[f"{name}_interval"]) == 2
    assert {"episodes", "per_task", "per_depth", "actions", "excluded"} <= set(data)
    assert data["per_depth"]["2"]["success_rate"] == data["per_task"][1]["success_rate"] == 0.5
    # One episode alone succeeded at depth 2, so its steps have no interval.
    assert data["per_depth"]["2"]["steps_mean_interval"] is None
    assert data["intervals_over"] == data["per_task"][0]["intervals_over"] == "episodes"
    assert SuiteResult.from_json(data).to_json() == data


def test_results_that_do_not_say_what_intervals_are_over():
    data = _score().to_json()
    del data["intervals_over"]
    assert SuiteResult.from_json(data).total.intervals_over == "tasks"


def test_all_failed_is_json_too():
    failed = EPISODES.replace(success=np.zeros(4, bool))
    data = json.loads(json.dumps(_score(episodes=failed).to_json(), allow_nan=False))
    assert data["steps_mean"] is None
    assert data["spl"] == data["success_rate"] == 0
    assert SuiteResult.from_json(data).to_json() == data


def test_no_optimum_no_spl():
    result = _score(dataclasses.replace(CASES, optimum=None, myopic=None))
    assert result.total.spl is None
    data = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert data["spl"] is data["spl_interval"] is data["myopic_spl"] is None
    assert SuiteResult.from_json(data).total.spl is None
    assert set(result.metrics()) == {"eval/return_mean", "eval/success_rate", "eval/steps_mean"}


def test_returns_by_hand():
    cases = BranchCases(
        suite=SUITE,
        task=TASK,
        layouts=CASES.layouts,
        optimum=np.array([1, 2, 1, 4], np.float32),
        random=np.array([1, 1, 0.5, 3], np.float32),
        longest=np.array([0, 2, 1, 4], np.float32),
        excluded=2,
    )
    result = score_returns(cases, EPISODES, MACHINE, greedy=False)
    assert result.ratio.estimate == pytest.approx((1 + 0.5 + 0.5 + 0.5) / 4)
    assert result.random_branch == pytest.approx((1 + 0.5 + 0.5 + 0.75) / 4)
    assert result.longest_branch == 0.75
    assert result.per_depth[2].estimate == 0.5
    assert 0 <= result.ratio.low < result.ratio.estimate < result.ratio.high <= 1
    assert result.to_json()["intervals_over"] == "episodes"
    assert result.to_json()["return_over_optimum"] == pytest.approx(0.625)


def test_choices_by_hand():
    right = np.zeros((6, 5), bool)
    right[:, 3] = right[0, 4] = True
    suite = ContestedSuite(
        layouts=None,
        tasks=None,  # type: ignore[arg-type]
        contested=np.array([True, True, True, False, False, False]),
        right=right,
        nearest=np.zeros(6, int),
        optimum=np.ones(6, np.float32),
    )
    # Right; wrong place; right place but failed; right; right; no first edge (the last state is no excuse).
    place = np.array([4, 4, 3, 3, 3, -1])
    success = np.array([True, True, False, True, True, False])
    result = score_choices(suite, success, place, greedy=True)
    assert result.contested.estimate == pytest.approx(1 / 3)
    assert result.controls.estimate == pytest.approx(2 / 3)
    assert result.score.estimate == pytest.approx(0.5)
    assert 0 < result.score.low < 0.5 < result.score.high < 1
    assert result.failures == pytest.approx(1 / 3)


def _run(spl: tuple[float, float]) -> SuiteResult:
    base = _score()

    def with_spl(score: Score, value: float) -> Score:
        return dataclasses.replace(score, spl=Interval(value, value, value))

    per_task = tuple(
        dataclasses.replace(each, score=with_spl(each.score, value))
        for each, value in zip(base.per_task, spl, strict=True)
    )
    return dataclasses.replace(base, total=with_spl(base.total, float(np.mean(spl))), per_task=per_task)


def test_aggregates_by_hand():
    table = np.array([[0.1, 0.9], [0.3, 0.7], [0.2, 1.0]])
    result = aggregate([_run(tuple(row)) for row in table])
    assert result["spl"].mean == mean_interval(table.mean(1))
    assert result["spl"].iqm.estimate == interquartile_mean(table)
    assert result["spl"].iqm.low <= result["spl"].iqm.estimate <= result["spl"].iqm.high
    assert result["spl"].runs == 3
    assert result["success_rate"].mean.low == result["success_rate"].mean.high == 0.75
    json.dumps({name: each.to_json() for name, each in result.items()}, allow_nan=False)


def test_what_cannot_be_aggregated():
    with pytest.raises(ValueError, match="no result"):
        aggregate([])
    with pytest.raises(ValueError, match="different tasks or in different ways"):
        aggregate([_score(), dataclasses.replace(_score(), greedy=False)])
    unknown = _score(dataclasses.replace(CASES, optimum=None, myopic=None))
    assert "spl" not in aggregate([unknown, unknown])
    failed = _score(episodes=EPISODES.replace(success=np.array([True, True, False, False])))
    assert aggregate([failed, failed])["steps_mean"].iqm is None
    assert aggregate([failed, failed])["steps_mean"].mean.estimate == 5
