"""Gymnasium environments whose task is text: SPECTRL, or a formula in LTL.

``env = hrlspec.gymnasium.make("letter"); env.reset(seed=0, options={"task": "achieve a; achieve b"})``;
``env = hrlspec.gymnasium.make("letter", language="ltl", task="F (a & F b)")``.

Importing this module makes every preset known to ``gymnasium.make`` and ``gymnasium.make_vec`` by an id such as
``hrlspec/letter-v0``; ``gymnasium.make("hrlspec.gymnasium:hrlspec/letter-v0")`` imports it by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import envs_jax
from envs_jax import Environment
from envs_jax.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from hrlspec.spec.automata import MAX_PROPOSITIONS
from hrlspec.tasks.ltl_tasks import LtlTasks
from hrlspec.tasks.text_tasks import TextTasks

Language = Literal["spectrl", "ltl", "ltl forever"]


def make(
    env: str | Environment,
    *,
    task: str | None = None,
    language: Language = "spectrl",
    max_nodes: int = 64,
    render_mode: None = None,
    **overrides: Any,
) -> GymnasiumEnv:
    """One environment.

    Args:
        env: an environment, or a name that `envs_jax.make` knows.
        task: the task until ``reset(options={"task": ...})`` gives another.
        language: what tasks are written in: ``"spectrl"``, ``"ltl"`` (to be satisfied by the end of the episode) or
            ``"ltl forever"`` (a reward for each round).
        max_nodes: the largest task tree that can be given, or the most states of an automaton.
        render_mode: none but ``None``, which makers of environments pass.
        **overrides: sizes that differ from the preset's, for example ``size=9``.

    Raises:
        ValueError: if the environment or a size is unknown, or the task cannot be read.
        TypeError: if it is to be rendered.
    """
    world = _world(env, render_mode, overrides)
    return GymnasiumEnv(world, _tasks(world, language, max_nodes), task=task)


def make_vec(
    env: str | Environment,
    num_envs: int,
    *,
    task: str | Sequence[str] | None = None,
    language: Language = "spectrl",
    max_nodes: int = 64,
    render_mode: None = None,
    **overrides: Any,
) -> GymnasiumVectorEnv:
    """Many environments side by side; a task for all of them or one for each, see :func:`make`."""
    world = _world(env, render_mode, overrides)
    return GymnasiumVectorEnv(world, num_envs, _tasks(world, language, max_nodes), task=task)


def register(namespace: str = "hrlspec") -> tuple[str, ...]:
    """Makes every preset known to ``gymnasium.make`` and ``gymnasium.make_vec``, under another namespace if wanted.

    Returns:
        The ids, such as ``hrlspec/letter-v0``.
    """
    import gymnasium  # after the adapter, which says which extra it belongs to

    ids = []
    for name in envs_jax.registered():
        ids.append(f"{namespace}/{name}-v0")
        if ids[-1] not in gymnasium.registry:
            gymnasium.register(
                id=ids[-1],
                entry_point="hrlspec.gymnasium:make",
                vector_entry_point="hrlspec.gymnasium:make_vec",
                kwargs={"env": name},
            )
    return tuple(ids)


def _tasks(world: Environment, language: Language, max_nodes: int) -> TextTasks | LtlTasks:
    if language not in get_args(Language):
        raise ValueError(f"unknown language {language!r}, expected one of: {', '.join(get_args(Language))}")
    if language == "spectrl":
        return TextTasks(world.propositions, max_nodes)
    if world.num_propositions > MAX_PROPOSITIONS:
        found = f"{world.name} has {world.num_propositions} propositions"
        raise ValueError(f"{found}, formulas in LTL take {MAX_PROPOSITIONS} at most")
    return LtlTasks(world.propositions, world.possible_labels, language == "ltl forever", max_nodes)


def _world(env: str | Environment, render_mode: None, overrides: dict[str, Any]) -> Environment:
    if render_mode is not None:  # a TypeError tells Stable-Baselines3 to try without
        raise TypeError(f"found render_mode {render_mode!r}, expected None: these environments have no render modes")
    if isinstance(env, str):
        return envs_jax.make(env, **overrides)
    if overrides:
        raise ValueError(f"found sizes ({', '.join(overrides)}) for an environment that is made already")
    return env


register()
