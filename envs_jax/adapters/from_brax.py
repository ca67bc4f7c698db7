"""Environments written for brax, and others with its interface, for agents of this library. Imports no brax."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from envs_jax.adapters.foreign import Foreign, Labelling, Source, View, adopt
from envs_jax.base import Box


@runtime_checkable
class BraxLike(Protocol):
    """What is used of a brax environment. States have ``obs``, ``done`` and ``info``."""

    @property
    def action_size(self) -> int:
        """Numbers in an action, each in [-1, 1]."""

    def reset(self, rng: jax.Array) -> Any:
        """The first state."""

    def step(self, state: Any, action: jax.Array) -> Any:
        """The next state."""


def from_brax(
    env: BraxLike,
    labels: Labelling,
    *,
    horizon: int,
    propositions: Sequence[str] | None = None,
    terminates: bool = True,
    view: View | None = None,
    name: str | None = None,
) -> Foreign:
    """A brax environment with labels, as an `Environment`.

    A layout is the environment's own first state with its observation. Its rewards are not used. Actions are float32
    ``[A]`` in [-1, 1], as brax has them, and clipped to it.

    Args:
        env: a brax environment, as ``brax.envs.get_environment`` makes it, or one with its interface. Wrappers may be
            around it, but none that batches it or resets it by itself (``brax.envs.create`` adds one: give it
            ``auto_reset=False``).
        labels: the propositions that hold in a state of ``env``: a dictionary of bool ``[]``, or an array bool ``[P]``.
            Physics are in its field ``pipeline_state``.
        horizon: steps after which an episode is truncated.
        propositions: the names of an array's entries, or the order of a dictionary's (alphabetical if left out).
        terminates: whether an episode that ``env`` ends (``done``) is over, and a failure unless the task is done.
        view: splits an observation of ``env`` (float32) into float32 ``[P, ...]``, what belongs to each proposition,
            and float32 ``[F0]``, the rest. If left out nothing belongs to any, and numbers are as brax gives them,
            since it knows no bounds: where they are far from 1, scale them here.
        name: the world's name, that of ``env``'s class if left out.

    Raises:
        ValueError: if ``env`` is no such environment, the labels or the view have a wrong form, or tasks cannot use the
            names.
    """
    where = f"from_brax({type(env).__name__})"
    if not isinstance(env, BraxLike):
        raise ValueError(f"{where}: expected an environment with reset, step and action_size")

    def reset(key: jax.Array, params: Any) -> tuple[Any, Any]:
        del params
        state = env.reset(key)
        if "first_obs" in state.info:
            raise ValueError(
                f"{where}: it resets itself (AutoResetWrapper), so that the last state of an episode is never seen; "
                "give the environment within"
            )
        if jnp.ndim(state.done):
            raise ValueError(
                f"{where}: done has shape {list(state.done.shape)}, expected []; give the environment within, without "
                "wrappers that batch it"
            )
        return state.obs, state

    def step(key: jax.Array, state: Any, action: jax.Array, params: Any) -> tuple[Any, ...]:
        del key, params
        state = env.step(state, jnp.clip(action, -1.0, 1.0))
        # EpisodeWrapper has a time limit and tells it apart.
        timed_out = jnp.asarray(state.info.get("truncation", 0)) > 0
        return state.obs, state, (state.done > 0) & ~timed_out, timed_out

    source = Source(
        name=where,
        params=(),
        action_space=Box(low=-1.0, high=1.0, shape=(env.action_size,)),
        reset=reset,
        step=step,
    )
    return adopt(
        source,
        labels,
        propositions=propositions,
        horizon=horizon,
        terminates=terminates,
        view=view,
        name=type(env).__name__ if name is None else name,
    )
