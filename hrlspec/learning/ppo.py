"""Proximal policy optimisation: its loss for both levels (Schulman et al., 2017).

Axes: **B** samples.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32

from envs_jax.arrays import Array
from hrlspec.agent.experience import Credit, LowBatch, flat
from hrlspec.agent.low_level import LowLevel
from hrlspec.config import PPOConfig
from hrlspec.learning.optimiser import Metrics, annealed


def masked_mean(x: Float32[Array, "*B"], mask: Bool[Array, "*B"]) -> Float32[Array, ""]:
    """Mean of ``x`` where ``mask``; 0 when nothing is."""
    mask = mask.astype(x.dtype)
    return (x * mask).sum() / jnp.maximum(mask.sum(), 1.0)


def normalise(advantage: Float32[Array, " B"], mask: Bool[Array, " B"]) -> Float32[Array, " B"]:
    """Advantages with mean 0 and standard deviation 1 over the masked samples."""
    mean = masked_mean(advantage, mask)
    variance = masked_mean((advantage - mean) ** 2, mask)
    return (advantage - mean) / jnp.sqrt(variance + 1e-8)


def scaled(advantage: Float32[Array, "*B"], value: Float32[Array, "*B"], settings: PPOConfig) -> Float32[Array, "*B"]:
    """Advantages per unit of what was expected: a scale that depends on the state alone, so what is best stays so."""
    scale = settings.advantage_scale
    return advantage / (scale + jnp.abs(value)) if scale else advantage


def policy_loss(
    log_prob: Float32[Array, " B"],
    old: Float32[Array, " B"],
    advantage: Float32[Array, " B"],
    mask: Bool[Array, " B"],
    settings: PPOConfig,
) -> Float32[Array, ""]:
    """Clipped surrogate; ``old`` is what the ratio is taken to.

    That is the log-probability with which a sample was drawn: of a relabelled action, under the task of then.

    Where the advantage is negative the plain surrogate has no bound. With ``dual_clip`` it has (Ye et al., 2020): what
    has become so much likelier during the update counts no more.
    """
    # Far outside the clip range only the sign matters; the bounds keep exp from overflowing.
    ratio = jnp.exp(jnp.clip(jnp.where(mask, log_prob - old, 0.0), -10.0, math.log(settings.dual_clip)))
    surrogate = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - settings.clip, 1 + settings.clip) * advantage)
    return -masked_mean(surrogate, mask)


def value_loss(
    value: Float32[Array, " B"], target: Float32[Array, " B"], mask: Bool[Array, " B"]
) -> Float32[Array, ""]:
    """Mean squared error."""
    return masked_mean((target - value) ** 2, mask)


def entropy_loss(entropy: Float32[Array, ""], settings: PPOConfig, progress: Float32[Array, ""]) -> Float32[Array, ""]:
    """Minus the weighted mean entropy, and the square of what it lacks of the floor.

    Near the optimum normalised advantages are mostly noise, which drives the policy to determinism; the weight of the
    entropy must grow as the entropy falls.
    """
    weight = annealed(settings.entropy, settings.final_entropy, progress)
    if not settings.entropy_floor:
        return -weight * entropy
    floor = annealed(settings.entropy_floor, settings.final_entropy_floor, progress)
    return jnp.maximum(floor - entropy, 0.0) ** 2 - weight * entropy


def loss(
    log_prob: Float32[Array, " B"],
    old: Float32[Array, " B"],
    value: Float32[Array, " B"],
    entropy: Float32[Array, " B"],
    credit: Credit,
    settings: PPOConfig,
    progress: Float32[Array, ""],
) -> tuple[Float32[Array, ""], Metrics]:
    """The loss of an actor and its critic.

    Args:
        log_prob: float32 ``[B]``, of the samples under the policy as it is.
        old: float32 ``[B]``, what the ratio is taken to.
        value: float32 ``[B]``, of the critic.
        entropy: float32 ``[B]``, of the policy.
        credit: leading axis B; advantages are normalised over the samples that the policy learns from.
        settings: weights and clips.
        progress: float32 ``[]``, share of the training that is done.

    Returns:
        The loss ``[]`` and its parts.
    """
    advantage = normalise(credit.advantage, credit.learns)
    policy = policy_loss(log_prob, old, advantage, credit.learns, settings)
    critic = value_loss(value, credit.target, credit.valid)
    randomness = masked_mean(entropy, credit.learns)
    total = policy + settings.value_coefficient * critic + entropy_loss(randomness, settings, progress)
    return total, {"policy_loss": policy, "value_loss": critic, "entropy": randomness}


def low_level_loss(
    low: LowLevel, params: Any, batch: LowBatch, settings: PPOConfig, progress: Float32[Array, ""]
) -> tuple[Float32[Array, ""], Metrics]:
    """Loss of the low level on a minibatch ``[V, T]``; steps the shield replaced count for the value alone.

    Args:
        low: the networks.
        params: their parameters, ``params["low"]``.
        batch: samples.
        settings: weights and clips.
        progress: float32 ``[]``, share of the training that is done.
    """
    own = {"low": params}
    now = low.instructions_of(own, batch.trees, batch.slot, batch.edge, batch.feasible, batch.ahead)
    sight, instructions, decision, credit = jax.tree.map(flat, (batch.sight, now, batch.decision, batch.credit))
    outputs, value = jax.vmap(low.respond, in_axes=(None, 0, 0))(own, sight, instructions)
    log_prob = jax.vmap(low.actions.log_prob)(outputs, decision.action)
    entropy = jax.vmap(low.actions.entropy)(outputs)
    return loss(log_prob, decision.log_prob, value, entropy, credit, settings, progress)
