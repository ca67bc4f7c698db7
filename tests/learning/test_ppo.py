"""Losses and the guarded gradient step."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.config import OptimiserConfig, PPOConfig
from hrlspec.learning import ppo
from hrlspec.learning.optimiser import annealed, gradient_step, optimiser

SETTINGS = PPOConfig(clip=0.2)


def test_masked_mean_ignores_the_rest_and_survives_an_empty_mask() -> None:
    x = jnp.array([1.0, 2.0, 100.0])
    assert float(ppo.masked_mean(x, jnp.array([True, True, False]))) == 1.5
    assert float(ppo.masked_mean(x, jnp.zeros(3, bool))) == 0


def test_normalise_uses_the_masked_samples_alone() -> None:
    rng = np.random.default_rng(0)
    advantage, mask = rng.normal(3, 2, 64).astype(np.float32), rng.random(64) < 0.5
    other = np.where(mask, advantage, 1e6).astype(np.float32)
    result = np.asarray(ppo.normalise(other, mask))[mask]
    np.testing.assert_allclose(result, np.asarray(ppo.normalise(advantage, mask))[mask], atol=1e-5)
    assert result.mean() == pytest.approx(0, abs=1e-5)
    assert result.std() == pytest.approx(1, abs=1e-4)


def test_relative_advantages_count_per_unit_of_what_was_expected() -> None:
    advantage, value = jnp.array([1.0, -1.0, 10.0]), jnp.array([0.5, -1.5, 9.5])
    scaled = ppo.scaled(advantage, value, PPOConfig(advantage_scale=0.5))
    np.testing.assert_allclose(scaled, [1.0, -0.5, 1.0], rtol=1e-5)
    np.testing.assert_array_equal(ppo.scaled(advantage, value, PPOConfig()), advantage)


def test_policy_loss_equals_a_plain_reading() -> None:
    rng = np.random.default_rng(1)
    new, old, advantage = rng.normal(size=(3, 50)).astype(np.float32)
    mask = rng.random(50) < 0.6
    total = 0.0
    for i in np.flatnonzero(mask):
        ratio = np.exp(new[i] - old[i])
        total += min(ratio * advantage[i], min(max(ratio, 0.8), 1.2) * advantage[i])
    assert float(ppo.policy_loss(new, old, advantage, mask, SETTINGS)) == pytest.approx(-total / mask.sum(), abs=1e-5)


@pytest.mark.parametrize(("shift", "advantage", "moves"), [(0, 1, 1), (1, 1, 0), (-1, 1, 1), (1, -1, 1), (-1, -1, 0)])
def test_policy_gradient_stops_where_the_step_is_long_enough(shift: float, advantage: float, moves: int) -> None:
    """With the ratio at e^shift, beyond the clip on the side that the advantage favours, there is no gradient."""
    mask = jnp.array([True, False])

    def loss(x: jax.Array) -> jax.Array:
        return ppo.policy_loss(jnp.stack([x, x]), jnp.zeros(2), jnp.full(2, float(advantage)), mask, SETTINGS)

    gradient = float(jax.grad(loss)(jnp.float32(shift)))
    assert np.sign(gradient) == -np.sign(advantage) * moves


@pytest.mark.parametrize(("shift", "advantage", "moves"), [(2, -1, 0), (1, -1, 1), (-2, 1, 1), (2, 1, 0)])
def test_what_became_much_likelier_counts_no_more(shift: float, advantage: float, moves: int) -> None:
    """At most e^1.5 times as likely: beyond, a negative advantage has no gradient either."""
    settings = PPOConfig(dual_clip=float(np.exp(1.5)))

    def loss(x: jax.Array) -> jax.Array:
        return ppo.policy_loss(x[None], jnp.zeros(1), jnp.full(1, float(advantage)), jnp.ones(1, bool), settings)

    assert np.sign(float(jax.grad(loss)(jnp.float32(shift)))) == -np.sign(advantage) * moves


def test_masked_samples_with_senseless_log_probabilities_do_no_harm() -> None:
    def loss(x: jax.Array) -> jax.Array:
        return ppo.policy_loss(
            jnp.stack([x, x - 1e9]), jnp.array([0.0, 500.0]), jnp.ones(2), jnp.array([True, False]), SETTINGS
        )

    value, gradient = jax.value_and_grad(loss)(jnp.float32(0.0))
    assert (float(value), float(gradient)) == (-1, -1)


def test_annealing() -> None:
    for progress, value in ((0, 1.0), (0.5, 0.75), (1, 0.5), (3, 0.5)):
        assert float(annealed(1.0, 0.5, jnp.float32(progress))) == pytest.approx(value, rel=1e-5)


def test_entropy_weighs_more_the_more_of_it_is_missing() -> None:
    settings = PPOConfig(entropy=0.2, final_entropy=0.0, entropy_floor=0.5, final_entropy_floor=0.1)
    slope = jax.grad(ppo.entropy_loss)
    plain = PPOConfig(entropy=0.2, final_entropy=0.0)
    assert float(slope(jnp.float32(-3.0), plain, jnp.float32(0.5))) == pytest.approx(-0.1, rel=1e-5)
    for progress, entropy, weight in (
        (0, 0.7, 0.2),
        (0, 0.4, 0.2 + 0.2),
        (0.5, 0.2, 0.1 + 0.2),
        (1, 0.2, 0),
        (1, 0, 0.2),
    ):
        found = float(slope(jnp.float32(entropy), settings, jnp.float32(progress)))
        assert found == pytest.approx(-weight, abs=1e-5)


def step(loss: Any, params: Any, clip: float = 1.0) -> Any:
    transform = optimiser(OptimiserConfig(max_grad_norm=clip))
    return gradient_step(
        jax.value_and_grad(loss, has_aux=True), params, transform.init(params), transform, jnp.float32(0.1)
    )


def test_gradient_step_descends() -> None:
    params, state, metrics = step(lambda p: ((p["x"] ** 2).sum(), {"m": p["x"].sum()}), {"x": jnp.array([3.0, -4.0])})
    np.testing.assert_allclose(params["x"], [2.9, -3.9], atol=1e-4)  # Adam's first step has the learning rate's length
    assert float(metrics["grad_norm"]) == pytest.approx(10, rel=1e-5)
    assert (float(metrics["m"]), float(metrics["skipped"])) == (-1, 0)
    # What Adam remembers is the clipped gradient: (0.6, -0.8), times 1 - b1.
    moments = [x for x in jax.tree.leaves(state) if x.shape == (2,)]
    np.testing.assert_allclose(moments[0], [0.06, -0.08], rtol=1e-4)


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_a_step_that_is_not_finite_changes_nothing(bad: float, where: str) -> None:
    def loss(p: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        if where == "loss":
            return p.sum() + bad, {}
        return jnp.where(p > 0, p, 0.0).sum() + bad * (p - jax.lax.stop_gradient(p)).sum(), {}

    params = jnp.array([1.0, 2.0])
    transform = optimiser(OptimiserConfig(max_grad_norm=1.0))
    state = transform.init(params)
    new, new_state, metrics = gradient_step(
        jax.value_and_grad(loss, has_aux=True), params, state, transform, jnp.float32(0.1)
    )
    assert float(metrics["skipped"]) == 1
    for a, b in zip(jax.tree.leaves((params, state)), jax.tree.leaves((new, new_state)), strict=True):
        np.testing.assert_array_equal(a, b)
