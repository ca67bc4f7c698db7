"""Targets of both levels: λ-returns with the max operator, and SMDP advantages between the high level's decisions.

Axes: **T** time steps, **E** environments (any trailing axes).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32

from envs_jax.arrays import Array


def low_level_targets(
    reward: Float32[Array, "T E"],
    terminated: Bool[Array, "T E"],
    truncated: Bool[Array, "T E"],
    value: Float32[Array, "T E"],
    bootstrap: Float32[Array, "T E"],
    decided: Bool[Array, "T E"],
    high_value: Float32[Array, "T E"],
    *,
    discount: float | Float32[Array, ""],
    gae_lambda: float | Float32[Array, ""],
    max_operator: bool | Bool[Array, ""],
) -> Float32[Array, "T E"]:
    """λ-returns ``G_t = r_t + γ[(1−λ)V_{t+1} + λG_{t+1}]`` with the max operator (eq. 6).

    At a state where a new sub-task starts, G is raised to the high level's value of what remains:
    ``G := max(G, V^h)``. Values bootstrap on truncation and at the end of the rollout, never on termination.

    Args:
        reward: float32 ``[T, E]``, r_t earned by the action at t.
        terminated: bool ``[T, E]``, the action at t ended the episode for good.
        truncated: bool ``[T, E]``, it ended the episode by the horizon.
        value: float32 ``[T, E]``, V^l of the state at t.
        bootstrap: float32 ``[T, E]``, value of the state after t; read where truncated and at T - 1.
        decided: bool ``[T, E]``, a new sub-task starts at t.
        high_value: float32 ``[T, E]``, V^h of the state at t; read where ``decided``.
        discount: γ.
        gae_lambda: λ.
        max_operator: whether to apply it.

    Returns:
        G, float32 ``[T, E]``. The advantage is ``G - value``.
    """
    raised = decided & max_operator
    cut = truncated.at[-1].set(True)

    def backward(
        carry: tuple[Array, Array], inputs: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array], Float32[Array, " E"]]:
        next_value, next_return = carry
        reward, terminated, cut, value, bootstrap, raised, high_value = inputs
        ahead = (1 - gae_lambda) * next_value + gae_lambda * next_return
        ahead = jnp.where(cut, bootstrap, ahead)
        target = reward + discount * jnp.where(terminated, 0.0, ahead)
        passed_on = jnp.where(raised, jnp.maximum(target, high_value), target)
        return (value, passed_on), target

    zero = jnp.zeros_like(reward[0])
    inputs = (reward, terminated, cut, value, bootstrap, raised, high_value)
    return jax.lax.scan(backward, (zero, zero), inputs, reverse=True)[1]


def high_level_targets(
    reward: Float32[Array, "T E"],
    terminated: Bool[Array, "T E"],
    truncated: Bool[Array, "T E"],
    decided: Bool[Array, "T E"],
    value: Float32[Array, "T E"],
    bootstrap: Float32[Array, "T E"],
    *,
    discount: float | Float32[Array, ""],
    gae_lambda: float | Float32[Array, ""] | Float32[Array, "T E"],
) -> tuple[Float32[Array, "T E"], Float32[Array, "T E"]]:
    """SMDP generalised advantages of the high level's decisions.

    For a decision at t whose successor is at t' the reward is ``R = Σ γ^{τ−t} r_τ`` and the bootstrap
    ``γ^{t'−t} V(s_{t'})``; advantages follow ``A_t = δ_t + γ^{t'−t} λ A_{t'}``. A decision still open at the end of
    the rollout is bootstrapped with V^h of the state reached, and goes on in the next one.

    Args:
        reward: float32 ``[T, E]``, as for :func:`low_level_targets`.
        terminated: bool ``[T, E]``, likewise.
        truncated: bool ``[T, E]``, likewise.
        decided: bool ``[T, E]``, a decision was made at t.
        value: float32 ``[T, E]``, V^h at t; read where ``decided``.
        bootstrap: float32 ``[T, E]``, V^h of the state after t; read where truncated and at T - 1.
        discount: γ.
        gae_lambda: λ per decision, one for all or float32 ``[T, E]``.

    Returns:
        Advantages and returns (``advantage + value``), float32 ``[T, E]``; meaningful where ``decided``.
    """
    cut = truncated.at[-1].set(True)

    def backward(
        carry: tuple[Array, Array], inputs: tuple[Array, ...]
    ) -> tuple[tuple[Array, Array], Float32[Array, " E"]]:
        ahead, advantage_ahead = carry
        reward, terminated, cut, decided, value, bootstrap, gae_lambda = inputs
        ahead = jnp.where(cut, bootstrap, ahead)
        advantage_ahead = jnp.where(cut | terminated, 0.0, advantage_ahead)
        gain = reward + discount * jnp.where(terminated, 0.0, ahead)
        later = discount * advantage_ahead
        advantage = gain - value + later
        ahead = jnp.where(decided, value, gain)
        advantage_ahead = jnp.where(decided, gae_lambda * advantage, later)
        return (ahead, advantage_ahead), advantage

    zero = jnp.zeros_like(reward[0])
    inputs = (reward, terminated, cut, decided, value, bootstrap, jnp.broadcast_to(gae_lambda, reward.shape))
    advantage = jax.lax.scan(backward, (zero, zero), inputs, reverse=True)[1]
    return advantage, advantage + value
