"""Environments with gymnax's interface, for its wrappers and for code written against it. Needs nothing installed.

That is the interface of gymnax before 1.0, as purejaxrl and rejax use it, where a step gives five values; or, if asked
for, that of 1.0, where it gives six. Keys are of either kind. What wants more of gymnax's class than the methods here
(``get_obs``, ``is_terminal``, ``state_space``, the conversions to Gym, dm_env and brax in ``gymnax.wrappers``) is not
there; for Gymnasium and brax there are adapters of their own.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs_jax.adapters.tasks import Episode, Step, Task, Tasks, begin, begin_where, reading, step, typed_key
from envs_jax.base import Box, Discrete, Environment, EnvParams, Info

FiveTuple = tuple[jax.Array, Episode, jax.Array, jax.Array, Info]
SixTuple = tuple[jax.Array, Episode, jax.Array, jax.Array, jax.Array, Info]


@struct.dataclass
class GymnaxParams:
    """What may be traced: ``vmap`` over it for a batch of tasks.

    Attributes:
        env: the environment's parameters.
        task: the task, as :meth:`GymnaxEnv.params_for` reads it.
    """

    env: EnvParams
    task: Task

    @property
    def max_steps_in_episode(self) -> jax.Array:
        """The horizon, int32 ``[]``, by gymnax's name; to change it, replace the one in ``env``."""
        return self.env.horizon


@dataclasses.dataclass(frozen=True)
class GymnaxEnv:
    """An environment, with a task that lives in the parameters.

    ``done`` is true when the task has ended, done or lost, when the environment ended the episode, and at the
    horizon; ``info["discount"]`` is 0 where there is nothing to bootstrap from, so 1 at the horizon.

    Attributes:
        env: the environment.
        tasks: the language of its tasks; without one, no task can be given.
        task: the task of ``default_params``; without one, the bare environment.
        six: whether :meth:`step` gives ``terminated`` and ``truncated`` in place of ``done``, as gymnax 1.0 does.
    """

    env: Environment
    tasks: Tasks | None = None
    task: str | None = None
    six: bool = False

    def __post_init__(self) -> None:
        reading(self.tasks, self.task)  # A task that cannot be read is refused here.

    @property
    def name(self) -> str:
        """The preset's name."""
        return self.env.name

    @property
    def default_params(self) -> GymnaxParams:
        """The parameters with the task of this environment."""
        return self._params_for(self.task)

    @property
    def num_actions(self) -> int:
        """Discrete actions, or numbers in a continuous one."""
        space = self.env.action_space
        return space.n if isinstance(space, Discrete) else math.prod(space.shape)

    def params_for(self, text: str) -> GymnaxParams:
        """The parameters with another task; their shapes are the same for every text.

        Raises:
            ValueError: if the text means no task, or this environment was made without a task.
        """
        if self.task is None:
            raise ValueError(f"found the task {text!r} for an environment made without one; give it `task` first")
        return self._params_for(text)

    def action_space(self, params: GymnaxParams | None = None) -> Any:
        """Where actions lie: a space of gymnax's where it is installed, since its users ask for the class."""
        return _space(self.env.action_space)

    def observation_space(self, params: GymnaxParams | None = None) -> Any:
        """Where observations lie; likewise."""
        return _space(self.env.observation_space)

    def reset(self, key: jax.Array, params: GymnaxParams | None = None) -> tuple[jax.Array, Episode]:
        """Starts an episode in a new layout: ``(observation, state)``. The key is consumed."""
        params = self.default_params if params is None else params
        return begin(self.env, self._language, typed_key(key), params.task, params.env)

    def step(
        self, key: jax.Array, state: Episode, action: jax.Array, params: GymnaxParams | None = None
    ) -> FiveTuple | SixTuple:
        """One step with auto-reset: ``(observation, state, reward, done, info)``. The key is consumed.

        Where the episode ended, observation and state are the next one's first, in a new layout;
        ``info["final_observation"]`` is what the step led to, and everything else in ``info`` belongs to it.
        """
        params = self.default_params if params is None else params
        step_key, restart_key = jax.random.split(typed_key(key))
        observation, state, reward, done, info = self.step_env(step_key, state, action, params)
        info["final_observation"] = observation
        observation, state = begin_where(
            self.env, self._language, done, restart_key, observation, state, params.task, params.env
        )
        if self.six:
            return observation, state, reward, info["terminated"], info["truncated"], info
        return observation, state, reward, done, info

    def step_env(
        self, key: jax.Array, state: Episode, action: jax.Array, params: GymnaxParams | None = None
    ) -> FiveTuple:
        """One step without auto-reset; five values in either case."""
        params = self.default_params if params is None else params
        state, now = step(self.env, self._language, typed_key(key), state, params.task, action, params.env)
        return now.observation, state, now.reward, now.terminated | now.truncated, _info(now)

    def _params_for(self, text: str | None) -> GymnaxParams:
        task = jax.tree.map(jnp.asarray, reading(self.tasks, text)[1])
        return GymnaxParams(env=self.env.default_params, task=task)

    @property
    def _language(self) -> Any:
        return reading(self.tasks, self.task)[0]


def _space(space: Box | Discrete) -> Any:
    """The same space as gymnax makes it, if it can."""
    try:
        from gymnax.environments import spaces
    except ImportError:
        return space
    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    return spaces.Box(space.low, space.high, space.shape, space.dtype)


def _info(now: Step) -> Info:
    return {
        "discount": 1.0 - now.terminated.astype(jnp.float32),
        "terminated": now.terminated,
        "truncated": now.truncated,
        "success": now.success,
        "labels": now.labels,
    }
