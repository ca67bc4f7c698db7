"""Proximal policy optimisation: losses and one guarded gradient step (Schulman et al., 2017)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from hrlspec.config import PPOConfig


def masked_mean(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of ``x`` where ``mask``; 0 when nothing is."""
    mask = mask.astype(x.dtype)
    return (x * mask).sum() / jnp.maximum(mask.sum(), 1.0)


def normalise(advantage: jax.Array, mask: jax.Array) -> jax.Array:
    """Advantages with mean 0 and standard deviation 1 over the masked samples."""
    mean = masked_mean(advantage, mask)
    variance = masked_mean((advantage - mean) ** 2, mask)
    return (advantage - mean) / jnp.sqrt(variance + 1e-8)


def relative(advantage: jax.Array, value: jax.Array, settings: PPOConfig) -> jax.Array:
    """Advantages per unit of what was expected: a scale that depends on the state alone, so what is best stays so."""
    return advantage / (settings.relative + jnp.abs(value)) if settings.relative else advantage


def policy_loss(
    log_prob: jax.Array, old: jax.Array, advantage: jax.Array, mask: jax.Array, settings: PPOConfig
) -> jax.Array:
    """Clipped surrogate; ``old`` is what the ratio is taken to.

    That is the log-probability with which a sample was drawn; for relabelled ones see `RelabelConfig.corrected`.

    Where the advantage is negative the plain surrogate has no bound. With ``most_ratio`` it has (Ye et al., 2020, "dual
    clip"): what has become so much likelier during the update counts no more.
    """
    # Far outside the clip range only the sign matters; the bounds keep exp from overflowing.
    ratio = jnp.exp(jnp.clip(jnp.where(mask, log_prob - old, 0.0), -10.0, math.log(settings.most_ratio)))
    surrogate = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip) * advantage)
    return -masked_mean(surrogate, mask)


def value_loss(value: jax.Array, target: jax.Array, mask: jax.Array, expectile: float) -> jax.Array:
    """Squared error, errors below the target weighted by 2τ and those above by 2(1 − τ); τ = 0.5 is the plain one."""
    error = target - value
    weight = 2.0 * jnp.where(error > 0, expectile, 1.0 - expectile)
    return masked_mean(weight * error**2, mask)


def optimiser(max_grad_norm: float) -> optax.GradientTransformation:
    """Adam behind a global-norm clip, without a learning rate: :func:`gradient_step` applies the annealed one.

    All parameters form one vector: a handful of operations to compile instead of as many for each layer.
    """
    return optax.flatten(optax.chain(optax.clip_by_global_norm(max_grad_norm), optax.scale_by_adam(eps=1e-5)))


def annealed(first: float, last: float, progress: jax.Array) -> jax.Array:
    """Linear from ``first`` to ``last`` as ``progress`` goes from 0 to 1."""
    return first + (last - first) * jnp.clip(progress, 0.0, 1.0)


def gradient_step(
    loss: Callable[[Any], tuple[jax.Array, dict[str, jax.Array]]],
    params: Any,
    optimiser_state: optax.OptState,
    transform: optax.GradientTransformation,
    learning_rate: jax.Array,
) -> tuple[Any, optax.OptState, dict[str, jax.Array]]:
    """One step; a non-finite loss or gradient leaves everything as it was and is counted in ``skipped``."""
    (value, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(params)
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(norm) & jnp.isfinite(value)
    updates, new_state = transform.update(gradient, optimiser_state, params)
    stepped = jax.tree.map(lambda p, u: p - learning_rate * u, params, updates)
    params, optimiser_state = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old), (stepped, new_state), (params, optimiser_state)
    )
    return params, optimiser_state, {**metrics, "grad_norm": norm, "skipped": 1.0 - finite}


def entropy_loss(randomness: jax.Array, settings: PPOConfig, progress: jax.Array) -> jax.Array:
    """Minus the weighted mean entropy ``randomness``, and the square of what it lacks of the floor.

    Near the optimum normalised advantages are mostly noise, which drives a policy to certainty; what keeps it from
    there must grow as it gets near.
    """
    weight = annealed(settings.entropy, settings.final_entropy, progress)
    if not settings.entropy_floor:
        return -weight * randomness
    floor = annealed(settings.entropy_floor, settings.final_entropy_floor, progress)
    return jnp.maximum(floor - randomness, 0.0) ** 2 - weight * randomness
