"""From experience to batches: targets and advantages of both levels, and a sample of the high level's decisions.

Axes: **V** environments and relabelled copies, **T** time steps, **N** tree nodes, **B** decisions.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Int32, Key, Shaped

from envs_jax.arrays import Array
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import Credit, Experience, HighBatch, LowBatch
from hrlspec.agent.groups import take
from hrlspec.agent.low_level import Params
from hrlspec.config import PPOConfig
from hrlspec.learning import ppo
from hrlspec.learning.targets import high_level_targets, low_level_targets
from hrlspec.spec import open_edges


def low_batch(agent: Agent, params: Params, x: Experience) -> LowBatch:
    """All steps as samples of the low level; what it sees needs no parameters, and is the same in every epoch."""
    config = agent.config
    rewards = agent.high.low_level_rewards(x)
    target = low_level_targets(
        *_in_time(*rewards, x.low.value, x.bootstrap.low, x.high.made, x.high.value),
        discount=config.discount,
        gae_lambda=config.low.gae_lambda,
        max_operator=agent.high.max_operator,
    ).T
    advantage = ppo.scaled(target - x.low.value, x.low.value, config.low)
    feasible = _feasible(agent, x)
    now = agent.low.instructions_of(params, x.trees, x.slot, x.high.edge, feasible, x.high.ahead)
    return LowBatch(
        trees=x.trees,
        slot=x.slot,
        sight=jax.vmap(jax.vmap(agent.low.see))(x.view, now),
        edge=x.high.edge,
        ahead=x.high.ahead,
        feasible=feasible,
        decision=x.low,
        credit=Credit(advantage=advantage, target=target, learns=x.learns_low, valid=x.valid),
    )


def high_batch(key: Key[Array, ""], agent: Agent, x: Experience, settings: PPOConfig) -> HighBatch:
    """A random subset of the decisions, of fixed size B; when there are fewer, the rest is marked invalid.

    Args:
        key: consumed.
        agent: both levels.
        x: rollouts and copies.
        settings: how the high level learns.
    """
    outcome = x.outcome
    advantage, target = high_level_targets(
        *_in_time(outcome.reward, outcome.terminated, outcome.truncated, x.high.made, x.high.value, x.bootstrap.high),
        discount=agent.config.discount,
        # Choices of the task generator are no samples of the policy: their returns count with λ = 1.
        gae_lambda=jnp.where(x.learns_high.T, jnp.float32(settings.gae_lambda), 1.0),
    )
    advantage = ppo.scaled(advantage.T, x.high.value, settings)
    num_rows, num_steps = x.high.made.shape
    last, completed = _endings(x)
    wanted = x.high.made & x.valid & (completed | agent.high.learns_unfinished)
    lottery = jnp.where(wanted, jax.random.uniform(key, wanted.shape, jnp.float32), -1.0).reshape(-1)
    size = min(agent.high.num_samples(agent.config), num_rows * num_steps)
    score, index = jax.lax.top_k(lottery, size)
    row, time = index // num_steps, index % num_steps
    end = last[row, time]
    after = jnp.minimum(end + 1, num_steps - 1)
    over = (outcome.terminated | outcome.truncated)[row, end]

    def at(field: Any, when: Int32[Array, " B"] = time) -> Any:
        return take(field, row, when)

    return HighBatch(
        tree=take(x.trees, row, x.slot[row, time]),
        view=at(x.view),
        state=at(x.state),
        decision=at(x.high),
        credit=Credit(
            advantage=at(advantage),
            target=at(target.T),
            learns=(score >= 0) & at(x.learns_high),
            valid=score >= 0,
        ),
        reached=at(x.reached, end),
        next_view=at(x.view, after),
        completed=at(completed) & (end + 1 < num_steps) & ~over,
    )


def _endings(x: Experience) -> tuple[Int32[Array, "V T"], Bool[Array, "V T"]]:
    """For each step the first at or after it that ends a sub-task, int32 ``[V, T]``, and whether it completed it."""
    num_steps = x.valid.shape[1]
    ended = x.outcome.edge_taken | x.outcome.terminated | x.outcome.truncated | jnp.roll(x.high.made, -1, 1)
    end = jax.lax.cummin(jnp.where(ended, jnp.arange(num_steps, dtype=jnp.int32), num_steps), axis=1, reverse=True)
    last = jnp.minimum(end, num_steps - 1)
    return last, (end < num_steps) & jnp.take_along_axis(x.outcome.edge_taken, last, 1)


def _feasible(agent: Agent, x: Experience) -> Bool[Array, "V T _"]:
    """Open edges ``[V, T, N]`` where the low level is conditioned on them, else ``[V, T, 0]``."""
    if agent.method.sees != "whole task":
        return jnp.zeros((*x.slot.shape, 0), bool)
    rows = jnp.arange(x.slot.shape[0], dtype=jnp.int32)[:, None]
    trees = take(x.trees, rows, x.slot)
    return jax.vmap(jax.vmap(open_edges))(trees, x.state)


def _in_time(*arrays: Shaped[Array, "V T"]) -> tuple[Shaped[Array, "T V"], ...]:
    """Arrays ``[V, T]`` as ``[T, V]``."""
    return tuple(jnp.swapaxes(array, 0, 1) for array in arrays)
