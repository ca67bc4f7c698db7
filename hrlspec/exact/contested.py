"""Contested choices: layouts where going to the nearest goal first costs steps later.

The tasks are two sub-tasks in sequence, ``achieve a; achieve b``. Where the nearest a leads to a longer way in all,
only an agent that looks ahead passes it by; in the mirrored controls the nearest a is the right one.

Axes: **L** layouts, **S** graph states, **N** tree nodes, **P** atomic propositions, **Q** cases of a suite.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import jax
import numpy as np

from hrlspec.exact.automaton import Automaton
from hrlspec.exact.solver import Graph, product, steps_table, tabulate
from hrlspec.spec.tree import TaskTree


class FirstVisits(NamedTuple):
    """What it takes to complete a task when its first edge is taken in a given state, each float32 ``[L, S]``.

    Attributes:
        steps: least steps until the first edge is taken there, inf where it cannot be.
        total: least steps until the task is satisfied after that, those before included.
    """

    steps: np.ndarray
    total: np.ndarray


class Contested(NamedTuple):
    """Which layouts tell a planning agent from one that takes the nearest goal first.

    Attributes:
        contested: bool ``[L]``, the nearest first goal costs at least the margin more in all than the best.
        control: bool ``[L]``, every other first goal costs at least the margin more than the nearest.
        right: bool ``[L, S]``, states where taking the first edge is a right choice: the total is the least.
        nearest: int ``[L]``, the state in which the first edge can be taken soonest.
        optimum: float32 ``[L]``, least steps to satisfaction.
    """

    contested: np.ndarray
    control: np.ndarray
    right: np.ndarray
    nearest: np.ndarray
    optimum: np.ndarray


class ContestedSuite(NamedTuple):
    """Cases to score an agent on, in equal numbers contested and controls.

    A choice is right when the first edge is taken in one of the states ``right``; a case without a first edge, or a
    task that is not satisfied in the end, counts as wrong. The score is the mean of the two rates.

    Attributes:
        layouts: a layout pytree with leading axis Q.
        tasks: a :class:`TaskTree` with leading axis Q.
        contested: bool ``[Q]``, false for controls.
        right: bool ``[Q, S]``; S are instances of the first goal where the environment is not finite.
        nearest: int ``[Q]``.
        optimum: float32 ``[Q]``, least steps to satisfaction, nan where they are not known.
    """

    layouts: Any
    tasks: TaskTree
    contested: np.ndarray
    right: np.ndarray
    nearest: np.ndarray
    optimum: np.ndarray


def can_contest(env: Any) -> bool:
    """Whether an environment has contested layouts to evaluate on."""
    return hasattr(env, "transition_table") or hasattr(env, "instance_at")


def two_step_task(first: int, second: int, num_propositions: int, num_nodes: int = 3) -> TaskTree:
    """``achieve first; achieve second``, padded to ``num_nodes`` (numpy leaves)."""
    if num_nodes < 3:
        raise ValueError(f"num_nodes is {num_nodes}, expected at least 3: a root and two sub-tasks")
    reach = np.zeros((num_nodes, num_propositions), bool)
    reach[1, first] = reach[2, second] = True
    index = np.arange(num_nodes)
    leaves: dict[str, Any] = {
        "parent": np.where((index == 1) | (index == 2), index - 1, TaskTree.NO_NODE).astype(np.int32),
        "reach": reach,
        "avoid": np.zeros_like(reach),
        "accepting": index == 2,
        "valid": index < 3,
        "depth": np.where(index < 3, index, 0).astype(np.int32),
    }
    return TaskTree(**leaves)


def first_visits(graph: Graph, tree: TaskTree) -> FirstVisits:
    """Breadth-first search until the first edge is taken, in every state where that can happen.

    Args:
        graph: L layouts.
        tree: one task (unbatched).
    """
    run = product(graph, tree)
    machine, remaining = run.automaton, steps_table(run)
    steps = np.full(run.shape, np.inf, np.float32)
    total = steps.copy()
    seen = np.zeros((*run.shape, machine.num_states), bool)
    layout, place = np.arange(graph.num_layouts), graph.start
    state = np.full(graph.num_layouts, machine.initial[0])
    time = 0
    while layout.size:
        time += 1
        place = graph.successors[layout, place].reshape(-1)
        layout, state = (np.repeat(each, graph.successors.shape[-1]) for each in (layout, state))
        width = machine.successor.shape[-1]
        symbol = run.symbol[layout, place]
        edge, state = (table[symbol, state].reshape(-1) for table in (machine.edge, machine.successor))
        layout, place = np.repeat(layout, width), np.repeat(place, width)
        taken = edge != TaskTree.NO_NODE
        at = layout[taken], place[taken]
        np.minimum.at(steps, at, np.float32(time))
        np.minimum.at(total, at, time + remaining[(*at, state[taken])])
        fresh = ~taken & (state != Automaton.VIOLATED) & ~seen[layout, place, state]
        seen[layout[fresh], place[fresh], state[fresh]] = True
        # Of several ways to the same place at the same time, one goes on.
        keys = np.ravel_multi_index((layout[fresh], place[fresh], state[fresh]), seen.shape)
        layout, place, state = np.unravel_index(np.unique(keys), seen.shape)
    return FirstVisits(steps, total)


def find_contested(graph: Graph, tree: TaskTree, *, margin: int = 2) -> Contested:
    """Says which layouts are contested, and which are controls, for one task.

    Layouts without a unique nearest first goal, or whose task cannot be satisfied, are neither.

    Args:
        graph: L layouts.
        tree: one task (unbatched), meant for those of two sub-tasks in sequence.
        margin: steps that the wrong choice must cost at least.
    """
    steps, total = first_visits(graph, tree)
    layouts, nearest = np.arange(graph.num_layouts), steps.argmin(-1)
    best, of_nearest = total.min(-1), total[layouts, nearest]
    usable = np.isfinite(best) & ((steps == steps.min(-1, keepdims=True)).sum(-1) == 1)
    others = total.copy()
    others[layouts, nearest] = np.inf
    # There must be another instance to choose, or a control would ask nothing.
    rival = np.where(np.isfinite(others).any(-1), others.min(-1), -np.inf)
    return Contested(
        contested=usable & (of_nearest >= np.where(usable, best, 0) + margin),
        control=usable & (rival >= np.where(usable, of_nearest, np.inf) + margin),
        right=np.isfinite(total) & (total == best[:, None]),
        nearest=nearest,
        optimum=best,
    )


def contested_suite(
    env: Any,
    key: jax.Array,
    *,
    num_cases: int,
    margin: int = 2,
    max_nodes: int = 3,
    params: Any = None,
    most_rounds: int = 200,
) -> ContestedSuite:
    """Draws layouts of an environment until there are enough contested ones and as many controls.

    Tasks go through all ordered pairs of different propositions in turn. Layouts are the environment's own; a case
    is kept for the reason above alone, so the suite is a random sample of such layouts.

    Args:
        env: an environment with ``transition_table``, or with ``instance_at``, ``contested_pairs`` and layouts that are
            contested by the way they are drawn.
        key: consumed.
        num_cases: Q, an even number.
        margin: see :func:`find_contested`.
        max_nodes: the tasks' N.
        params: the environment's parameters, the default ones if not given.
        most_rounds: draws of 512 layouts before giving up.

    Raises:
        ValueError: if Q is odd or not positive, or the environment hardly ever has such layouts.
    """
    if num_cases < 2 or num_cases % 2:
        raise ValueError(f"num_cases is {num_cases}, expected a positive even number: half of them are controls")
    params = env.default_params if params is None else params
    if not hasattr(env, "transition_table"):
        return _drawn_suite(env, key, num_cases, max_nodes, params)
    wanted = num_cases // 2
    kept: dict[bool, list[tuple[Any, ...]]] = {True: [], False: []}
    pairs = itertools.cycle(itertools.permutations(range(env.num_propositions), 2))
    for draw_key in jax.random.split(key, most_rounds):
        layouts = jax.tree.map(np.asarray, _sample_layouts(env, jax.random.split(draw_key, 512), params))
        graph = tabulate(env, layouts, params)
        for part in np.array_split(np.arange(512), 16):
            tree = two_step_task(*next(pairs), env.num_propositions, max_nodes)
            found = find_contested(graph[part], tree, margin=margin)
            for kind, flags in ((True, found.contested), (False, found.control)):
                for i in np.flatnonzero(flags)[:2]:
                    layout = jax.tree.map(lambda leaf, at=part[i]: leaf[at], layouts)
                    kept[kind].append((layout, tree, kind, found.right[i], found.nearest[i], found.optimum[i]))
        if min(len(kept[True]), len(kept[False])) >= wanted:
            cases = kept[True][:wanted] + kept[False][:wanted]
            layouts, tasks = (
                jax.tree.map(lambda *leaves: np.stack(leaves), *[case[i] for case in cases]) for i in (0, 1)
            )
            return ContestedSuite(layouts, tasks, *(np.stack([case[i] for case in cases]) for i in range(2, 6)))
    found_so_far = f"{len(kept[True])} contested and {len(kept[False])} control cases"
    raise ValueError(f"{env.name}: only {found_so_far} in {512 * most_rounds} layouts, {wanted} of each are wanted")


def _drawn_suite(env: Any, key: jax.Array, num_cases: int, max_nodes: int, params: Any) -> ContestedSuite:
    """Contested layouts and, with the same keys, their mirrored controls; instance 0 is the right one on both."""
    wanted = num_cases // 2
    pairs = itertools.islice(itertools.cycle(env.contested_pairs), wanted)
    trees = [two_step_task(first, second, env.num_propositions, max_nodes) for first, second in pairs]
    tasks: TaskTree = jax.tree.map(lambda *leaves: np.stack(leaves * 2), *trees)
    contested = np.arange(num_cases) < wanted
    keys = jax.random.split(key, wanted)[np.arange(num_cases) % wanted]
    layouts = _contested_layouts(env, keys, tasks.reach[:, 1], tasks.reach[:, 2], params, ~contested)
    return ContestedSuite(
        layouts=jax.tree.map(np.asarray, layouts),
        tasks=tasks,
        contested=contested,
        right=np.tile(np.array([True, False]), (num_cases, 1)),
        nearest=contested.astype(np.int64),
        optimum=np.full(num_cases, np.nan, np.float32),
    )


@functools.partial(jax.jit, static_argnums=0)
def _contested_layouts(env: Any, keys: Any, first: Any, second: Any, params: Any, mirrored: Any) -> Any:
    """One layout for each key."""
    return jax.vmap(env.contested_layout, (0, 0, 0, None, 0))(keys, first, second, params, mirrored)


@functools.partial(jax.jit, static_argnums=0)
def _sample_layouts(env: Any, keys: jax.Array, params: Any) -> Any:
    """One layout for each key."""
    return jax.vmap(env.sample_layout, (0, None))(keys, params)
