"""Cases of an evaluation: tasks in layouts, with their optima.

Everything here is computed once and used for any number of agents.

Axes: **M** tasks, **B** cases, **N** tree nodes.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Float32, Int, Key, UInt32

from envs_jax import Environment, FiniteGraph
from envs_jax.arrays import Array
from envs_jax.base import Layout
from hrlspec.evaluation.suite import Suite
from hrlspec.exact.reference_agents import branch_scores
from hrlspec.exact.solver import tabulate
from hrlspec.exact.steps import Steps, step_solver
from hrlspec.spec import TaskTree
from hrlspec.tasks.rewards import RewardMachine

LAYOUTS_PER_TASK = 10
MOST_ROUNDS = 20
"""Draws of ``layouts_per_task`` layouts for a task before it is taken to be impossible (or nearly)."""

BLOCK = 512
"""Layouts drawn at a time, so that one compiled program serves all suites."""


@dataclasses.dataclass(frozen=True)
class Cases:
    """B episodes to run: a task in a layout each.

    Attributes:
        suite: the tasks.
        task: int ``[B]``, rows of the suite.
        layouts: a layout pytree, numpy leaves with leading axis B.
        optimum: float32 ``[B]``, least steps to satisfaction (committed semantics): exact in finite environments,
            within a step for each sub-task in those with a grid; ``None`` elsewhere.
        myopic: float32 ``[B]``, steps of the agent that always goes to the nearest goal, inf where it fails, or
            ``None`` likewise.
        excluded: pairs of task and layout that were drawn and left out because nothing satisfies the task within
            the horizon.
    """

    suite: Suite
    task: Int[np.ndarray, " B"]
    layouts: Layout
    optimum: Float32[np.ndarray, " B"] | None
    myopic: Float32[np.ndarray, " B"] | None
    excluded: int

    def __len__(self) -> int:
        """B."""
        return len(self.task)

    @property
    def trees(self) -> TaskTree:
        """The task of each case, leading axis B."""
        trees: TaskTree = jax.tree.map(lambda x: x[self.task], self.suite.trees)
        return trees


@dataclasses.dataclass(frozen=True)
class BranchCases:
    """B cases under a reward set in which the choice of the first edge matters.

    Attributes:
        suite: the tasks.
        task: int ``[B]``, rows of the suite.
        layouts: a layout pytree, numpy leaves with leading axis B.
        optimum: float32 ``[B]``, the largest undiscounted return within the horizon.
        random: float32 ``[B]``, expected return of an agent that draws its first edge uniformly and is optimal from
            then on.
        longest: float32 ``[B]``, return of one that takes the longest branch and is optimal from then on.
        excluded: pairs of task and layout that were drawn and left out because the branches' optima differ too little.
    """

    suite: Suite
    task: Int[np.ndarray, " B"]
    layouts: Layout
    optimum: Float32[np.ndarray, " B"]
    random: Float32[np.ndarray, " B"]
    longest: Float32[np.ndarray, " B"]
    excluded: int

    def __len__(self) -> int:
        """B."""
        return len(self.task)

    @property
    def trees(self) -> TaskTree:
        """The task of each case, leading axis B."""
        trees: TaskTree = jax.tree.map(lambda x: x[self.task], self.suite.trees)
        return trees


def make_cases(
    env: Environment, suite: Suite, *, layouts_per_task: int = LAYOUTS_PER_TASK, seed: int = 0, optima: bool = True
) -> Cases:
    """Draws layouts for each task of a suite and solves them.

    A task's layouts depend on the task and the seed alone, not on the rest of the suite. Layouts in which the solver
    finds the task unsatisfiable within the horizon are left out, counted and drawn again, so every task has the same
    number of cases.

    Args:
        env: the environment.
        suite: the tasks.
        layouts_per_task: cases of each task.
        seed: of the layouts.
        optima: whether to solve at all; without it no layout is left out.

    Raises:
        ValueError: if a task cannot be satisfied in (nearly) any layout.
    """
    kept: list[list[tuple[Layout, float, float]]] = [[] for _ in range(len(suite))]
    excluded, solved = 0, False
    for draw in range(MOST_ROUNDS):
        wanting = [row for row in range(len(suite)) if len(kept[row]) < layouts_per_task]
        if not wanting:
            break
        pool = draw_layouts(env, suite, layouts_per_task, seed=seed, draw=draw)
        solve = step_solver(env, pool) if optima else None
        solved = solve is not None
        for row in wanting:
            rows = slice(row * layouts_per_task, (row + 1) * layouts_per_task)
            zeros = np.zeros(layouts_per_task, np.float32)
            steps = Steps(zeros, zeros) if solve is None else solve(rows, task_of(suite, row))
            possible = np.flatnonzero(steps.optimum <= env.horizon)
            excluded += layouts_per_task - len(possible)
            for i in possible[: layouts_per_task - len(kept[row])]:
                layout = jax.tree.map(lambda x, at=rows.start + i: x[at], pool)
                kept[row].append((layout, steps.optimum[i], steps.myopic[i]))
    for row, found in enumerate(kept):
        if len(found) < layouts_per_task:
            raise ValueError(
                f"task {suite.formulas[row]!r} can be satisfied within {env.horizon} steps in only {len(found)} of "
                f"{layouts_per_task * MOST_ROUNDS} layouts of {env.name}, expected at least {layouts_per_task}"
            )
    layouts, optimum, myopic = zip(*[case for found in kept for case in found], strict=True)
    return Cases(
        suite=suite,
        task=np.repeat(np.arange(len(suite)), layouts_per_task),
        layouts=jax.tree.map(lambda *leaves: np.stack(leaves), *layouts),
        optimum=np.array(optimum, np.float32) if solved else None,
        myopic=np.array(myopic, np.float32) if solved else None,
        excluded=excluded,
    )


def make_branch_cases(
    env: Environment,
    suite: Suite,
    machine: RewardMachine,
    *,
    layouts_per_task: int = LAYOUTS_PER_TASK,
    seed: int = 0,
    least_difference: float = 0.3,
) -> BranchCases:
    """Draws layouts and keeps those in which the branches' optimal returns differ.

    Unlike :func:`make_cases` it draws no others: the share of layouts in which the branch matters is a property of the
    task.

    Args:
        env: a :class:`envs_jax.FiniteGraph`.
        suite: the tasks.
        machine: the rewards.
        layouts_per_task: layouts drawn for each task.
        seed: of the layouts.
        least_difference: see :func:`hrlspec.exact.reference_agents.branch_scores`.

    Raises:
        ValueError: if the environment has no exact solver or no case is left.
    """
    if not isinstance(env, FiniteGraph):
        raise ValueError(f"{env.name} has no exact solver, so return over optimum is not known")
    pool = draw_layouts(env, suite, layouts_per_task, seed=seed)
    graph = tabulate(env, pool)
    parts = [
        branch_scores(
            graph[row * layouts_per_task : (row + 1) * layouts_per_task],
            task_of(suite, row),
            machine,
            env.horizon,
            least_difference=least_difference,
        )
        for row in range(len(suite))
    ]
    optimal, random, longest, matters = (np.concatenate(column) for column in zip(*parts, strict=True))
    if not matters.any():
        raise ValueError(f"{suite.name}: the branch matters in none of {len(matters)} cases")
    return BranchCases(
        suite=suite,
        task=np.repeat(np.arange(len(suite)), layouts_per_task)[matters],
        layouts=jax.tree.map(lambda x: x[matters], pool),
        optimum=optimal[matters],
        random=random[matters],
        longest=longest[matters],
        excluded=int((~matters).sum()),
    )


def task_of(suite: Suite, row: int) -> TaskTree:
    """One task of a suite, unbatched."""
    tree: TaskTree = jax.tree.map(lambda x: x[row], suite.trees)
    return tree


def draw_layouts(env: Environment, suite: Suite, layouts_per_task: int, *, seed: int = 0, draw: int = 0) -> Layout:
    """Layouts for each task in turn, numpy leaves with leading axis M · ``layouts_per_task``."""
    count = np.arange(draw * layouts_per_task, (draw + 1) * layouts_per_task, dtype=np.uint32)
    hashes, counts = np.repeat(suite.hashes, layouts_per_task), np.tile(count, len(suite))
    key, parts = jax.random.key(seed), []
    for first in range(0, len(hashes), BLOCK):
        rows = np.arange(first, first + BLOCK) % len(hashes)  # The last block is filled up by wrapping around.
        parts.append(jax.tree.map(np.asarray, _layouts(env, key, hashes[rows], counts[rows])))
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(hashes)], *parts)


@functools.partial(jax.jit, static_argnums=0)
def _layouts(
    env: Environment, key: Key[Array, ""], hashes: UInt32[Array, " block"], counts: UInt32[Array, " block"]
) -> Layout:
    """A layout for each pair of a task's hash and a number, leading axis ``BLOCK``."""

    def one(task: UInt32[Array, ""], number: UInt32[Array, ""]) -> Layout:
        return env.sample_layout(jax.random.fold_in(jax.random.fold_in(key, task), number), env.default_params)

    return jax.vmap(one)(hashes, counts)
