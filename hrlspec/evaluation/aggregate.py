"""Aggregates over several runs of one method.

Axes: **S** runs, **M** tasks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hrlspec.evaluation.results import ESTIMATES, Score, SuiteResult, interval_to_json
from hrlspec.evaluation.stats import Interval, mean_interval, stratified_bootstrap


@dataclasses.dataclass(frozen=True)
class Aggregate:
    """One figure over runs.

    Attributes:
        runs: S.
        mean: of the runs' totals, with Student's t interval over runs.
        iqm: interquartile mean over runs and tasks, with a bootstrap interval stratified by task; ``None`` where some
            run has no figure for some task.
    """

    runs: int
    mean: Interval
    iqm: Interval | None

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {"runs": self.runs, **interval_to_json("mean", self.mean), **interval_to_json("iqm", self.iqm)}


def aggregate(results: Sequence[SuiteResult], *, seed: int = 0) -> Mapping[str, Aggregate]:
    """Aggregates the results of several runs on one suite.

    Args:
        results: one for each run.
        seed: of the bootstrap.

    Returns:
        By name of the estimate (see :class:`Score`); those that no run could estimate are left out.

    Raises:
        ValueError: without results, or if the runs were not evaluated on the same tasks in the same way.
    """
    if not results:
        raise ValueError("found no result to aggregate")
    asked = {(r.suite, r.greedy, r.shield, tuple(each.task for each in r.per_task)) for r in results}
    if len(asked) > 1:
        raise ValueError("the runs were evaluated on different tasks or in different ways, expected the same for all")
    aggregates = {}
    for name in ESTIMATES:
        totals = np.array([_estimate(result.total, name) for result in results])
        totals = totals[np.isfinite(totals)]
        if totals.size:
            table = np.array([[_estimate(each.score, name) for each in result.per_task] for result in results])
            iqm = stratified_bootstrap(table, seed=seed) if np.isfinite(table).all() else None
            aggregates[name] = Aggregate(len(totals), mean_interval(totals), iqm)
    return aggregates


def _estimate(score: Score, name: str) -> float:
    """NaN where it is not known."""
    interval: Interval | None = getattr(score, name)
    return float("nan") if interval is None else interval.estimate
