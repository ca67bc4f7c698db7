"""Shortest paths in planar environments whose actions lead anywhere within a small square, by search on a grid.

They are the optima of continuous environments, as :mod:`hrlspec.exact.solver` has those of finite ones. The grid is
that of a :class:`envs_jax.GridMap`: the places that whole steps lead to, from each to its eight neighbours or nowhere.
On it a path takes max(|Δx|, |Δy|) steps, as in the environment itself, so every path found is one the environment
allows, and the excess is less than a step for each sub-task: goals are entered at a place of the grid.

Axes: **L** layouts, **X**, **Y** places, **P** atomic propositions, **K** label sets, **M** automaton states.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import numpy as np
from jaxtyping import Bool, Float32, Int

from envs_jax import GridMap
from envs_jax.base import Layout
from hrlspec.exact.automaton import Automaton, automaton
from hrlspec.spec.tree import TaskTree, subtask_avoid


@dataclasses.dataclass(frozen=True)
class Grid:
    """Places in the plane, one grid for each layout; a step leads to one of the eight neighbours or nowhere.

    Attributes:
        symbols: bool ``[K, P]``, the label sets that occur, each once.
        symbol: int ``[L, X, Y]``, the label set of each place, a row of ``symbols``.
        inside: bool ``[L, X, Y]``, the places that may be entered.
        start: int ``[L, 2]``, where episodes begin (labels of the start count only when it is entered again).
    """

    symbols: Bool[np.ndarray, "K P"]
    symbol: Int[np.ndarray, "L X Y"]
    inside: Bool[np.ndarray, "L X Y"]
    start: Int[np.ndarray, "L 2"]

    @property
    def num_layouts(self) -> int:
        """L."""
        return len(self.start)

    def __getitem__(self, rows: slice | Int[np.ndarray, " _"] | Bool[np.ndarray, " L"]) -> Grid:
        """Some of the layouts."""
        return Grid(self.symbols, self.symbol[rows], self.inside[rows], self.start[rows])


def grid_of(env: GridMap, layouts: Layout) -> Grid:
    """The grids of layouts (a layout pytree with a leading axis L)."""
    number = len(jax.tree.leaves(layouts)[0])
    found = [env.grid(jax.tree.map(lambda x, i=i: np.asarray(x[i]), layouts)) for i in range(number)]
    labels, inside, start = (np.stack(part) for part in zip(*found, strict=True))
    flat = labels.reshape(-1, labels.shape[-1])
    _, first, symbol = np.unique(flat @ (1 << np.arange(flat.shape[1])), return_index=True, return_inverse=True)
    return Grid(flat[first], symbol.reshape(labels.shape[:-1]), inside, start)


def planned_steps(
    env: GridMap, layouts: Layout, tree: TaskTree
) -> tuple[Float32[np.ndarray, " L"], Float32[np.ndarray, " L"]]:
    """:func:`shortest_steps` and :func:`nearest_first_steps` of a task; equal layouts are solved once.

    Args:
        env: the environment.
        layouts: a layout pytree with a leading axis L.
        tree: one task (unbatched).

    Returns:
        Two float32 ``[L]``.
    """
    kept, which = distinct(layouts)
    grid = grid_of(env, kept)
    return shortest_steps(grid, tree)[which], nearest_first_steps(grid, tree)[which]


def distinct(layouts: Layout) -> tuple[Layout, Int[np.ndarray, " L"]]:
    """Each layout once (a layout pytree with a leading axis), and which of these each of the L is, int ``[L]``."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(layouts)]
    first: dict[bytes, int] = {}
    alike = [first.setdefault(b"".join(leaf[i].tobytes() for leaf in leaves), i) for i in range(len(leaves[0]))]
    kept, which = np.unique(alike, return_inverse=True)
    return jax.tree.map(lambda x: np.asarray(x)[kept], layouts), which


def shortest_steps(grid: Grid, tree: TaskTree) -> Float32[np.ndarray, " L"]:
    """The least number of steps that satisfies a task under the committed semantics, inf where none does.

    Where several edges are met at once the agent may have assigned any of them, so the least counts.

    Args:
        grid: L layouts.
        tree: one task (unbatched).

    Returns:
        float32 ``[L]``.
    """
    return _from_start(grid, tree, slice(1))[:, 0]


def branch_steps(grid: Grid, tree: TaskTree) -> Float32[np.ndarray, "L C"]:
    """The same for each branch: only the first edge to that child of the root may be taken.

    Args:
        grid: L layouts.
        tree: one task (unbatched).

    Returns:
        float32 ``[L, C]``, in the order of :func:`hrlspec.exact.solver.root_children`. The minimum over branches is the
        optimum.
    """
    return _from_start(grid, tree, slice(1, None))


def _from_start(grid: Grid, tree: TaskTree, which: slice) -> Float32[np.ndarray, "L _"]:
    """Least steps from the start for some of the automaton's initial states."""
    machine = automaton(tree, grid.symbols)
    states = machine.initial[which].tolist()
    tables = _steps_tables(grid, machine, states)
    return np.stack([tables[state][(np.arange(grid.num_layouts), *grid.start.T)] for state in states], -1)


def nearest_first_steps(grid: Grid, tree: TaskTree) -> Float32[np.ndarray, " L"]:
    """Steps of an agent that always goes to the nearest goal among the open sub-tasks, by a shortest path.

    Paths keep clear of what the sub-task avoids (eq. 2). Ties go to the sub-task of the lowest node, then to the
    neighbour of the lowest index. The agent fails where it can reach no goal.

    Args:
        grid: L layouts.
        tree: one task (unbatched).

    Returns:
        float32 ``[L]``, inf where the task is not satisfied.
    """
    machine = automaton(tree, grid.symbols)
    return np.array([_nearest_first(grid[i : i + 1], tree, machine) for i in range(grid.num_layouts)], np.float32)


