"""Optimal steps of a task and those of the nearest-first agent, from the graph or grid of an environment.

Axes: **L** layouts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float32

from envs_jax import Environment, FiniteGraph, GridMap
from envs_jax.base import Layout
from hrlspec.exact.reference_agents import myopic_steps
from hrlspec.exact.shortest_path import planned_steps
from hrlspec.exact.solver import optimal_steps, tabulate
from hrlspec.spec.tree import TaskTree


class Steps(NamedTuple):
    """Steps to satisfaction of a task under the committed semantics, each float32 ``[L]``.

    Attributes:
        optimum: the least; inf where the task cannot be satisfied.
        myopic: of the agent that always goes to the nearest goal; inf where it fails.
    """

    optimum: Float32[np.ndarray, " L"]
    myopic: Float32[np.ndarray, " L"]


def step_solver(env: Environment, layouts: Layout) -> Callable[[slice, TaskTree], Steps] | None:
    """A function of a slice of the layouts and a task; ``None`` for environments without graph or grid.

    Exact where the environment is a finite graph, within a step for each sub-task where it has a grid.

    Args:
        env: the environment.
        layouts: a layout pytree, numpy leaves with leading axis L.
    """
    if isinstance(env, FiniteGraph):
        graph = tabulate(env, layouts)
        return lambda rows, tree: Steps(optimal_steps(graph[rows], tree), myopic_steps(graph[rows], tree))
    if isinstance(env, GridMap):
        return lambda rows, tree: Steps(*planned_steps(env, jax.tree.map(lambda x: x[rows], layouts), tree))
    return None
