"""Contested choices: layouts where going to the nearest goal first costs steps later.

The tasks are two sub-tasks in sequence, ``achieve a; achieve b``. Where the total path through the nearest a is longer
than another, only an agent that looks ahead chooses the other; in the controls the nearest a is optimal.

Axes: **L** layouts, **S** graph states, **P** atomic propositions, **Q** cases of a suite.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float32, Int, Key

from envs_jax import ContestedChoice, Environment, FiniteGraph
from envs_jax.arrays import Array
from envs_jax.base import Layout, State
from hrlspec.exact.automaton import Automaton
from hrlspec.exact.solver import Graph, product, steps_table, tabulate
from hrlspec.spec.tree import TaskTree

Contestable = FiniteGraph | ContestedChoice
"""Environments in which the optimal instance of the first goal is known; test with ``isinstance``."""


class FirstVisits(NamedTuple):
    """Steps to complete a task, by the state in which its first edge is taken, each float32 ``[L, S]``.

    Attributes:
        steps: least steps until the first edge is taken there, inf where it cannot be.
        total: least steps until the task is satisfied after that, those before included.
    """

    steps: Float32[np.ndarray, "L S"]
    total: Float32[np.ndarray, "L S"]


class Contested(NamedTuple):
    """Which layouts distinguish a planning agent from one that takes the nearest goal first.

    Attributes:
        contested: bool ``[L]``, the nearest first goal costs at least the margin more in all than the best.
        control: bool ``[L]``, every other first goal costs at least the margin more than the nearest.
        right: bool ``[L, S]``, states where taking the first edge is optimal: the total is the least.
        nearest: int ``[L]``, the state in which the first edge can be taken soonest.
        optimum: float32 ``[L]``, least steps to satisfaction.
    """

    contested: Bool[np.ndarray, " L"]
    control: Bool[np.ndarray, " L"]
    right: Bool[np.ndarray, "L S"]
    nearest: Int[np.ndarray, " L"]
    optimum: Float32[np.ndarray, " L"]


class ContestedSuite(NamedTuple):
    """Cases to score an agent on, half of them contested, half of them controls.

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

    layouts: Layout
    tasks: TaskTree
    contested: Bool[np.ndarray, " Q"]
    right: Bool[np.ndarray, "Q S"]
    nearest: Int[np.ndarray, " Q"]
    optimum: Float32[np.ndarray, " Q"]


