"""Recording episodes with compiled programs that are kept: one for the trees of all tasks, one for all automata.

Axes: **B** episodes.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np
from jaxtyping import Int32

from envs_jax import Environment
from envs_jax.arrays import Array
from envs_jax.base import Layout
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.api import TrainedAgent
from hrlspec.evaluation import Episodes, Record, record_episodes
from hrlspec.run.programs import Program
from hrlspec.spec import TaskTree
from hrlspec.spec.automata import Automata
from hrlspec.tasks.rewards import RewardMachine


def draw_layouts(env: Environment, seed: int, number: int, *, kept: bool) -> Layout:
    """Random layouts, numpy leaves with a leading axis.

    Args:
        env: the world.
        seed: of the layouts.
        number: how many.
        kept: whether the program is, from one process to the next; it must not be for code that others may change.
    """
    return jax.device_get(_layouts_program(env, number, kept)(np.int32(seed)))


def record(
    trained: TrainedAgent,
    seed: int,
    tasks: TaskTree | Automata,
    layouts: Layout,
    *,
    greedy: bool = False,
    shield: bool = False,
    kept: bool,
) -> tuple[Episodes, Record]:
    """Lets an agent carry out one task in each layout; see `record_episodes`.

    The compiler takes little effort: a program runs for much shorter than it takes to compile.

    Args:
        trained: the agent.
        seed: of the random numbers.
        tasks: one tree, with a leading axis 1, or one automaton. Each size compiles once, so they should be padded.
        layouts: B of them.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.
        kept: see `draw_layouts`.

    Returns:
        Numpy leaves.
    """
    inputs = (np.int32(seed), trained.params, trained.rewards, tasks, layouts)
    leaves, structure = jax.tree.flatten(inputs)
    program = _record_program(trained.agent, greedy, shield, kept, structure, *map(np.shape, leaves))
    episodes, found = jax.device_get(program(*inputs))
    return episodes, found


@functools.cache
def _layouts_program(env: Environment, number: int, kept: bool) -> Program:
    return Program("layouts", _layouts, env, number, effort="least", kept=kept)


@functools.lru_cache(maxsize=16)
def _record_program(agent: Agent, greedy: bool, shield: bool, kept: bool, *shapes: Any) -> Program:
    """A program for each of the ``shapes``."""
    del shapes
    return Program("record", _record, agent, greedy, shield, effort="least", kept=kept)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _layouts(env: Environment, number: int, seed: Int32[Array, ""]) -> Layout:
    keys = jax.random.split(jax.random.key(seed), number)
    return jax.vmap(env.sample_layout, (0, None))(keys, env.default_params)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _record(
    agent: Agent,
    greedy: bool,
    shield: bool,
    seed: Int32[Array, ""],
    params: Params,
    machine: RewardMachine,
    tasks: TaskTree | Automata,
    layouts: Layout,
) -> tuple[Episodes, Record]:
    key = jax.random.fold_in(jax.random.key(seed), 1)
    which = np.zeros(len(jax.tree.leaves(layouts)[0]), int)
    return record_episodes(key, agent, params, machine, tasks, layouts, which=which, greedy=greedy, shield=shield)
