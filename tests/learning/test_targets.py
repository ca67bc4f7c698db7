"""Targets of both levels against slow references and closed forms."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrlspec.learning.targets import high_level_targets, low_level_targets

T, E = 13, 7

low_targets = jax.jit(low_level_targets)
plan_targets = jax.jit(high_level_targets)


def draw(seed: int) -> dict[str, np.ndarray]:
    """Random experience; an episode's end makes a decision due, and a few others are due besides."""
    rng = np.random.default_rng(seed)
    terminated = rng.random((T, E)) < 0.15
    truncated = (rng.random((T, E)) < 0.15) & ~terminated
    decided = rng.random((T, E)) < 0.3
    decided[1:] |= (terminated | truncated)[:-1]
    floats = {
        name: rng.normal(size=(T, E)).astype(np.float32) for name in ("reward", "value", "bootstrap", "high_value")
    }
    return {"terminated": terminated, "truncated": truncated, "decided": decided, **floats}


def low_reference(x: dict[str, np.ndarray], gamma: float, lam: float, max_operator: bool) -> np.ndarray:
    """One number at a time, forwards: the return of step t looks up that of step t + 1."""
    steps = x["reward"]

    def from_here(t: int, e: int) -> float:
        if x["terminated"][t, e]:
            return float(x["reward"][t, e])
        if x["truncated"][t, e] or t == len(steps) - 1:
            return x["reward"][t, e] + gamma * x["bootstrap"][t, e]
        later = from_here(t + 1, e)
        if max_operator and x["decided"][t + 1, e]:
            later = max(later, x["high_value"][t + 1, e])
        return x["reward"][t, e] + gamma * ((1 - lam) * x["value"][t + 1, e] + lam * later)

    return np.array([[from_here(t, e) for e in range(steps.shape[1])] for t in range(len(steps))])


def plan_reference(x: dict[str, np.ndarray], gamma: float, lam: float) -> dict[tuple[int, int], float]:
    """Advantage of each decision from its own reward R, duration and successor."""
    advantages: dict[tuple[int, int], float] = {}
    last, num_envs = x["reward"].shape[0] - 1, x["reward"].shape[1]
    for e in range(num_envs):
        for t in reversed(np.flatnonzero(x["decided"][:, e]).tolist()):
            reward, tau = 0.0, t
            while True:
                reward += gamma ** (tau - t) * x["reward"][tau, e]
                ends = x["terminated"][tau, e] or x["truncated"][tau, e] or tau == last
                if ends or x["decided"][tau + 1, e]:
                    break
                tau += 1
            factor = gamma ** (tau + 1 - t)
            if x["terminated"][tau, e]:
                ahead = later = 0.0
            elif ends:
                ahead, later = x["bootstrap"][tau, e], 0.0
            else:
                ahead, later = x["high_value"][tau + 1, e], advantages[tau + 1, e]
            advantages[t, e] = reward + factor * ahead - x["high_value"][t, e] + factor * lam * later
    return advantages


def run_low(x: dict[str, Any], gamma: float, lam: float, max_operator: bool) -> np.ndarray:
    names = ("reward", "terminated", "truncated", "value", "bootstrap", "decided", "high_value")
    result = low_targets(*(x[n] for n in names), discount=gamma, gae_lambda=lam, max_operator=max_operator)
    return np.asarray(result)


def run_plan(x: dict[str, Any], gamma: float, lam: float) -> tuple[np.ndarray, np.ndarray]:
    names = ("reward", "terminated", "truncated", "decided", "high_value", "bootstrap")
    advantage, target = plan_targets(*(x[n] for n in names), discount=gamma, gae_lambda=lam)
    return np.asarray(advantage), np.asarray(target)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1), st.booleans())
def test_low_level_targets_equal_the_reference(seed: int, gamma: float, lam: float, max_operator: bool) -> None:
    x = draw(seed)
    np.testing.assert_allclose(
        run_low(x, gamma, lam, max_operator), low_reference(x, gamma, lam, max_operator), atol=1e-4
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0, 1))
def test_high_level_targets_equal_the_reference(seed: int, gamma: float, lam: float) -> None:
    x = draw(seed)
    advantage, target = run_plan(x, gamma, lam)
    for where, expected in plan_reference(x, gamma, lam).items():
        assert advantage[where] == pytest.approx(expected, abs=1e-4)
        assert target[where] == pytest.approx(expected + x["high_value"][where], abs=1e-4)


