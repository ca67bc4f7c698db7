"""Environments for Gymnasium: one at a time, and many side by side in one compiled call.

Nothing is computed before the first reset, so that environments can be made, and the process forked, before JAX starts
its threads. In a fork of a process in which it had started them, JAX would wait for ever: a reset refuses there.

Axes: **E** environments, **P** atomic propositions.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax._src.xla_bridge import backends_are_initialized  # no public name says whether JAX has started

from envs_jax.adapters.tasks import Episode, Step, Task, Tasks, begin, begin_where, reading, step
from envs_jax.base import Box, Discrete, Environment, EnvParams, Layout
from envs_jax.layouts import _check as check_layouts

try:
    import gymnasium
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError('the Gymnasium adapter needs the extra "adapters": pip install "hrlspec[adapters]"') from error

OPTIONS = ("task", "layout")

_UNUSABLE: set[int] = set()
"""This process, if it was forked from one in which JAX had started."""


def _note_fork() -> None:
    if backends_are_initialized():
        _UNUSABLE.add(os.getpid())


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_note_fork)


class GymnasiumEnv(gymnasium.Env[np.ndarray, Any]):
    """One environment.

    ``reset(options={"task": text})`` gives the task; it stays in force for later episodes until another is given,
    and ``{"task": None}`` takes it away. ``options={"layout": layout}`` starts in a given layout.

    Observation and action: as the environment's. Reward: the environment's own (0 unless its documentation says
    otherwise) and the task's. Terminated: the task has ended, done or lost, or the environment ended the episode.
    Truncated: the horizon was reached first. ``info``: ``labels`` (bool ``[P]``, the propositions that hold, in the
    order of ``propositions``) and, with a task, what `Tasks.describe` says of it.

    Attributes:
        propositions: names of the P propositions.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}  # type: ignore[misc]

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
            tasks: the language of its tasks; without one, no task can be given.
            task: the task until another is given.
            params: the environment's traced parameters, its own if left out.

        Raises:
            ValueError: if the task cannot be read.
        """
        self.propositions = env.propositions
        self.observation_space = _space(env.observation_space)
        self.action_space = _space(env.action_space)
        self._env, self._language = env, tasks
        self._params = params
        self._text = task
        self._tasks, self._task = reading(tasks, task)
        self._key: jax.Array | None = None
        self._episode: Episode | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode.

        Raises:
            ValueError: if an option is unknown, the task cannot be read or the layout cannot be used.
        """
        _check_fork()
        options = _checked_options(options)
        layout = _layouts(self._env, options["layout"], None) if "layout" in options else None
        if "task" in options:
            self._tasks, self._task = reading(self._language, options["task"])
            self._text = options["task"]
        super().reset(seed=seed)
        if self._params is None:
            self._params = self._env.default_params
        self._key = _key(self.np_random)
        self._key, observation, self._episode, labels = _begin(
            self._env, self._tasks, self._key, self._task, self._params, layout
        )
        return np.array(observation), self._info(labels)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step.

        Raises:
            ValueError: if there is no such action.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("the environment was stepped before its first reset")
        action = _checked_action(self._env, action, ())
        self._key, self._episode, now = _step(
            self._env, self._tasks, self._key, self._episode, self._task, action, self._params
        )
        info = self._info(now.labels)
        return np.array(now.observation), float(now.reward), bool(now.terminated), bool(now.truncated), info

    def _info(self, labels: jax.Array) -> dict[str, Any]:
        assert self._episode is not None
        progress = jax.device_get(self._episode.progress)
        return {"labels": np.array(labels)} | self._tasks.describe(self._text or "", progress)


class GymnasiumVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many environments side by side, each with a task of its own, in one compiled call.

    Auto-reset in the same step: where an episode ended, observation and ``info`` are the next episode's first ones, in
    a new layout and with the same task, and ``info["final_obs"]`` and ``info["final_info"]`` are what the step led to.
    Tasks are given as in :class:`GymnasiumEnv`: one text for all, or E texts. Seeds, too: environment e starts as a
    single one does with seed ``seed + e``, or with the e-th of E seeds.

    Attributes:
        num_envs: E.
        propositions: names of the P propositions.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        env: Environment,
        num_envs: int,
        tasks: Tasks | None = None,
        *,
        task: str | Sequence[str] | None = None,
        params: EnvParams | None = None,
    ) -> None:
        """E times ``env``; see :class:`GymnasiumEnv`.

        Raises:
            ValueError: if there is less than one environment, or a task cannot be read.
        """
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}, expected 1 or more")
        self.num_envs = num_envs
        self.propositions = env.propositions
        self.single_observation_space = _space(env.observation_space)
        self.single_action_space = _space(env.action_space)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._env, self._language = env, tasks
        self._params = params
        self._give(task)
        self._keys: jax.Array | None = None
        self._episodes: Episode | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts all episodes anew; a layout, if given, has a leading axis E.

        Raises:
            ValueError: if an option is unknown, there are not E seeds or tasks, one of them cannot be read, or a
                layout cannot be used.
        """
        _check_fork()
        options = _checked_options(options)
        layouts = _layouts(self._env, options["layout"], self.num_envs) if "layout" in options else None
        generators = self._generators(seed)
        if "task" in options:
            self._give(options["task"])
        if generators is not None:
            super().reset(seed=seed if isinstance(seed, int) else None)
        if self._params is None:
            self._params = self._env.default_params
        keys = jnp.stack([_key(g) for g in generators or [self.np_random] * self.num_envs])
        self._keys, observation, self._episodes, labels = _begin_all(
            self._env, self._tasks, keys, self._task, self._params, layouts
        )
        every = np.arange(self.num_envs)
        return np.array(observation), self._infos(every, self._episodes.progress, labels)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all environments.

        Raises:
            ValueError: if these are not E actions.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._episodes is None:
            raise gymnasium.error.ResetNeeded("the environments were stepped before their first reset")
        actions = _checked_action(self._env, actions, (self.num_envs,))
        self._keys, observation, self._episodes, labels, ended = _step_all(
            self._env, self._tasks, self._keys, self._episodes, self._task, actions, self._params
        )
        final: Step = jax.device_get(ended)
        infos = self._infos(np.arange(self.num_envs), self._episodes.progress, labels)
        done = np.flatnonzero(final.terminated | final.truncated)
        if done.size:
            infos |= _columns([{"final_obs": final.observation[e].copy()} for e in done], done, self.num_envs)
            infos["final_info"] = self._infos(done, final.progress, final.labels)
            infos["_final_info"] = infos["_final_obs"].copy()
        return (
            np.array(observation),
            np.array(final.reward, np.float64),
            np.array(final.terminated),
            np.array(final.truncated),
            infos,
        )

    def _give(self, task: str | Sequence[str] | None) -> None:
        """Puts a task in force: one text for all, E texts, or none."""
        texts = [task] * self.num_envs if task is None or isinstance(task, str) else list(task)
        if len(texts) != self.num_envs:
            raise ValueError(f"found {len(texts)} tasks for {self.num_envs} environments")
        if any((text is None) != (texts[0] is None) for text in texts):
            raise ValueError("found tasks for some environments only, expected tasks for all of them or for none")
        read = {text: reading(self._language, text) for text in texts}
        tasks = [read[text][1] for text in texts]
        self._tasks: Tasks = read[texts[0]][0]
        self._task: Task = jax.tree.map(lambda *leaves: np.stack(leaves), *tasks)
        self._texts = [text or "" for text in texts]

    def _generators(self, seed: int | Sequence[int] | None) -> list[np.random.Generator] | None:
        """Each environment's source of randomness, as a single environment would have it."""
        if seed is None:
            return None
        seeds = [seed + e for e in range(self.num_envs)] if isinstance(seed, int) else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"found {len(seeds)} seeds for {self.num_envs} environments")
        return [seeding.np_random(one)[0] for one in seeds]

    def _infos(self, which: np.ndarray, progress: Any, labels: Any) -> dict[str, Any]:
        """What ``info`` says of some environments, in Gymnasium's columns."""
        progress, labels = jax.device_get((progress, labels))
        leaves, structure = jax.tree.flatten(progress)
        rows = [
            {"labels": labels[e]}
            | self._tasks.describe(self._texts[e], jax.tree.unflatten(structure, [leaf[e] for leaf in leaves]))
            for e in which
        ]
        return _columns(rows, which, self.num_envs)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _begin(env: Environment, tasks: Tasks, key: jax.Array, task: Task, params: EnvParams, layout: Any) -> Any:
    """Key for later, first observation, episode and labels."""
    key, start_key = jax.random.split(key)
    observation, episode = begin(env, tasks, start_key, task, params, layout)
    return key, observation, episode, env.labels(episode.state, params)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _begin_all(env: Environment, tasks: Tasks, keys: jax.Array, task: Task, params: EnvParams, layouts: Any) -> Any:
    """:func:`_begin` for all environments."""
    return jax.vmap(functools.partial(_begin, env, tasks), (0, 0, None, 0))(keys, task, params, layouts)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _step(
    env: Environment, tasks: Tasks, key: jax.Array, episode: Episode, task: Task, action: Any, params: EnvParams
) -> Any:
    """Key for later, episode, and what the step led to."""
    key, step_key = jax.random.split(key)
    return key, *step(env, tasks, step_key, episode, task, action, params)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _step_all(
    env: Environment, tasks: Tasks, keys: jax.Array, episodes: Episode, task: Task, actions: Any, params: EnvParams
) -> Any:
    """Keys for later, observations, episodes and labels after auto-reset, and what the step led to before it."""

    def one(key: jax.Array, episode: Episode, task: Task, action: jax.Array) -> Any:
        key, step_key, restart_key = jax.random.split(key, 3)
        episode, now = step(env, tasks, step_key, episode, task, action, params)
        done = now.terminated | now.truncated
        observation, episode = begin_where(env, tasks, done, restart_key, now.observation, episode, task, params)
        return key, observation, episode, env.labels(episode.state, params), now

    return jax.vmap(one)(keys, episodes, task, actions)


