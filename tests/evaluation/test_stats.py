"""Estimates and intervals against closed forms, scipy and simulation."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.stats

from hrlspec.evaluation.stats import (
    Interval,
    bounded_interval,
    difference_interval,
    holm,
    interquartile_mean,
    mean_interval,
    permutation_test,
    probability_of_improvement,
    rate_interval,
    stratified_bootstrap,
)

Z = scipy.stats.norm.ppf(0.975)


def outcomes(successes: int, trials: int) -> np.ndarray:
    return np.arange(trials) < successes


def test_the_mean_has_students_interval() -> None:
    found = mean_interval([1, 2, 3, 4, 5])
    # s = sqrt(2.5), t(4, 0.975) = 2.776445
    np.testing.assert_allclose(found, (3, 3 - 2.776445 * np.sqrt(0.5), 3 + 2.776445 * np.sqrt(0.5)), rtol=1e-6)
    wide = mean_interval([1, 2, 3, 4, 5], confidence=0.99)
    assert wide.low < found.low < found.high < wide.high
    assert mean_interval([2.0, 2.0]) == (2, 2, 2)


def test_too_few_values_have_no_bounds() -> None:
    np.testing.assert_equal(tuple(mean_interval([])), (np.nan,) * 3)
    np.testing.assert_equal(tuple(mean_interval([4.0])), (4.0, np.nan, np.nan))
    np.testing.assert_equal(tuple(mean_interval([3.0, 5.0], tasks=[7, 7])), (4.0, np.nan, np.nan))
    np.testing.assert_equal(tuple(rate_interval([])), (np.nan, 0.0, 1.0))
    assert np.isnan(interquartile_mean([]))


def test_equal_groups_give_the_interval_of_their_means() -> None:
    values = np.random.default_rng(0).normal(size=(6, 10)) + np.arange(6)[:, None]
    tasks = np.repeat(list("abcdef"), 10)
    np.testing.assert_allclose(mean_interval(values.ravel(), tasks=tasks), mean_interval(values.mean(1)))
    np.testing.assert_allclose(mean_interval(values[:, 0], tasks=np.arange(6)), mean_interval(values[:, 0]))


def test_the_interval_of_a_mean_covers_what_it_says() -> None:
    rng = np.random.default_rng(1)
    found = [mean_interval(rng.normal(size=3)) for _ in range(2000)]
    coverage = np.mean([interval.low <= 0 <= interval.high for interval in found])
    assert abs(coverage - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 2000)


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (1, 1), (0, 10), (10, 10), (3, 10), (197, 200)])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_a_rate_has_wilsons_interval(successes: int, trials: int, confidence: float) -> None:
    expected = scipy.stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    found = rate_interval(outcomes(successes, trials), confidence=confidence)
    np.testing.assert_allclose(found, (successes / trials, expected.low, expected.high), atol=1e-12)
    assert 0 <= found.low <= found.estimate <= found.high <= 1


def test_a_bounded_mean_of_zeros_and_ones_has_nearly_wilsons_interval() -> None:
    values = outcomes(190, 200)
    np.testing.assert_allclose(bounded_interval(values, 0, 1), rate_interval(values), atol=2e-3)
    stretched = np.array(bounded_interval(3 + 2 * values, 3, 5))
    np.testing.assert_allclose(stretched, 3 + 2 * np.array(bounded_interval(values, 0, 1)))


def test_a_bounded_mean_stays_within_its_bounds() -> None:
    for values in ([0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [1.0] * 50, [0.97, 0.98, 0.99], [0.999] * 3):
        found = bounded_interval(values, 0, 1)
        assert 0 <= found.low <= found.estimate <= found.high <= 1
        assert found.low < found.high
    assert bounded_interval([2.0, 2.0], 2, 2) == (2, 2, 2)
    np.testing.assert_equal(tuple(bounded_interval([], 0, 1)), (np.nan,) * 3)
    np.testing.assert_equal(tuple(bounded_interval([0.4], 0, 1)), (0.4, np.nan, np.nan))


@pytest.mark.parametrize("size", [2, 4, 10, 40])
@pytest.mark.parametrize("failures", [0.0, 0.04, 0.3])
def test_a_bounded_mean_is_covered_by_few_values(size: int, failures: float) -> None:
    """Values of SPL: 0 for a failure, else somewhat below 1. Student's interval covers as little as 70 % of cases."""
    rng = np.random.default_rng(6)
    draws = (rng.random((1000, size)) >= failures) * rng.beta(20, 2, (1000, size))
    mean = (1 - failures) * 20 / 22
    found = [bounded_interval(values, 0, 1) for values in draws]
    coverage = np.mean([interval.low <= mean <= interval.high for interval in found])
    assert coverage > 0.95 - 4 * np.sqrt(0.95 * 0.05 / 1000)


