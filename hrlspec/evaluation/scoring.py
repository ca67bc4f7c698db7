"""From episodes to scores: statistics on the host.

Axes: **B** episodes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Real

from hrlspec.evaluation.cases import BranchCases, Cases
from hrlspec.evaluation.episodes import Episodes
from hrlspec.evaluation.results import ChoiceResult, ReturnResult, Score, SuiteResult, TaskScore
from hrlspec.evaluation.stats import Interval, mean_interval, rate_interval
from hrlspec.exact.contested import ContestedSuite


def path_ratio(
    success: Bool[np.ndarray, " B"], taken: Real[np.ndarray, " B"], optimum: Float[np.ndarray, " B"]
) -> Float32[np.ndarray, " B"]:
    """Success × L*/max(taken, L*) of each episode, float32 ``[B]``."""
    return np.where(success, optimum / np.maximum(taken, optimum), 0).astype(np.float32)


def score_suite(cases: Cases, episodes: Episodes, *, horizon: int, greedy: bool, shield: bool) -> SuiteResult:
    """Scores of one episode per case: over all, per depth and per task.

    Args:
        cases: B cases.
        episodes: their outcomes, leading axis B.
        horizon: of the environment, for the myopic agent too.
        greedy: how actions were chosen.
        shield: whether the shield was on.
    """
    depth = cases.suite.depths[cases.task]

    def score(where: Int[np.ndarray, " _"]) -> Score:
        return _score(cases, episodes, where, horizon)

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


def score_returns(cases: BranchCases, episodes: Episodes, *, greedy: bool) -> ReturnResult:
    """Return over optimum of one episode per case, and that of the reference agents on the same cases."""
    ratio = np.asarray(episodes.returns) / cases.optimum
    depth = cases.suite.depths[cases.task]
    return ReturnResult(
        suite=cases.suite.name,
        greedy=greedy,
        episodes=len(cases),
        excluded=cases.excluded,
        ratio=_mean(ratio, cases.task),
        success_rate=rate_interval(episodes.success, tasks=cases.task),
        random_branch=float((cases.random / cases.optimum).mean()),
        longest_branch=float((cases.longest / cases.optimum).mean()),
        per_depth={int(d): _mean(ratio[depth == d], cases.task[depth == d]) for d in np.unique(depth)},
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


def _score(cases: Cases, episodes: Episodes, where: Int[np.ndarray, " _"], horizon: int) -> Score:
    """Of the given cases."""
    task = cases.task[where]
    success, steps = np.asarray(episodes.success)[where], np.asarray(episodes.steps)[where]
    spl = optimal_steps = myopic_success = myopic_spl = None
    if cases.optimum is not None and cases.myopic is not None:
        optimum, myopic = cases.optimum[where], cases.myopic[where]
        arrives = myopic <= horizon
        spl = _clip(_mean(path_ratio(success, steps, optimum), task))
        optimal_steps = float(optimum[success].mean()) if success.any() else None
        myopic_success, myopic_spl = float(arrives.mean()), float(path_ratio(arrives, myopic, optimum).mean())
    return Score(
        episodes=len(where),
        success_rate=rate_interval(success, tasks=task),
        violation_rate=rate_interval(np.asarray(episodes.violated)[where], tasks=task),
        return_mean=_mean(np.asarray(episodes.returns)[where], task),
        steps_mean=_mean(steps[success], task[success]),
        spl=spl,
        optimal_steps_mean=optimal_steps,
        myopic_success_rate=myopic_success,
        myopic_spl=myopic_spl,
    )


def _mean(values: Real[np.ndarray, " _"], task: Int[np.ndarray, " _"]) -> Interval:
    """The mean with episodes grouped by task; those of a single task are independent given the task."""
    return mean_interval(values, tasks=task if len(np.unique(task)) > 1 else None)


def _clip(interval: Interval) -> Interval:
    """Bounds kept within [0, 1], where the quantity lies."""
    return Interval(interval.estimate, max(0.0, interval.low), min(1.0, interval.high))
