"""gymnax's own wrappers, and rollouts as people write them for it, on the adapter."""

from __future__ import annotations

import importlib.metadata
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax import Walk
from envs_jax.adapters.gymnax import GymnaxEnv
from hrlspec.tasks.text_tasks import TextTasks
from tests.probes import Corridor, quick_jit

LEFT, RIGHT = 0, 1
CORRIDOR = Corridor(starts=(2,), horizon=3)
TASKS = TextTasks(CORRIDOR.propositions, 8)


class Transition(NamedTuple):
    done: jax.Array
    action: jax.Array
    reward: jax.Array
    obs: jax.Array
    info: Any


def test_a_rollout_as_purejaxrl_writes_it() -> None:
    """Keys of the old kind, parameters shared by all environments, five values."""
    env = GymnaxEnv(CORRIDOR, TASKS, "achieve a")
    env_params = env.default_params
    assert env.action_space(env_params).n == 2
    assert env.observation_space(env_params).shape == (5, 6)

    def rollout(rng: jax.Array) -> Transition:
        rng, _rng = jax.random.split(rng)
        obsv, env_state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(_rng, 4), env_params)

        def _env_step(runner_state: Any, unused: None) -> Any:
            env_state, last_obs, rng = runner_state
            rng, _rng = jax.random.split(rng)
            action = jnp.full(4, LEFT)
            obsv, env_state, reward, done, info = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
                jax.random.split(_rng, 4), env_state, action, env_params
            )
            return (env_state, obsv, rng), Transition(done, action, reward, last_obs, info)

        return jax.lax.scan(_env_step, (env_state, obsv, rng), None, 4)[1]

    batch = quick_jit(rollout)(jax.random.PRNGKey(30))
    assert batch.obs.shape == (4, 4, 5, 6)
    assert batch.reward.T.tolist() == [[0, 1, 0, 1]] * 4
    assert np.array_equal(batch.done, batch.reward > 0)


def test_an_evaluation_as_rejax_writes_it() -> None:
    """Until the episode ends or ``max_steps_in_episode`` are over."""
    env = GymnaxEnv(CORRIDOR, TASKS, "achieve b")
    params = env.default_params

    def evaluate_single(rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        rng_reset, rng_eval = jax.random.split(rng)
        obs, env_state = env.reset(rng_reset, params)

        def step(state: Any) -> Any:
            rng, env_state, _, done, return_, length = state
            rng, rng_step = jax.random.split(rng)
            obs, env_state, reward, done, _ = env.step(rng_step, env_state, jnp.int32(RIGHT), params)
            return rng, env_state, obs, done, return_ + reward.squeeze(), length + 1

        def cond(state: Any) -> jax.Array:
            return jnp.logical_and(state[5] < params.max_steps_in_episode, jnp.logical_not(state[3]))

        end = jax.lax.while_loop(cond, step, (rng_eval, env_state, obs, False, 0.0, 0))
        return end[5], end[4]

    lengths, returns = quick_jit(jax.vmap(evaluate_single))(jax.random.split(jax.random.PRNGKey(0), 3))
    assert (lengths.tolist(), returns.tolist()) == ([2] * 3, [1.0] * 3)


def test_a_step_as_gymnax_1_gives_it() -> None:
    env = GymnaxEnv(CORRIDOR, TASKS, "achieve d", six=True)
    _, state = env.reset(jax.random.key(0))
    step = quick_jit(env.step)
    ends = []
    for t in range(3):
        obs, state, _, terminated, truncated, info = step(jax.random.key(t), state, RIGHT, env.default_params)
        ends.append((bool(terminated), bool(truncated)))
    assert ends == [(False, False), (False, False), (False, True)]
    assert not np.array_equal(obs, info["final_observation"])


def test_gymnaxs_own_wrappers() -> None:
    pytest.importorskip("gymnax", reason="gymnax is not installed")
    from gymnax.environments import spaces
    from gymnax.wrappers.purerl import FlattenObservationWrapper, LogWrapper

    six = int(importlib.metadata.version("gymnax").split(".")[0]) >= 1
    inner = GymnaxEnv(CORRIDOR, TASKS, "achieve a", six=six)
    env, params = LogWrapper(FlattenObservationWrapper(inner)), inner.default_params
    assert env.observation_space(params).shape == (30,)
    assert isinstance(env.action_space(params), spaces.Discrete)
    assert isinstance(GymnaxEnv(Walk()).action_space(), spaces.Box)
    obs, state = env.reset(jax.random.PRNGKey(0), params)
    assert obs.shape == (30,)
    logged = []
    for t in range(4):
        obs, state, *_, info = env.step(jax.random.PRNGKey(t), state, LEFT, params)
        logged.append((bool(info["returned_episode"]), float(info["returned_episode_returns"])))
    assert obs.shape == (30,)
    assert logged == [(False, 0.0), (True, 1.0), (False, 1.0), (True, 1.0)]
    assert int(info["returned_episode_lengths"]) == 2