def _check_fork() -> None:
    """Raises ``RuntimeError`` where JAX would wait for ever."""
    if os.getpid() in _UNUSABLE:
        raise RuntimeError(
            "JAX had started in the process that this one was forked from, and cannot run here; start processes with "
            'context="spawn", or before anything is computed, or step many environments in one with make_vec'
        )


def _key(generator: np.random.Generator) -> jax.Array:
    return jax.random.key(int(generator.integers(2**31)))


def _space(space: Box | Discrete) -> gymnasium.Space[Any]:
    """The same space in Gymnasium's terms."""
    if isinstance(space, Discrete):
        return gymnasium.spaces.Discrete(space.n)
    return gymnasium.spaces.Box(space.low, space.high, space.shape, np.float32)


def _checked_options(options: dict[str, Any] | None) -> dict[str, Any]:
    unknown = [name for name in options or {} if name not in OPTIONS]
    if unknown:
        raise ValueError(f"found reset options {', '.join(map(repr, unknown))}, known are {', '.join(OPTIONS)}")
    return options or {}


def _checked_action(env: Environment, action: Any, batch: tuple[int, ...]) -> np.ndarray:
    """The action as an array of the right type and shape.

    JAX would read an index out of range as another one, and a NaN would stay in the state for ever.
    """
    space = env.action_space
    found = np.asarray(action)
    if found.shape != (*batch, *space.shape):
        raise ValueError(f"found an action of shape {list(found.shape)}, expected {[*batch, *space.shape]}")
    if isinstance(space, Discrete) and not (
        np.issubdtype(found.dtype, np.integer) and ((found >= 0) & (found < space.n)).all()
    ):
        raise ValueError(f"found action {found.tolist()}, expected integers from 0 to {space.n - 1}")
    if isinstance(space, Box) and np.isnan(found).any():
        raise ValueError(f"found action {found.tolist()}, expected numbers")
    return found.astype(space.dtype)


def _layouts(env: Environment, layouts: Layout, number: int | None) -> Layout:
    """Given layouts, checked: so many with a leading axis, or (``None``) one without."""
    leaves = [np.asarray(leaf)[None] if number is None else np.asarray(leaf) for leaf in jax.tree.leaves(layouts)]
    check_layouts(env, leaves, "reset option 'layout'")
    if number is not None and len(leaves[0]) != number:
        raise ValueError(f"found {len(leaves[0])} layouts for {number} environments")
    structure = jax.tree.structure(jax.eval_shape(env.sample_layout, jax.random.key(0), env.default_params))
    return jax.tree.unflatten(structure, [leaf[0] if number is None else leaf for leaf in leaves])


def _columns(rows: list[dict[str, Any]], which: np.ndarray, num_envs: int) -> dict[str, Any]:
    """Gymnasium's ``info`` of a vector: an array per key, and a mask of the environments that it speaks of.

    Args:
        rows: what there is to say, one row for each of ``which``.
        which: int, indices of environments.
        num_envs: E.
    """
    infos: dict[str, Any] = {}
    said = np.isin(np.arange(num_envs), which)
    for name, value in rows[0].items():
        plain = isinstance(value, bool | int | float | np.ndarray) and name != "final_obs"
        column = np.zeros((num_envs, *np.shape(value)), np.asarray(value).dtype) if plain else np.full(num_envs, None)
        for e, row in zip(which, rows, strict=True):
            column[e] = row[name]
        infos[name], infos[f"_{name}"] = column, said.copy()
    return infos
