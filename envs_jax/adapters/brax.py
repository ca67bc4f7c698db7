"""Environments for brax: its interface, and its training wrappers with a new layout at every reset.

Axes: **B** environments side by side, **F** numbers in an observation.
"""

from __future__ import annotations

import contextlib
import io
import math

import jax
import jax.numpy as jnp

from envs_jax.adapters.tasks import Tasks, begin, begin_where, reading, step, typed_key
from envs_jax.base import Box, Environment, EnvParams

try:
    # It prints on standard output which of its optional physics are not there.
    with contextlib.redirect_stdout(io.StringIO()):
        from brax.envs.base import Env, State, Wrapper
        from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
except ImportError as error:
    raise ImportError('the brax adapter needs the extra "adapters": pip install "hrlspec[adapters]"') from error


class BraxEnv(Env):
    """One environment, with one task for good.

    Observation: float32 ``[F]``, flattened. Action: float32 in [-1, 1], stretched to the environment's box; where
    actions are discrete, a number for each of them, of which the largest is taken (the first, if equal): so any
    policy made for brax will do. Reward: the environment's own (0 unless its documentation says otherwise) and the
    task's. ``done``: the task has ended, done or lost, or the environment ended the episode. The horizon is left to
    brax's ``EpisodeWrapper`` (``episode_length=env.horizon``), which tells truncation from termination.
    ``metrics``: ``success``, 1 in the step that completes the task. ``info``: ``key``, consumed from step to step,
    and ``labels``, bool ``[P]``, the propositions that hold.

    brax's own ``AutoResetWrapper`` starts every episode of a run in the first one's layout; use :func:`wrap`.

    Attributes:
        env: the environment.
        horizon: steps of an episode.
    """

    def __init__(
        self,
        env: Environment,
        tasks: Tasks | None = None,
        *,
        task: str | None = None,
        params: EnvParams | None = None,
    ) -> None:
        """Wraps ``env``.

        Args:
            env: the environment.
            tasks: the language of the task.
            task: the task; without one, the bare environment.
            params: the environment's traced parameters, its own if left out.

        Raises:
            ValueError: if the task cannot be read.
        """
        self.env = env
        self.horizon = env.horizon
        self._params = env.default_params if params is None else params
        self._tasks, read = reading(tasks, task)
        self._task = jax.tree.map(jnp.asarray, read)

    @property
    def observation_size(self) -> int:
        """F."""
        return math.prod(self.env.observation_shape)

    @property
    def action_size(self) -> int:
        """Numbers in an action: the box's, or one for each discrete action."""
        space = self.env.action_space
        return math.prod(space.shape) if isinstance(space, Box) else space.n

    @property
    def backend(self) -> str:
        """The environment's name: none of brax's physics is at work."""
        return self.env.name

    def reset(self, rng: jax.Array) -> State:
        """Starts an episode in a new layout. ``rng`` is a key of either kind, and consumed."""
        key, start_key = jax.random.split(typed_key(rng))
        observation, episode = begin(self.env, self._tasks, start_key, self._task, self._params)
        labels = self.env.labels(episode.state, self._params)
        zero = jnp.float32(0.0)
        info = {"key": jax.random.key_data(key), "labels": labels}
        return State(episode, observation.reshape(-1), zero, zero, {"success": zero}, info)

    def step(self, state: State, action: jax.Array) -> State:
        """One step."""
        key, step_key = jax.random.split(typed_key(state.info["key"]))
        episode, now = step(
            self.env, self._tasks, step_key, state.pipeline_state, self._task, self._native(action), self._params
        )
        return state.replace(
            pipeline_state=episode,
            obs=now.observation.reshape(-1),
            reward=now.reward,
            done=now.terminated.astype(jnp.float32),
            metrics={**state.metrics, "success": now.success.astype(jnp.float32)},
            info={**state.info, "key": jax.random.key_data(key), "labels": now.labels},
        )

    def restart_where(self, state: State, done: jax.Array) -> State:
        """The first state of an episode in another layout where ``done`` (bool ``[]``), else ``state``.

        Reward, ``done`` and metrics stay those of the step that ended the episode.
        """
        key, restart_key = jax.random.split(typed_key(state.info["key"]))
        now = state.obs.reshape(self.env.observation_shape)
        observation, episode = begin_where(
            self.env, self._tasks, done, restart_key, now, state.pipeline_state, self._task, self._params
        )
        info = {
            **state.info,
            "key": jax.random.key_data(key),
            "labels": self.env.labels(episode.state, self._params),
        }
        return state.replace(pipeline_state=episode, obs=observation.reshape(-1), info=info)

    def _native(self, action: jax.Array) -> jax.Array:
        """The environment's own action."""
        space = self.env.action_space
        if not isinstance(space, Box):
            return jnp.argmax(action).astype(space.dtype)
        share = (action.reshape(space.shape) + 1) / 2
        return space.low * (1 - share) + space.high * share


class NewLayoutWrapper(Wrapper):
    """Auto-reset into a new layout, in place of brax's ``AutoResetWrapper``; outermost, around ``EpisodeWrapper``."""

    def step(self, state: State, action: jax.Array) -> State:
        """One step of B environments; where an episode ends, the observation is the next one's first."""
        steps = jnp.where(state.done > 0, 0, state.info["steps"])
        state = state.replace(done=jnp.zeros_like(state.done), info={**state.info, "steps": steps})
        state = self.env.step(state, action)
        return jax.vmap(self.unwrapped.restart_where)(state, state.done > 0)


def wrap(env: BraxEnv, episode_length: int | None = None, action_repeat: int = 1) -> Wrapper:
    """The training wrappers of brax around many environments, with a new layout at every reset.

    Args:
        env: the environment; ``reset`` of the result takes keys ``[B, 2]`` (``jax.random.PRNGKey``), as brax does.
        episode_length: steps of an episode, the environment's horizon if left out.
        action_repeat: steps for which an action is held.
    """
    length = env.horizon if episode_length is None else episode_length
    return NewLayoutWrapper(EpisodeWrapper(VmapWrapper(env), length, action_repeat))