def test_wilsons_interval_in_closed_form() -> None:
    assert rate_interval(outcomes(10, 10)).low == pytest.approx(10 / (10 + Z**2))
    assert rate_interval(outcomes(0, 10)).high == pytest.approx(Z**2 / (10 + Z**2))


def test_episodes_that_repeat_their_task_count_once() -> None:
    tasks = np.repeat(np.arange(40), 25)
    by_task = outcomes(30, 40)
    repeated = rate_interval(by_task[tasks], tasks=tasks)
    # Variance between G tasks is estimated with G - 1: the 1,000 episodes count as 39.
    rate, trials = 0.75, 39
    half = Z / (1 + Z**2 / trials) * np.sqrt(rate * (1 - rate) / trials + Z**2 / (4 * trials**2))
    assert repeated.high - repeated.low == pytest.approx(2 * half)
    alone = rate_interval(by_task[tasks])
    assert repeated.high - repeated.low > 4 * (alone.high - alone.low)
    # Independent episodes count in full, and never for more than they are.
    mixed = np.tile(outcomes(15, 20), 50)
    assert rate_interval(mixed, tasks=np.repeat(np.arange(50), 20)) == rate_interval(mixed)
    assert rate_interval(np.ones(50), tasks=tasks[:50]) == rate_interval(np.ones(50))


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    assert interquartile_mean(np.arange(1, 9)) == 4.5
    assert interquartile_mean([-1e9, -1e9, 3, 4, 5, 6, 1e9, 1e9]) == 4.5
    assert interquartile_mean([[1, 2], [3, 100]]) == 2.5
    assert interquartile_mean([7.0]) == 7.0
    for size in range(1, 12):
        scores = np.random.default_rng(size).normal(size=size)
        assert interquartile_mean(scores) == pytest.approx(scipy.stats.trim_mean(scores, 0.25))


def test_the_bootstrap_has_the_standard_error_of_a_mean() -> None:
    values = np.random.default_rng(2).normal(size=400)
    found = stratified_bootstrap(values, np.mean, resamples=4000)
    half = Z * values.std() / np.sqrt(400)
    assert found.estimate == values.mean()
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.05)
    assert (found.high + found.low) / 2 == pytest.approx(values.mean(), abs=0.1 * half)


def test_differences_between_tasks_do_not_widen_the_bootstrap() -> None:
    scores = np.broadcast_to(np.array([0.0, 0.5, 1.0, 9.0]), (5, 4))
    assert stratified_bootstrap(scores) == (0.75, 0.75, 0.75)
    # With M tasks of equal spread the mean over tasks is sqrt(M) times as sure.
    noise = np.random.default_rng(3).normal(size=(200, 1))
    one = stratified_bootstrap(noise, np.mean)
    many = stratified_bootstrap(noise + np.arange(16), np.mean)
    assert (one.high - one.low) / (many.high - many.low) == pytest.approx(4, rel=0.1)


def test_the_bootstrap_is_reproducible() -> None:
    scores = np.random.default_rng(4).normal(size=(5, 3))
    assert stratified_bootstrap(scores) == stratified_bootstrap(scores)
    assert stratified_bootstrap(scores) != stratified_bootstrap(scores, seed=1)