def quiet(**changes: Any) -> dict[str, Any]:
    """Nothing happens, all values are zero."""
    flags = {name: np.zeros((T, 1), bool) for name in ("terminated", "truncated", "decided")}
    floats = {name: np.zeros((T, 1), np.float32) for name in ("reward", "value", "bootstrap", "high_value")}
    x = {**flags, **floats}
    for name, entries in changes.items():
        for t, value in entries.items():
            x[name][t] = value
    return x


def test_lambda_one_is_the_discounted_return() -> None:
    x = quiet(reward={T - 1: 1.0}, terminated={T - 1: True}, value=dict.fromkeys(range(T), 5.0))
    np.testing.assert_allclose(run_low(x, 0.9, 1.0, False)[:, 0], 0.9 ** np.arange(T - 1, -1, -1), rtol=1e-5)


def test_lambda_zero_is_the_one_step_target() -> None:
    x = draw(3)
    going_on = ~(x["terminated"] | x["truncated"])[:-1]
    expected = x["reward"][:-1] + 0.9 * x["value"][1:]
    np.testing.assert_allclose(run_low(x, 0.9, 0.0, True)[:-1][going_on], expected[going_on], rtol=1e-5, atol=1e-5)


def test_truncation_bootstraps_and_termination_does_not() -> None:
    ends = {
        "bootstrap": {4: 2.0},
        "reward": {4: 1.0},
        "value": {5: 100.0},
        "high_value": {5: 100.0},
        "decided": {5: True},
    }
    truncated = run_low(quiet(truncated={4: True}, **ends), 0.5, 0.9, True)
    terminated = run_low(quiet(terminated={4: True}, **ends), 0.5, 0.9, True)
    assert truncated[4, 0] == pytest.approx(1 + 0.5 * 2)
    assert terminated[4, 0] == pytest.approx(1)


def test_both_at_once_is_termination() -> None:
    x = quiet(terminated={4: True}, truncated={4: True}, bootstrap={4: 2.0}, reward={4: 1.0}, decided={4: True})
    assert run_low(x, 0.5, 0.9, True)[4, 0] == pytest.approx(1)
    assert run_plan(x, 0.5, 0.9)[0][4, 0] == pytest.approx(1)


@pytest.mark.parametrize("where", ["value", "high_value", "reward", "bootstrap"])
@pytest.mark.parametrize("end", ["terminated", "truncated"])
def test_nothing_leaks_from_the_next_episode(where: str, end: str) -> None:
    before, after = draw(11), draw(11)
    for x in (before, after):
        x["terminated"][:], x["truncated"][:] = False, False
        x[end][6] = True
        x["decided"][7] = True
    after[where][7:] += 100.0
    np.testing.assert_array_equal(run_low(before, 0.9, 0.8, True)[:7], run_low(after, 0.9, 0.8, True)[:7])
    for old, new in zip(run_plan(before, 0.9, 0.8), run_plan(after, 0.9, 0.8), strict=True):
        np.testing.assert_array_equal(old[:7], new[:7])


def test_max_operator_passes_the_larger_value_to_the_sub_task_before() -> None:
    """`a; b` with the planner knowing better (0.8) or worse (0.2) than the return that followed (0.5)."""
    for known, on, off in ((0.8, 0.8, 0.5), (0.2, 0.5, 0.5)):
        x = quiet(decided={0: True, 3: True}, high_value={3: known}, reward={3: 0.5}, terminated={3: True})
        raised, plain = run_low(x, 0.9, 1.0, True)[:, 0], run_low(x, 0.9, 1.0, False)[:, 0]
        np.testing.assert_allclose(raised[:3], on * 0.9 ** np.array([3, 2, 1]), rtol=1e-5)
        np.testing.assert_allclose(plain[:3], off * 0.9 ** np.array([3, 2, 1]), rtol=1e-5)


def test_smdp_reward_and_bootstrap_are_discounted_per_step() -> None:
    """A decision at 2, rewards at 2, 4 and 5, the next decision at 6."""
    x = quiet(decided={2: True, 6: True}, reward={2: 1.0, 4: 2.0, 5: 4.0}, high_value={2: 0.3, 6: 7.0})
    advantage, target = run_plan(x, 0.5, 0.0)
    expected = 1 + 0.5**2 * 2 + 0.5**3 * 4 + 0.5**4 * 7
    assert target[2, 0] == pytest.approx(expected, rel=1e-5)
    assert advantage[2, 0] == pytest.approx(expected - 0.3, rel=1e-5)


def test_open_decision_is_bootstrapped_at_the_rollouts_end() -> None:
    x = quiet(decided={T - 2: True}, bootstrap={T - 1: 3.0}, high_value={T - 2: 1.0})
    assert run_plan(x, 0.5, 0.9)[0][T - 2, 0] == pytest.approx(0.25 * 3 - 1)
