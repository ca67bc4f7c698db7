"""From episodes to scores: statistics on the host.

Axes: **B** episodes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Real

from hrlspec.evaluation.cases import BranchCases, Cases
from hrlspec.evaluation.episodes import Episodes
from hrlspec.evaluation.results import (
    OVER_EPISODES,
    OVER_TASKS,
    ChoiceResult,
    ReturnResult,
    Score,
    SuiteResult,
    TaskScore,
)
from hrlspec.evaluation.stats import Interval, bounded_interval, mean_interval, rate_interval
from hrlspec.exact.contested import ContestedSuite
from hrlspec.tasks.rewards import RewardMachine, return_bounds


def path_ratio(
    success: Bool[np.ndarray, " B"], taken: Real[np.ndarray, " B"], optimum: Float[np.ndarray, " B"]
) -> Float32[np.ndarray, " B"]:
    """Success × L*/max(taken, L*) of each episode, float32 ``[B]``."""
    return np.where(success, optimum / np.maximum(taken, optimum), 0).astype(np.float32)


FEW_TASKS = 10
"""With fewer tasks intervals are over the episodes, given these tasks: the variance between tasks is hardly known."""


def score_suite(
    cases: Cases, episodes: Episodes, machine: RewardMachine, *, horizon: int, greedy: bool, shield: bool
) -> SuiteResult:
    """Scores of one episode per case: over all, per depth and per task.

    Args:
        cases: B cases.
        episodes: their outcomes, leading axis B.
        machine: the rewards of the episodes.
        horizon: of the environment, for the myopic agent too.
        greedy: how actions were chosen.
        shield: whether the shield was on.
    """
    depth = cases.suite.depths[cases.task]

    def score(where: Int[np.ndarray, " _"]) -> Score:
        return _score(cases, episodes, where, horizon, return_bounds(machine, int(depth[where].max())))

    return SuiteResult(
        suite=cases.suite.name,
        greedy=greedy,
        shield=shield,
        excluded=cases.excluded,
        total=score(np.arange(len(cases))),
        per_depth={int(d): score(np.flatnonzero(depth == d)) for d in np.unique(depth)},
        per_task=tuple(
            TaskScore(formula, int(cases.suite.depths[row]), score(np.flatnonzero(cases.task == row)))
            for row, formula in enumerate(cases.suite.formulas)
        ),
    )


def score_returns(cases: BranchCases, episodes: Episodes, machine: RewardMachine, *, greedy: bool) -> ReturnResult:
    """Return over optimum of one episode per case, and that of the reference agents on the same cases."""
    ratio = np.asarray(episodes.returns) / cases.optimum
    depth = cases.suite.depths[cases.task]
    least = return_bounds(machine, int(depth.max()))[0] / float(cases.optimum.min())
    over = _over(cases.task)

    def mean(where: Bool[np.ndarray, " B"]) -> Interval:
        return _mean(ratio[where], cases.task[where], over, (least, 1.0))

    return ReturnResult(
        suite=cases.suite.name,
        greedy=greedy,
        episodes=len(cases),
        excluded=cases.excluded,
        intervals_over=over,
        ratio=mean(depth == depth),
        success_rate=_rate(np.asarray(episodes.success), cases.task, over),
        random_branch=float((cases.random / cases.optimum).mean()),
        longest_branch=float((cases.longest / cases.optimum).mean()),
        per_depth={int(d): mean(depth == d) for d in np.unique(depth)},
    )


def score_choices(
    suite: ContestedSuite, success: Bool[np.ndarray, " B"], place: Int[np.ndarray, " B"], *, greedy: bool
) -> ChoiceResult:
    """Rates of optimal choices, from where each task's first edge was taken.

    Args:
        suite: the cases.
        success: bool ``[B]``, the task was satisfied.
        place: int ``[B]``, the graph state in which the first edge was taken; negative if it never was.
        greedy: how actions were chosen.
    """
    right = suite.right[np.arange(len(place)), np.maximum(place, 0)] & (place >= 0) & success
    contested, controls = (rate_interval(right[suite.contested == side]) for side in (True, False))
    # Two independent samples: half the hypotenuse of their distances to the bounds (Newcombe's method with Wilson's).
    centre = (contested.estimate + controls.estimate) / 2
    below = np.hypot(contested.estimate - contested.low, controls.estimate - controls.low) / 2
    above = np.hypot(contested.high - contested.estimate, controls.high - controls.estimate) / 2
    return ChoiceResult(
        greedy=greedy,
        episodes=len(place),
        score=Interval(centre, float(centre - below), float(centre + above)),
        contested=contested,
        controls=controls,
        failures=float(1 - np.mean(success)),
    )


def _score(
    cases: Cases, episodes: Episodes, where: Int[np.ndarray, " _"], horizon: int, returns: tuple[float, float]
) -> Score:
    """Of the given cases, whose returns lie between the given bounds."""
    task = cases.task[where]
    over = _over(task)
    success, steps = np.asarray(episodes.success)[where], np.asarray(episodes.steps)[where]
    spl = optimal_steps = myopic_success = myopic_spl = None
    if cases.optimum is not None and cases.myopic is not None:
        optimum, myopic = cases.optimum[where], cases.myopic[where]
        arrives = myopic <= horizon
        spl = _mean(path_ratio(success, steps, optimum), task, over, (0, 1))
        optimal_steps = float(optimum[success].mean()) if success.any() else None
        myopic_success, myopic_spl = float(arrives.mean()), float(path_ratio(arrives, myopic, optimum).mean())
    return Score(
        episodes=len(where),
        intervals_over=over,
        success_rate=_rate(success, task, over),
        violation_rate=_rate(np.asarray(episodes.violated)[where], task, over),
        return_mean=_mean(np.asarray(episodes.returns)[where], task, over, returns),
        steps_mean=_mean(steps[success], task[success], over, (1, horizon)),
        spl=spl,
        optimal_steps_mean=optimal_steps,
        myopic_success_rate=myopic_success,
        myopic_spl=myopic_spl,
    )


def _over(task: Int[np.ndarray, " _"]) -> str:
    """What the intervals of episodes on these tasks are over."""
    return OVER_EPISODES if len(np.unique(task)) < FEW_TASKS else OVER_TASKS


def _rate(outcomes: Bool[np.ndarray, " _"], task: Int[np.ndarray, " _"], over: str) -> Interval:
    return rate_interval(outcomes, tasks=task if over == OVER_TASKS else None)


def _mean(
    values: Real[np.ndarray, " _"], task: Int[np.ndarray, " _"], over: str, bounds: tuple[float, float]
) -> Interval:
    """The mean of numbers between the given bounds; over tasks it has an interval only if enough of them have a number.

    Over episodes these count as independent. That is rather too wide: as many episodes of each of the given tasks vary
    less in their mean than episodes whose tasks are drawn at random.
    """
    if over == OVER_EPISODES:
        return bounded_interval(values, *bounds)
    mean, *ends = mean_interval(values, tasks=task)
    if len(np.unique(task)) < FEW_TASKS:
        return Interval(mean, np.nan, np.nan)
    low, high = np.clip(ends, *bounds)
    return Interval(mean, float(low), float(high))