def test_the_probability_of_improvement() -> None:
    low, high = np.zeros((3, 2)), np.ones((4, 2))
    assert probability_of_improvement(high, low) == (1, 1, 1)
    assert probability_of_improvement(low, high) == (0, 0, 0)
    assert probability_of_improvement(low, low) == (0.5, 0.5, 0.5)
    assert probability_of_improvement([[0.0, 0.0], [2.0, 2.0]], [[1.0, 2.0]]).estimate == (1 / 2 + 1 / 4) / 2
    rng = np.random.default_rng(5)
    found = probability_of_improvement(rng.normal(1, 1, 400), rng.normal(0, 1, 400), resamples=500)
    expected = scipy.stats.norm.cdf(1 / np.sqrt(2))
    assert found.low < expected < found.high
    assert found.high - found.low < 0.1


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="not finite"):
        mean_interval([1.0, np.nan])
    with pytest.raises(ValueError, match="expected 1 axes"):
        mean_interval([[1.0]])
    with pytest.raises(ValueError, match="0 or 1"):
        rate_interval([0.5])
    with pytest.raises(ValueError, match="tasks has the shape"):
        rate_interval([1, 0], tasks=[1])
    with pytest.raises(ValueError, match="confidence is 95"):
        mean_interval([1, 2], confidence=95)
    with pytest.raises(ValueError, match="at least one seed"):
        stratified_bootstrap(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="same tasks, found 2 and 3"):
        probability_of_improvement(np.zeros((1, 2)), np.zeros((1, 3)))


def test_how_an_interval_reads() -> None:
    assert str(Interval(0.95, 0.9, 0.98)) == "0.950 [0.900, 0.980]"


def test_a_difference_has_welchs_interval() -> None:
    rng = np.random.default_rng(3)
    ours, theirs = rng.normal(1.0, 2.0, 10), rng.normal(size=7)
    variances = np.array([ours.var(ddof=1) / 10, theirs.var(ddof=1) / 7])
    freedom = variances.sum() ** 2 / (variances**2 / [9, 6]).sum()  # Welch and Satterthwaite
    half = scipy.stats.t.ppf(0.975, freedom) * np.sqrt(variances.sum())
    mean = ours.mean() - theirs.mean()
    np.testing.assert_allclose(difference_interval(ours, theirs), (mean, mean - half, mean + half))
    np.testing.assert_equal(tuple(difference_interval([3.0], [1.0, 2.0])), (1.5, np.nan, np.nan))
    assert difference_interval([3.0, 3.0], [1.0, 1.0]) == (2, 2, 2)


def test_the_permutation_test_counts_all_divisions() -> None:
    rng = np.random.default_rng(0)
    for sizes in ((4, 3), (5, 5)):
        ours, theirs = (
            rng.integers(0, 6, size).astype(float) + shift for size, shift in zip(sizes, (1, 0), strict=True)
        )
        together, size = np.concatenate([ours, theirs]), sum(sizes)
        first = np.array(list(itertools.combinations(range(size), sizes[0])))
        sums = together[first].sum(1)
        differences = sums / sizes[0] - (together.sum() - sums) / sizes[1]
        observed = ours.mean() - theirs.mean()
        ends = [np.mean(differences >= observed - 1e-9), np.mean(differences <= observed + 1e-9)]
        assert permutation_test(ours, theirs) == pytest.approx(min(1.0, 2 * min(ends)))
    assert permutation_test(range(10), range(10, 20)) == pytest.approx(2 / math.comb(20, 10))
    assert permutation_test([1.0] * 5, [1.0] * 5) == 1


def test_the_permutation_test_is_wrong_no_more_often_than_it_says() -> None:
    rng = np.random.default_rng(1)
    trials = 400
    false = np.mean([permutation_test(rng.exponential(size=5), rng.exponential(size=5)) <= 0.1 for _ in range(trials)])
    assert false < 0.1 + 4 * np.sqrt(0.1 * 0.9 / trials)


def test_holms_correction() -> None:
    """Holm (1979): the least of m is multiplied by m, the next by m - 1, and none becomes less than one before."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.01, 0.04], family=5) == pytest.approx([0.05, 0.16])
    assert holm([0.9, 0.8]) == [1, 1]
    assert holm([]) == []