def _nearest_first(one: Grid, tree: TaskTree, machine: Automaton) -> float:
    """:func:`nearest_first_steps` in a single layout."""
    reach, avoid = np.asarray(tree.reach), np.asarray(subtask_avoid(tree))
    distances: dict[int, np.ndarray] = {}

    def distance(node: int) -> np.ndarray:
        """Further steps to a sub-task's goal after entering a place, float32 ``[X, Y]``: 0 at goals."""
        if node not in distances:
            harmed = (avoid[node] & one.symbols).any(-1)
            goal = (~reach[node] | one.symbols).all(-1) & ~harmed
            ends = np.where(goal[one.symbol], np.float32(0), np.float32(np.inf))
            closed = (goal | harmed)[one.symbol] | ~one.inside
            onward = _path_lengths(np.where(one.inside, ends, np.inf), closed)
            distances[node] = np.where(closed, ends, onward)[0]
        return distances[node]

    place, state, steps = (int(one.start[0, 0]), int(one.start[0, 1])), int(machine.initial[0]), 0
    while state != Automaton.SATISFIED:
        # Each turn is one step nearer to a goal, and there are finitely many goals on a path down the tree.
        nodes = np.flatnonzero(machine.open_edges[state]).tolist()
        around = list(_neighbours(one, place))
        ahead = np.array([[distance(node)[there] for there in around] for node in nodes]).reshape(len(nodes), -1)
        if not np.isfinite(ahead).any():
            return np.inf
        pursued, move = np.unravel_index(ahead.argmin(), ahead.shape)
        place, steps = around[move], steps + 1
        symbol = one.symbol[0][place]
        choice = (machine.edge[symbol, state] == nodes[pursued]).argmax()
        state = int(machine.successor[symbol, state, choice])
    return float(steps)


def _steps_tables(grid: Grid, machine: Automaton, starts: list[int]) -> dict[int, Float32[np.ndarray, "L X Y"]]:
    """Least further steps to satisfaction from each place, float32 ``[L, X, Y]``, by running automaton state.

    Those states that are reachable from ``starts``. The automaton never returns to a state that it left, so states are
    solved in reverse topological order: the steps after leaving a state are known, and within the state only distance
    matters.
    """
    tables: dict[int, np.ndarray] = {}
    shape = grid.symbol.shape
    ends = {
        Automaton.SATISFIED: np.zeros(shape, np.float32),
        Automaton.VIOLATED: np.full(shape, np.inf, np.float32),
    }
    for state in _successors_first(machine, starts):
        leaving = np.full(shape, np.inf, np.float32)
        left = ~grid.inside
        for symbol, successors in enumerate(machine.successor[:, state]):
            if (successors == state).all():
                continue
            here = (grid.symbol == symbol) & grid.inside
            left = left | here
            for after in np.unique(successors):
                following = ends[after] if after in ends else tables[int(after)]
                leaving[here] = np.minimum(leaving[here], following[here])
        tables[state] = _path_lengths(leaving, left)
    return tables


def _successors_first(machine: Automaton, starts: list[int]) -> Iterator[int]:
    """The running states reachable from some, in reverse topological order."""
    seen: set[int] = {Automaton.SATISFIED, Automaton.VIOLATED}

    def visit(state: int) -> Iterator[int]:
        seen.add(state)
        for after in np.unique(machine.successor[:, state]).tolist():
            if after not in seen:
                yield from visit(after)
        yield state

    for start in starts:
        if start not in seen:
            yield from visit(start)


def _path_lengths(
    ends: Float32[np.ndarray, "L X Y"], closed: Bool[np.ndarray, "L X Y"]
) -> Float32[np.ndarray, "L X Y"]:
    """Steps from each place to the nearest end, float32 ``[L, X, Y]``: at least 1, inf where there is no path.

    Args:
        ends: float32 ``[L, X, Y]``, further steps counted on entering an end; used where ``closed``.
        closed: bool ``[L, X, Y]``, places at which a path ends, at the cost above; inf forbids them.
    """
    # A rim keeps rows apart, so that neighbours are the same array shifted, and closed places by bounds that are equal.
    rim = ((0, 0), (1, 1), (1, 1))
    least = np.pad(np.where(closed, ends, -np.inf), rim, constant_values=np.inf)
    row = least.shape[-1]
    shape, least = least.shape, least.reshape(-1)
    most = np.pad(np.where(closed, ends, np.inf), rim, constant_values=np.inf).reshape(-1)
    entered, across, steps = most.copy(), np.full_like(most, np.inf), np.full_like(most, np.inf)
    while True:
        before = steps.copy()
        for _ in range(8):  # The test for a fixed point costs as much as a round or two.
            np.minimum(entered[:-2], entered[2:], out=across[1:-1])
            np.minimum(across, entered, out=across)
            np.minimum(across[: -2 * row], across[2 * row :], out=steps[row:-row])
            np.minimum(steps[row:-row], across[row:-row], out=steps[row:-row])
            steps += 1
            np.maximum(steps, least, out=entered)
            np.minimum(entered, most, out=entered)
        if np.array_equal(before, steps):
            return steps.reshape(shape)[:, 1:-1, 1:-1]


def _neighbours(one: Grid, place: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """The places that one step leads to, the place itself included."""
    width, height = one.inside.shape[1:]
    for x in range(max(place[0] - 1, 0), min(place[0] + 2, width)):
        for y in range(max(place[1] - 1, 0), min(place[1] + 2, height)):
            if one.inside[0, x, y]:
                yield x, y