def two_step_task(first: int, second: int, num_propositions: int) -> TaskTree:
    """``achieve first; achieve second`` (numpy leaves, N = 3)."""
    reach = np.zeros((3, num_propositions), bool)
    reach[1, first] = reach[2, second] = True
    leaves: dict[str, Any] = {
        "parent": np.array([TaskTree.NO_NODE, 0, 1], np.int32),
        "reach": reach,
        "avoid": np.zeros_like(reach),
        "accepting": np.array([False, False, True]),
        "valid": np.ones(3, bool),
        "depth": np.arange(3, dtype=np.int32),
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
        # Of several paths to the same place at the same time, one goes on.
        keys = np.ravel_multi_index((layout[fresh], place[fresh], state[fresh]), seen.shape)
        layout, place, state = np.unravel_index(np.unique(keys), seen.shape)
    return FirstVisits(steps, total)


def find_contested(graph: Graph, tree: TaskTree, *, margin: int = 2) -> Contested:
    """Classifies layouts as contested, control or neither, for one task.

    Layouts without a unique nearest first goal, or whose task cannot be satisfied, are neither.

    Args:
        graph: L layouts.
        tree: one task (unbatched), meant for those of two sub-tasks in sequence.
        margin: least number of additional steps that the wrong choice costs.
    """
    steps, total = first_visits(graph, tree)
    layouts, nearest = np.arange(graph.num_layouts), steps.argmin(-1)
    best, of_nearest = total.min(-1), total[layouts, nearest]
    usable = np.isfinite(best) & ((steps == steps.min(-1, keepdims=True)).sum(-1) == 1)
    others = total.copy()
    others[layouts, nearest] = np.inf
    # Without a second instance there is no choice, and a control would test nothing.
    rival = np.where(np.isfinite(others).any(-1), others.min(-1), -np.inf)
    return Contested(
        contested=usable & (of_nearest >= np.where(usable, best, 0) + margin),
        control=usable & (rival >= np.where(usable, of_nearest, np.inf) + margin),
        right=np.isfinite(total) & (total == best[:, None]),
        nearest=nearest,
        optimum=best,
    )


def contested_suite(
    key: Key[Array, ""], env: Environment, *, num_cases: int, margin: int = 2, most_rounds: int = 200
) -> ContestedSuite:
    """Contested layouts of an environment, and as many controls.

    Tasks go through all ordered pairs of different propositions in turn. The layouts are those of
    :meth:`envs_jax.Environment.sample_layout`, kept because they are contested, or controls, and for no other reason:
    the suite is a random sample of such layouts, and owes nothing to those that are made to be trained on.

    Args:
        key: consumed.
        env: a :class:`envs_jax.FiniteGraph` or :class:`envs_jax.ContestedChoice`.
        num_cases: Q, an even number.
        margin: see :func:`find_contested`.
        most_rounds: draws of 512 layouts before giving up.

    Raises:
        ValueError: if Q is odd or not positive, the environment is neither or has a single proposition, or it hardly
            ever has such layouts.
    """
    if num_cases < 2 or num_cases % 2:
        raise ValueError(f"num_cases is {num_cases}, expected a positive even number: half of them are controls")
    if env.num_propositions < 2:
        raise ValueError(f"{env.name} has one proposition, expected two at least: one to go to first and another then")
    if isinstance(env, FiniteGraph):
        return _found_suite(key, env, num_cases // 2, margin, most_rounds)
    if isinstance(env, ContestedChoice):
        return _measured_suite(key, env, num_cases // 2, most_rounds)
    raise _not_contestable(env)


def chosen_instances(env: Environment, states: State, first: Bool[np.ndarray, "Q P"]) -> Int[np.ndarray, " Q"]:
    """Where first goals were reached, as indices into the columns of ``ContestedSuite.right``, int ``[Q]``.

    Args:
        env: the suite's environment.
        states: in which the first edges were taken, leading axis Q.
        first: one-hot bool ``[Q, P]``, what the first edges reach.

    Raises:
        ValueError: if the environment has no contested choice.
    """
    if isinstance(env, FiniteGraph):
        return np.asarray(jax.vmap(env.graph_state)(states))
    if isinstance(env, ContestedChoice):
        return np.asarray(jax.vmap(env.instance_at)(states, jnp.asarray(first)))
    raise _not_contestable(env)


def _not_contestable(env: Environment) -> ValueError:
    return ValueError(f"{env.name} has no exact solver and no contested layouts, so contested choice is not known")


def _found_suite(key: Key[Array, ""], env: FiniteGraph, wanted: int, margin: int, most_rounds: int) -> ContestedSuite:
    """Random layouts until ``wanted`` of them are contested and as many are controls."""
    kept: dict[bool, list[tuple[Any, ...]]] = {True: [], False: []}
    pairs = itertools.cycle(itertools.permutations(range(env.num_propositions), 2))
    for draw_key in jax.random.split(key, most_rounds):
        layouts = jax.tree.map(np.asarray, _sample_layouts(env, jax.random.split(draw_key, 512)))
        graph = tabulate(env, layouts)
        for part in np.array_split(np.arange(512), 16):
            tree = two_step_task(*next(pairs), env.num_propositions)
            found = find_contested(graph[part], tree, margin=margin)
            for kind, flags in ((True, found.contested), (False, found.control)):
                for i in np.flatnonzero(flags)[:2]:
                    layout = jax.tree.map(lambda leaf, at=part[i]: leaf[at], layouts)
                    kept[kind].append((layout, tree, kind, found.right[i], found.nearest[i], found.optimum[i]))
        if min(len(kept[True]), len(kept[False])) >= wanted:
            return _suite_of(kept, wanted)
    raise _too_few(env, kept, most_rounds, wanted)


def _measured_suite(key: Key[Array, ""], env: ContestedChoice, wanted: int, most_rounds: int) -> ContestedSuite:
    """Random layouts until in ``wanted`` the way over the nearest instance is longer, and in as many shorter."""
    pairs = np.array(env.contested_pairs)
    eye = np.eye(env.num_propositions, dtype=bool)
    kept: dict[bool, list[tuple[Any, ...]]] = {True: [], False: []}
    for number, draw_key in enumerate(jax.random.split(key, most_rounds)):
        layouts = _sample_layouts(env, jax.random.split(draw_key, 512))
        first, second = pairs[(512 * number + np.arange(512)) % len(pairs)].T
        near, whole = map(np.asarray, _ways(env, layouts, eye[first], eye[second]))
        nearest, rows = near.argmin(-1), np.arange(512)
        over_nearest = whole[rows, nearest]
        others = np.where(nearest[:, None] == np.arange(near.shape[1]), np.inf, whole).min(-1)
        flags = {
            True: over_nearest >= others + env.least_detour,
            False: np.isfinite(others) & (others >= over_nearest + env.least_detour),
        }
        for kind, found in flags.items():
            for i in np.flatnonzero(found & np.isfinite(over_nearest)):
                layout = jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], layouts)
                tree = two_step_task(int(first[i]), int(second[i]), env.num_propositions)
                right = whole[i] == whole[i].min()
                kept[kind].append((layout, tree, kind, right, nearest[i], np.float32(np.nan)))
        if min(len(kept[True]), len(kept[False])) >= wanted:
            return _suite_of(kept, wanted)
    raise _too_few(env, kept, most_rounds, wanted)


def _suite_of(kept: dict[bool, list[tuple[Any, ...]]], wanted: int) -> ContestedSuite:
    """So many contested cases, and as many controls."""
    cases = kept[True][:wanted] + kept[False][:wanted]
    layouts, tasks = (jax.tree.map(lambda *leaves: np.stack(leaves), *[case[i] for case in cases]) for i in (0, 1))
    return ContestedSuite(layouts, tasks, *(np.stack([case[i] for case in cases]) for i in range(2, 6)))


def _too_few(env: Environment, kept: dict[bool, list[tuple[Any, ...]]], rounds: int, wanted: int) -> ValueError:
    found = f"{len(kept[True])} contested and {len(kept[False])} control cases"
    return ValueError(f"{env.name}: only {found} in {512 * rounds} layouts, {wanted} of each are wanted")


@functools.partial(jax.jit, static_argnums=0)
def _ways(
    env: ContestedChoice, layouts: Layout, first: Bool[Array, "Q P"], second: Bool[Array, "Q P"]
) -> tuple[Float32[Array, "Q I"], Float32[Array, "Q I"]]:
    """`ContestedChoice.ways` in each layout."""
    return jax.vmap(env.ways)(layouts, first, second)


@functools.partial(jax.jit, static_argnums=0)
def _sample_layouts(env: Environment, keys: Key[Array, " L"]) -> Layout:
    """One layout for each key."""
    return jax.vmap(env.sample_layout, (0, None))(keys, env.default_params)
