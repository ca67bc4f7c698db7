"""What turns a bare environment into one with a task, without knowing any task language.

Everything but reading and describing a task is a pure function of arrays, for one unbatched item, so that an adapter
steps environment, task and reset in one compiled call.

Axes: **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float, Float32, Int, Key

from envs_jax.arrays import Array
from envs_jax.base import Environment, EnvParams, Layout, State

Task = Any
"""A task as a pytree of arrays."""

Progress = Any
"""Where a task stands: a pytree of arrays."""


@struct.dataclass
class Verdict:
    """What a step meant for the task.

    Attributes:
        reward: float32 ``[]``, for this step.
        ended: bool ``[]``, there is nothing left to do: the episode terminates.
        success: bool ``[]``, the task is done.
    """

    reward: Float32[Array, "*lead"]
    ended: Bool[Array, "*lead"]
    success: Bool[Array, "*lead"]


class Tasks(Protocol):
    """A task language. A static, hashable value; its pure methods are jitted and vmapped."""

    def read(self, text: str) -> Task:
        """The task that a text means, numpy leaves, with the same shapes for every text. On the host.

        Raises:
            ValueError: if the text means no task.
        """

    def start(self, task: Task) -> Progress:
        """Where a task stands before the first action."""

    def advance(self, task: Task, progress: Progress, labels: jax.Array) -> tuple[Progress, Verdict]:
        """One step, given the propositions that hold in the new state, bool ``[P]``."""

    def describe(self, text: str, progress: Progress) -> dict[str, Any]:
        """Where the task stands, for people: the same keys and types for every text. On the host (numpy arrays)."""


@dataclasses.dataclass(frozen=True)
class NoTasks:
    """No task at all: rewards and ends are the environment's own."""

    def read(self, text: str) -> Task:
        """Refuses every text."""
        raise ValueError(
            f"found the task {text!r}, but this environment was made without a task language: "
            "give the adapter `tasks`, or make the environment with `hrlspec.gymnasium.make`"
        )

    def start(self, task: Task) -> Progress:
        """Nothing."""
        return ()

    def advance(self, task: Task, progress: Progress, labels: jax.Array) -> tuple[Progress, Verdict]:
        """Pays nothing and never ends."""
        return (), Verdict(reward=jnp.float32(0.0), ended=jnp.bool_(False), success=jnp.bool_(False))

    def describe(self, text: str, progress: Progress) -> dict[str, Any]:
        """Nothing."""
        return {}


NO_TASKS = NoTasks()


@struct.dataclass
class Episode:
    """A running episode.

    Attributes:
        state: of the environment.
        progress: of the task.
    """

    state: State
    progress: Progress


@struct.dataclass
class Step:
    """What a step led to, before any reset.

    Attributes:
        observation: float32 ``observation_shape``.
        progress: of the task.
        labels: bool ``[P]``, the propositions that hold.
        reward: float32 ``[]``, the environment's own and the task's.
        terminated: bool ``[]``, the task is done or lost, or the environment ended the episode.
        truncated: bool ``[]``, the horizon cut off an episode that had not terminated.
        success: bool ``[]``, the task is done.
    """

    observation: jax.Array
    progress: Progress
    labels: Bool[Array, "*lead P"]
    reward: Float32[Array, "*lead"]
    terminated: Bool[Array, "*lead"]
    truncated: Bool[Array, "*lead"]
    success: Bool[Array, "*lead"]


def begin(
    env: Environment, tasks: Tasks, key: Key[Array, ""], task: Task, params: EnvParams, layout: Layout | None = None
) -> tuple[jax.Array, Episode]:
    """Starts an episode, in a new layout unless one is given: ``(observation, episode)``. The key is consumed."""
    observation, state = env.reset(key, params) if layout is None else env.reset_to(layout, key, params)
    return observation, Episode(state=state, progress=tasks.start(task))


def step(
    env: Environment,
    tasks: Tasks,
    key: Key[Array, ""],
    episode: Episode,
    task: Task,
    action: Int[Array, ""] | Float[Array, " A"],
    params: EnvParams,
) -> tuple[Episode, Step]:
    """One step of environment and task, without auto-reset. The key is consumed."""
    observation, state, reward, failed, truncated, _ = env.step_env(key, episode.state, action, params)
    labels = env.labels(state, params)
    progress, verdict = tasks.advance(task, episode.progress, labels)
    terminated = failed | verdict.ended
    return Episode(state=state, progress=progress), Step(
        observation=observation,
        progress=progress,
        labels=labels,
        reward=reward + verdict.reward,
        terminated=terminated,
        truncated=truncated & ~terminated,
        success=verdict.success,
    )


def begin_where(
    env: Environment,
    tasks: Tasks,
    done: jax.Array,
    key: Key[Array, ""],
    now: jax.Array,
    episode: Episode,
    task: Task,
    params: EnvParams,
) -> tuple[jax.Array, Episode]:
    """The same task from its start, in a layout that differs from the one that ended, where an episode is ``done``.

    Args:
        env: the environment.
        tasks: the task language.
        done: bool ``[]``; elsewhere observation and episode are returned as they are.
        key: consumed.
        now: float32 ``observation_shape``, the observation that the last step led to.
        episode: where it led to.
        task: to start again.
        params: of the environment.
    """
    layout_key, start_key = jax.random.split(key)
    layout = env.resample_layout(layout_key, episode.state.layout, done, params)
    fresh = begin(env, tasks, start_key, task, params, layout)
    observation, episode = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, (now, episode))
    return observation, episode


def reading(tasks: Tasks | None, text: str | None) -> tuple[Tasks, Task]:
    """The language to use for a text, and the task, numpy leaves: no task at all where there is no text.

    Raises:
        ValueError: if there is a text but no language, or the text means no task.
    """
    if text is None:
        return NO_TASKS, ()
    if not isinstance(text, str):
        raise ValueError(f"found a task of type {type(text).__name__}, expected text")
    language = NO_TASKS if tasks is None else tasks
    return language, language.read(text)


def typed_key(key: jax.Array) -> Key[Array, ""]:
    """A key of either kind as a typed one; brax's and gymnax's are uint32 ``[2]``."""
    return key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)
