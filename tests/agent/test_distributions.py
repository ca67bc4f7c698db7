"""Distributions over actions, against closed forms and counts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from envs_jax import Box, Discrete
from hrlspec.agent.distributions import Categorical, DiagonalGaussian, Distribution, distribution_over
from hrlspec.agent.networks.planner import MASKED

SPACES = [Discrete(3), Box(low=-1.0, high=1.0, shape=(2,)), Box(low=0.0, high=4.0, shape=(1,))]


@pytest.mark.parametrize("space", SPACES)
def test_noise_draws_from_the_distribution_and_zero_noise_is_the_mode(space: Discrete | Box) -> None:
    actions = distribution_over(space)
    outputs = jax.random.normal(jax.random.key(0), (actions.num_outputs,))
    noise = actions.noise(jax.random.key(1), (20_000,))
    drawn, log_prob = jax.vmap(actions.sample, (None, 0))(outputs, noise)
    np.testing.assert_allclose(log_prob, jax.vmap(actions.log_prob, (None, 0))(outputs, drawn), rtol=1e-5, atol=1e-5)
    # What is drawn has, in the mean, the surprise that the entropy promises.
    assert float(-log_prob.mean()) == pytest.approx(float(actions.entropy(outputs)), abs=0.03)
    mode, highest = actions.sample(outputs, jnp.zeros(actions.noise_shape))
    assert mode.dtype == space.dtype
    assert mode.shape == space.shape
    assert float(highest) >= float(log_prob.max()) - 1e-5


def test_categorical_shares_and_masks() -> None:
    logits = jnp.array([0.0, 1.0, MASKED])
    actions = Categorical(3)
    drawn, _ = jax.vmap(actions.sample, (None, 0))(logits, actions.noise(jax.random.key(0), (20_000,)))
    np.testing.assert_allclose(np.bincount(drawn, minlength=3) / 20_000, jax.nn.softmax(logits), atol=0.015)
    masked = jnp.array([[0.3, MASKED, 0.3], [0.0, MASKED, MASKED]])
    np.testing.assert_allclose(jax.vmap(actions.entropy)(masked), [np.log(2), 0], atol=1e-5)
    assert np.isfinite(jax.grad(lambda x: jax.vmap(actions.entropy)(x).sum())(masked)).all()


def test_gaussian_density_is_scipys() -> None:
    actions = DiagonalGaussian(size=2, low=-3.0, high=1.0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        outputs, action = rng.uniform(-1, 1, size=4), rng.normal(size=2)
        mean, std = -1 + 2 * 1.5 * np.tanh(outputs[:2] / 1.5), 2 * np.exp(outputs[2:])
        expected = stats.norm.logpdf(action, mean, std).sum()
        assert float(actions.log_prob(jnp.asarray(outputs), jnp.asarray(action))) == pytest.approx(expected, rel=1e-4)
        entropy = stats.norm.entropy(mean, std).sum()
        assert float(actions.entropy(jnp.asarray(outputs))) == pytest.approx(entropy, rel=1e-4)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_coloured_noise_is_standard_normal_at_every_step_and_correlated_in_time(correlation: float) -> None:
    actions = DiagonalGaussian(size=2, low=-1.0, high=1.0)
    keys = jax.random.split(jax.random.key(0), 4000)
    noise = np.asarray(jax.vmap(lambda key: actions.noise_sequence(key, 20, correlation))(keys))
    assert noise.shape == (4000, 20, 2)
    np.testing.assert_allclose(noise.mean(0), 0, atol=0.08)
    np.testing.assert_allclose(noise.std(0), 1, atol=0.06)
    for lag in (1, 5):
        found = (noise[:, lag:] * noise[:, :-lag]).mean((0, 1))
        np.testing.assert_allclose(found, correlation**lag, atol=0.03)
    assert abs((noise[..., 0] * noise[..., 1]).mean()) < 0.03


def test_discrete_noise_is_never_correlated() -> None:
    actions, key = Categorical(3), jax.random.key(0)
    np.testing.assert_allclose(actions.noise_sequence(key, 5, 0.9), actions.noise(key, (5,)), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("space", SPACES)
def test_candidates_lie_in_the_space_and_reach_its_corners(space: Discrete | Box) -> None:
    actions: Distribution = distribution_over(space)
    candidates = np.asarray(actions.candidates())
    assert all(space.contains(action) for action in candidates)
    assert len({tuple(np.ravel(action)) for action in candidates}) == len(candidates)
    ends = (0, space.n - 1) if isinstance(space, Discrete) else (space.low, space.high)
    assert (candidates.min(), candidates.max()) == ends


def test_actions_of_two_axes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
        distribution_over(Box(low=0.0, high=1.0, shape=(2, 2)))
