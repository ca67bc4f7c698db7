"""Environments written for gymnax, and others with its interface, for agents of this library. Imports no gymnax."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from envs_jax.adapters.foreign import LARGEST_BOUND, Foreign, Labelling, Observation, Source, View, adopt
from envs_jax.base import Box, Discrete


@runtime_checkable
class GymnaxLike(Protocol):
    """What is used of a gymnax environment, beside its ``default_params``. Pure functions for one unbatched item."""

    def reset_env(self, key: jax.Array, params: Any) -> tuple[Any, Any]:
        """The first observation and state."""

    def step_env(self, key: jax.Array, state: Any, action: Any, params: Any) -> tuple[Any, ...]:
        """``(observation, state, reward, done, info)`` without auto-reset."""

    def action_space(self, params: Any) -> Any:
        """Where actions lie."""

    def observation_space(self, params: Any) -> Any:
        """Where observations lie."""


@runtime_checkable
class TellsTime(Protocol):
    """An environment of gymnax 1.0 or later: its ``done`` leaves out the time limit."""

    def is_truncated(self, state: Any, params: Any) -> Any:
        """Whether the time limit is reached."""


@runtime_checkable
class DiscreteSpace(Protocol):
    """A space of the integers ``0 .. n - 1``."""

    n: Any


@runtime_checkable
class BoxSpace(Protocol):
    """A space of arrays between bounds, one for all coordinates or one for each."""

    low: Any
    high: Any
    shape: Any


def from_gymnax(
    env: Any,
    labels: Labelling,
    *,
    propositions: Sequence[str] | None = None,
    horizon: int | None = None,
    params: Any = None,
    terminates: bool = True,
    view: View | None = None,
    name: str | None = None,
) -> Foreign:
    """A gymnax environment with labels, as an `Environment`.

    A layout is the environment's own first state with its first observation. Its rewards and its auto-reset are not
    used. Discrete actions stay as they are; boxes of actions become ``[A]`` in [-1, 1] and are stretched to their
    bounds. A discrete observation becomes one-hot.

    Args:
        env: an environment of gymnax, or one with ``reset_env``, ``step_env``, ``action_space``, ``observation_space``
            and ``default_params`` like it; without wrappers.
        labels: the propositions that hold in a state of ``env``: a dictionary of bool ``[]``, or an array bool ``[P]``.
        propositions: the names of an array's entries, or the order of a dictionary's (alphabetical if left out).
        horizon: steps after which an episode is truncated; the parameters' ``max_steps_in_episode`` if left out.
            ``env``'s own time limit is not used, but environments without ``is_truncated`` (gymnax before 1.0) count it
            as an end: choose no longer horizon for them; an end at the horizon is then taken for the limit.
        params: of ``env``; its ``default_params`` if left out.
        terminates: whether an episode that ``env`` ends is over, and a failure unless the task is done.
        view: splits an observation of ``env`` (float32) into float32 ``[P, ...]``, what belongs to each proposition,
            and float32 ``[F0]``, the rest. If left out nothing belongs to any, and numbers are scaled to [-1, 1] by the
            bounds of the observation space where it is a box and these are finite.
        name: the world's name, that of ``env``'s class if left out.

    Raises:
        ValueError: if ``env`` is no such environment, its actions are neither discrete nor a bounded box, the labels
            or the view have a wrong form, or tasks cannot use the names.
    """
    name = type(env).__name__ if name is None else name
    where = f"from_gymnax({type(env).__name__})"
    # The class is asked: wrappers pass what they lack to the environment within, which would undo what they do.
    if not issubclass(type(env), GymnaxLike):
        raise ValueError(
            f"{where}: expected an environment with the methods reset_env, step_env, action_space and "
            "observation_space, without wrappers"
        )
    params = env.default_params if params is None else params
    if horizon is None:
        horizon = getattr(params, "max_steps_in_episode", None)
        if horizon is None:
            raise ValueError(f"{where}: its parameters have no max_steps_in_episode, give the horizon")
    source = _source(env, params, where)
    return adopt(
        source,
        labels,
        propositions=propositions,
        horizon=int(horizon),
        terminates=terminates,
        view=view,
        name=name,
    )


def _source(env: Any, params: Any, where: str) -> Source:
    """The environment as pure functions."""
    seen, (space, native) = env.observation_space(params), _actions(env.action_space(params), where)

    def shown(observation: Observation) -> Observation:
        return jax.nn.one_hot(observation, int(seen.n)) if isinstance(seen, DiscreteSpace) else observation

    def reset(key: jax.Array, params: Any) -> tuple[Any, Any]:
        observation, state = env.reset_env(key, params)
        return shown(observation), state

    def step(key: jax.Array, state: Any, action: jax.Array, params: Any) -> tuple[Any, ...]:
        observation, state, _, done, _ = env.step_env(key, state, native(action), params)
        return shown(observation), state, jnp.asarray(done).astype(bool), jnp.bool_(False)

    return Source(
        name=where,
        params=params,
        action_space=space,
        reset=reset,
        step=step,
        ends_by_time=not issubclass(type(env), TellsTime),
        bounds=_bounds(seen),
    )


def _actions(space: Any, where: str) -> tuple[Discrete | Box, Callable[[jax.Array], jax.Array]]:
    """The space of an agent's actions, and what makes them the environment's own.

    Raises:
        ValueError: if they are of another kind, or unbounded.
    """
    if isinstance(space, DiscreteSpace) and np.ndim(space.n) == 0:
        return Discrete(n=int(space.n)), lambda action: action
    if not isinstance(space, BoxSpace):
        raise ValueError(f"{where}: actions lie in {space}, expected a Discrete or a Box space")
    shape = tuple(space.shape)
    low, high = (np.broadcast_to(np.asarray(x, np.float32), shape) for x in (space.low, space.high))
    if not (np.maximum(abs(low), abs(high)) <= LARGEST_BOUND).all() or not (low < high).all():
        raise ValueError(f"{where}: actions lie in {space}, expected finite bounds and low < high")
    if not math.prod(shape):
        raise ValueError(f"{where}: actions lie in {space}, expected one number or more")

    def native(action: jax.Array) -> jax.Array:
        share = (jnp.clip(action, -1.0, 1.0).reshape(shape) + 1) / 2
        return jnp.asarray(low) * (1 - share) + jnp.asarray(high) * share

    return Box(low=-1.0, high=1.0, shape=(math.prod(shape),)), native


def _bounds(space: Any) -> tuple[Any, Any] | None:
    """Bounds of each observed number where the space says them."""
    if isinstance(space, BoxSpace):
        return np.asarray(space.low), np.asarray(space.high)
    return (0.0, 1.0) if isinstance(space, DiscreteSpace) else None
