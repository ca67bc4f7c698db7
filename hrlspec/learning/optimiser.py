"""Gradient descent: one guarded step, and epochs of minibatches.

Axes: **L** blocks of environments on one device (`hrlspec.learning.shards`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import optax
from jaxtyping import Float32, Int32, Key

from envs_jax.arrays import Array
from hrlspec.agent.groups import take
from hrlspec.config import OptimiserConfig

Metrics = dict[str, Float32[Array, "..."]]
"""Float32 ``[]`` by name, or with the leading axes of whatever they were computed for."""


def optimiser(config: OptimiserConfig) -> optax.GradientTransformation:
    """Adam behind a global-norm clip, without a learning rate: :func:`gradient_step` applies the annealed one.

    All parameters form one vector: a handful of operations to compile instead of as many for each layer.
    """
    return optax.flatten(optax.chain(optax.clip_by_global_norm(config.max_grad_norm), _adam(eps=1e-5)))


def _adam(eps: float, b1: float = 0.9, b2: float = 0.999) -> optax.GradientTransformation:
    """`optax.scale_by_adam` with its corrections of bias in the step's size: one division a parameter, not three."""

    def update(gradient: Any, state: optax.OptState, params: Any = None) -> tuple[Any, optax.OptState]:
        del params
        count = state.count + 1
        first, second = (1.0 - jnp.float32(decay) ** count.astype(jnp.float32) for decay in (b1, b2))
        second = jnp.sqrt(second)
        mu = jax.tree.map(lambda g, m: b1 * m + (1.0 - b1) * g, gradient, state.mu)
        nu = jax.tree.map(lambda g, v: b2 * v + (1.0 - b2) * g * g, gradient, state.nu)
        step = jax.tree.map(lambda m, v: second / first * m / (jnp.sqrt(v) + second * eps), mu, nu)
        return step, optax.ScaleByAdamState(count, mu, nu)

    return optax.GradientTransformation(optax.scale_by_adam().init, update)


def annealed(first: float, last: float, progress: Float32[Array, ""]) -> Float32[Array, ""]:
    """Linear from ``first`` to ``last`` as ``progress`` goes from 0 to 1."""
    return first + (last - first) * jnp.clip(progress, 0.0, 1.0)


def gradient_step(
    value_and_grad: Callable[[Any], tuple[tuple[Float32[Array, ""], Metrics], Any]],
    params: Any,
    state: optax.OptState,
    transform: optax.GradientTransformation,
    learning_rate: Float32[Array, ""],
) -> tuple[Any, optax.OptState, Metrics]:
    """One step; a non-finite loss or gradient leaves everything as it was and is counted in ``skipped``."""
    (value, metrics), gradient = value_and_grad(params)
    norm = optax.tree.norm(gradient)
    finite = jnp.isfinite(norm) & jnp.isfinite(value)

    def stepped(params: Any, state: optax.OptState) -> tuple[Any, optax.OptState]:
        updates, new_state = transform.update(gradient, state, params)
        return jax.tree.map(lambda p, u: p - learning_rate * u, params, updates), new_state

    params, state = jax.lax.cond(finite, stepped, lambda *as_it_was: as_it_was, params, state)
    return params, state, {**metrics, "grad_norm": norm, "skipped": (~finite).astype(jnp.float32)}


def fit(
    key: Key[Array, ""],
    loss: Callable[[Any, Any], tuple[Float32[Array, ""], Metrics]],
    params: Any,
    state: optax.OptState,
    batch: Any,
    config: OptimiserConfig,
    progress: Float32[Array, ""],
    mean_over_blocks: Callable[[Callable[[Any], Any], Any], Any],
) -> tuple[Any, optax.OptState, Metrics]:
    """Epochs of minibatch steps over the rows of ``batch``, shuffled anew for each, in all blocks alike.

    Args:
        key: consumed.
        loss: ``(params, minibatch of a block) -> (loss, metrics)``.
        params: what is trained.
        state: of the optimiser.
        batch: pytree, leading axes ``[L, rows]``.
        config: rate, epochs, minibatches.
        progress: float32 ``[]``, share of the training that is done.
        mean_over_blocks: of what a function makes of each; see `hrlspec.learning.shards.Shards.mean`.

    Returns:
        Parameters, the optimiser's state, and means of the metrics over the steps.

    Raises:
        ValueError: if the rows do not divide into the minibatches.
    """
    size = jax.tree.leaves(batch)[0].shape[1]
    if size % config.minibatches:
        raise ValueError(f"{size} rows do not divide into {config.minibatches} minibatches")
    transform = optimiser(config)
    rate = annealed(config.learning_rate, config.final_learning_rate, progress)
    shuffled = jnp.argsort(jax.random.bits(key, (config.epochs, size), jnp.uint32), axis=-1).astype(jnp.int32)

    # As one vector, the steps of the optimiser are a few operations on it instead of as many for each layer.
    flat, restore = jax.flatten_util.ravel_pytree(params)

    def step(carry: tuple[Any, Any], rows: Int32[Array, " rows"]) -> tuple[tuple[Any, Any], Metrics]:
        sample = take(batch, slice(None), rows)

        def value_and_grad(flat: Float32[Array, " _"]) -> Any:
            both = functools.partial(jax.value_and_grad(loss, has_aux=True), restore(flat))
            value, gradient = mean_over_blocks(both, sample)
            return value, jax.flatten_util.ravel_pytree(gradient)[0]

        flat, state, metrics = gradient_step(value_and_grad, *carry, transform, rate)
        return (flat, state), metrics

    rows = shuffled.reshape(config.epochs * config.minibatches, -1)
    (flat, state), metrics = jax.lax.scan(step, (flat, state), rows)
    return restore(flat), state, jax.tree.map(jnp.mean, metrics)
