"""Estimates with confidence intervals, for few seeds and many episodes.

Axes: **S** seeds (or runs), **M** tasks. Episodes of one task are correlated, so rates and means over episodes accept
``tasks`` and widen their intervals accordingly; `bounded_interval` is for episodes of a few given tasks. The aggregates
over seeds are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

Statistic = Callable[[Float[np.ndarray, "S M"]], float]


class Interval(NamedTuple):
    """An estimate and the bounds of its confidence interval; a bound that cannot be computed is NaN."""

    estimate: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.estimate:.3f} [{self.low:.3f}, {self.high:.3f}]"


def mean_interval(values: ArrayLike, *, tasks: ArrayLike | None = None, confidence: float = 0.95) -> Interval:
    """The mean with Student's t interval, whose coverage holds for three seeds, where a normal interval's does not.

    Args:
        values: numbers ``[n]``, such as returns; finite.
        tasks: ``[n]``, which task each value belongs to. The interval then rests on the variation between tasks
            (cluster-robust variance) with one degree of freedom less than there are tasks.
        confidence: coverage of the interval.

    Returns:
        All NaN without values; NaN bounds with a single value or task.
    """
    sample = _finite(values, 1)
    if not sample.size:
        return Interval(np.nan, np.nan, np.nan)
    groups = _groups(sample, tasks)
    mean, count = float(sample.mean()), int(groups.max()) + 1
    if count == 1:
        return Interval(mean, np.nan, np.nan)
    half = float(scipy.special.stdtrit(count - 1, (1 + _checked(confidence)) / 2)) * _standard_error(sample, groups)
    return Interval(mean, mean - half, mean + half)


def rate_interval(outcomes: ArrayLike, *, tasks: ArrayLike | None = None, confidence: float = 0.95) -> Interval:
    """A success rate with Wilson's interval, which stays inside [0, 1] and has a width at 0 and 1 too.

    Args:
        outcomes: bool ``[n]``, or zeros and ones.
        tasks: ``[n]``, which task each outcome belongs to. The number of episodes then counts only as many as would be
            as informative if they were independent. Where all outcomes agree nothing shows how alike they are, and
            each episode counts in full.
        confidence: coverage of the interval.

    Returns:
        Without outcomes ``(NaN, 0, 1)``.
    """
    sample = _finite(outcomes, 1)
    if not np.isin(sample, (0, 1)).all():
        raise ValueError("outcomes of a rate are 0 or 1")
    z = float(scipy.special.ndtri((1 + _checked(confidence)) / 2))
    if not sample.size:
        return Interval(np.nan, 0.0, 1.0)
    rate, trials = float(sample.mean()), float(sample.size)
    groups = _groups(sample, tasks)
    variance = rate * (1 - rate)
    if tasks is not None and variance > 0 and groups.max() > 0:
        trials = min(trials, variance / max(_standard_error(sample, groups) ** 2, 1e-12))
    return Interval(rate, *_wilson(rate, trials, z))


def bounded_interval(values: ArrayLike, low: float, high: float, *, confidence: float = 0.95) -> Interval:
    """The mean of independent numbers that lie between ``low`` and ``high``, with an interval that lies there too.

    Wilson's interval with Student's quantile. The numbers count as many as would be as informative if they were all
    at the ends, where their variance is largest: more than they are where they vary less. Their variance includes one
    more number, at ``low``, since a few episodes often show no failure although there are some.

    Of a few numbers Student's own interval passes the ends, and if they are all the same it has no width: for four
    episodes that succeed with probability 0.96 it covers this in 13 % of cases, the one here in 99 %.

    Args:
        values: numbers ``[n]``, finite.
        low: the least that is possible.
        high: the most.
        confidence: coverage of the interval.

    Returns:
        All NaN without values; NaN bounds with a single one.
    """
    sample = _finite(values, 1)
    size = sample.size
    mean = float(sample.mean()) if size else np.nan
    if size < 2:
        return Interval(mean, np.nan, np.nan)
    if not low < high:
        return Interval(mean, mean, mean)
    scaled = (sample - low) / (high - low)
    rate = float(np.clip(scaled.mean(), 0, 1))
    spread = (((scaled - rate) ** 2).sum() + rate**2) / (size - 1)
    trials = max(1.0, rate * (1 - rate) / spread) * size if spread else float(size)
    bounds = _wilson(rate, trials, float(scipy.special.stdtrit(size - 1, (1 + _checked(confidence)) / 2)))
    below, above = (low + (high - low) * bound for bound in bounds)
    return Interval(mean, min(below, mean), max(above, mean))


def interquartile_mean(scores: ArrayLike) -> float:
    """The mean of the middle half of all scores, of any shape: robust like the median, and more efficient."""
    ordered = np.sort(np.asarray(scores, float), axis=None)
    cut = ordered.size // 4
    return float(ordered[cut : ordered.size - cut].mean()) if ordered.size else float("nan")


def stratified_bootstrap(
    scores: ArrayLike,
    statistic: Statistic = interquartile_mean,
    *,
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Interval:
    """A statistic over seeds and tasks with its percentile bootstrap interval.

    Seeds are drawn with replacement within each task, so the tasks stay fixed: the interval covers the variation over
    seeds on the same tasks.

    Args:
        scores: ``[S, M]``, or ``[S]`` for one task.
        statistic: of an array ``[S, M]``.
        resamples: how many bootstrap samples.
        confidence: coverage of the interval.
        seed: of the resampling, so that the same scores give the same interval.
    """
    table = _table(scores)
    rng = np.random.default_rng(seed)
    draws = np.array([statistic(_resample(table, rng)) for _ in range(resamples)])
    return Interval(float(statistic(table)), *_percentiles(draws, confidence))


def probability_of_improvement(
    ours: ArrayLike, theirs: ArrayLike, *, resamples: int = 2000, confidence: float = 0.95, seed: int = 0
) -> Interval:
    """The probability that a run of one method beats a run of another on a task drawn at random; ties count half.

    Args:
        ours: ``[S, M]``, or ``[S]`` for one task.
        theirs: ``[S', M]``, on the same tasks in the same order.
        resamples: how many bootstrap samples, stratified by task.
        confidence: coverage of the interval.
        seed: of the resampling.
    """
    first, second = _table(ours), _table(theirs)
    if first.shape[1] != second.shape[1]:
        raise ValueError(f"both methods need the same tasks, found {first.shape[1]} and {second.shape[1]}")

    def improvement(x: Float[np.ndarray, "S M"], y: Float[np.ndarray, "S2 M"]) -> float:
        return float((np.sign(x[:, None] - y[None]) + 1).mean() / 2)

    rng = np.random.default_rng(seed)
    draws = np.array([improvement(_resample(first, rng), _resample(second, rng)) for _ in range(resamples)])
    return Interval(improvement(first, second), *_percentiles(draws, confidence))


def difference_interval(ours: ArrayLike, theirs: ArrayLike, *, confidence: float = 0.95) -> Interval:
    """The difference of two means with Welch's t interval.

    Args:
        ours: numbers ``[S]``, one for each seed.
        theirs: numbers ``[S']``, of other runs: not paired.
        confidence: coverage of the interval.

    Returns:
        NaN bounds where a side has a single value; no width where neither side varies.
    """
    first, second = _finite(ours, 1), _finite(theirs, 1)
    difference = float(first.mean() - second.mean())
    if min(first.size, second.size) < 2:
        return Interval(difference, np.nan, np.nan)
    if not first.var() + second.var():
        return Interval(difference, difference, difference)
    from scipy import stats  # takes most of a second to import

    found = stats.ttest_ind(first, second, equal_var=False).confidence_interval(_checked(confidence))
    return Interval(difference, float(found.low), float(found.high))


def permutation_test(ours: ArrayLike, theirs: ArrayLike) -> float:
    """The two-sided p-value of a difference of means, exact: over all ways to divide the runs into two such groups.

    It assumes nothing but that under the null hypothesis runs of the one are as good as runs of the other. With ten
    runs each there are 184,756 ways, and p is at least 1.1e-5; with five 252, and p is at least 0.008.

    Args:
        ours: numbers ``[S]``, one for each seed.
        theirs: numbers ``[S']``, of other runs: not paired.
    """

    def difference(x: Float[np.ndarray, "*lead S"], y: Float[np.ndarray, "*lead S2"], axis: int) -> ArrayLike:
        return np.mean(x, axis) - np.mean(y, axis)

    sides = (_finite(ours, 1), _finite(theirs, 1))
    from scipy import stats  # takes most of a second to import

    # In batches, or all ways would be held at a time.
    found = stats.permutation_test(sides, difference, n_resamples=np.inf, batch=10_000, vectorized=True)
    return float(found.pvalue)


def holm(p_values: Sequence[float], family: int | None = None) -> list[float]:
    """Holm's correction: of a family of true null hypotheses any is rejected at 0.05 in 5 % of cases, at most.

    Args:
        p_values: of the tests that were made.
        family: how many were to be made; those that are missing count as if they had shown nothing.

    Returns:
        The corrected p-values, in the same order.
    """
    size = len(p_values) if family is None else family
    corrected, largest = [0.0] * len(p_values), 0.0
    for rank, which in enumerate(np.argsort(p_values, kind="stable")):
        largest = max(largest, min(1.0, (size - rank) * p_values[which]))
        corrected[which] = largest
    return corrected


def _wilson(rate: float, trials: float, quantile: float) -> tuple[float, float]:
    """Bounds of Wilson's interval."""
    shrink = 1 + quantile**2 / trials
    centre = (rate + quantile**2 / (2 * trials)) / shrink
    half = quantile / shrink * float(np.sqrt(rate * (1 - rate) / trials + quantile**2 / (4 * trials**2)))
    # At 0 and 1 one bound is the rate itself, up to rounding.
    return min(max(centre - half, 0.0), rate), max(min(centre + half, 1.0), rate)


def _standard_error(sample: Float[np.ndarray, " n"], groups: Int[np.ndarray, " n"]) -> float:
    """Of the mean, from the groups' sums of deviations; with groups of one the usual standard error."""
    sums = np.bincount(groups, weights=sample - sample.mean())
    count = len(sums)
    return float(np.sqrt(count / (count - 1) * (sums**2).sum()) / sample.size)


def _groups(sample: Float[np.ndarray, " n"], tasks: ArrayLike | None) -> Int[np.ndarray, " n"]:
    """Consecutive numbers of the groups, int ``[n]``; every value is its own group without tasks."""
    if tasks is None:
        return np.arange(sample.size)
    names = np.asarray(tasks)
    if names.shape != sample.shape:
        raise ValueError(f"tasks has the shape {names.shape}, expected {sample.shape}")
    return np.unique(names, return_inverse=True)[1]


def _finite(values: ArrayLike, dimensions: int) -> Float[np.ndarray, "..."]:
    sample = np.asarray(values, float)
    if sample.ndim != dimensions:
        raise ValueError(f"expected {dimensions} axes, found the shape {sample.shape}")
    if not np.isfinite(sample).all():
        raise ValueError("found a value that is not finite")
    return sample


def _table(scores: ArrayLike) -> Float[np.ndarray, "S M"]:
    """Scores as ``[S, M]``."""
    table = np.asarray(scores, float)
    table = _finite(table[:, None] if table.ndim == 1 else table, 2)
    if not table.size:
        raise ValueError(f"expected scores of at least one seed and one task, found the shape {table.shape}")
    return table


def _resample(table: Float[np.ndarray, "S M"], rng: np.random.Generator) -> Float[np.ndarray, "S M"]:
    rows = rng.integers(table.shape[0], size=table.shape)
    return np.take_along_axis(table, rows, axis=0)


def _percentiles(draws: Float[np.ndarray, " _"], confidence: float) -> tuple[float, float]:
    tail = (1 - _checked(confidence)) / 2
    low, high = np.quantile(draws, [tail, 1 - tail])
    return float(low), float(high)


def _checked(confidence: float) -> float:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}, expected a number between 0 and 1")
    return confidence
