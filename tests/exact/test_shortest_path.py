"""Shortest paths on the map against the exact solver, hand-computed lengths, and the world itself."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax.walk.world import WalkLayout
from hrlspec.exact import solver
from hrlspec.exact.automaton import Automaton, automaton
from hrlspec.exact.reference_agents import myopic_steps
from hrlspec.exact.shortest_path import (
    Grid,
    _neighbours,
    _steps_tables,
    branch_steps,
    grid_of,
    nearest_first_steps,
    planned_steps,
    shortest_steps,
)
from hrlspec.spec import SATISFIED, TaskTree, advance, compile_task, initial, parse
from hrlspec.tasks.sampling import sample_trees


def _task(text: str, env: envs_jax.Environment) -> TaskTree:
    return compile_task(parse(text), env.propositions, 16)


def _trees(number: int, num_propositions: int, seed: int = 0) -> list[TaskTree]:
    trees = sample_trees(
        np.random.default_rng(seed),
        num_tasks=number,
        num_propositions=num_propositions,
        max_nodes=12,
        min_depth=2,
        max_depth=3,
        max_branching=3,
        reserved=None,
    )
    return [jax.tree.map(lambda x, i=i: np.asarray(x[i]), trees) for i in range(number)]


def _layouts(env: envs_jax.Environment, number: int) -> Any:
    sample = jax.vmap(lambda key: env.sample_layout(key, env.default_params))
    return jax.tree.map(np.asarray, sample(jax.random.split(jax.random.key(0), number)))


def _random_grid(rng: np.random.Generator, num_layouts: int, width: int, height: int) -> Grid:
    """Labels and walls at random: some places cannot be reached, one in four bears a label."""
    symbols = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1]], bool)
    weights = [0.75, 0.06, 0.06, 0.06, 0.04, 0.03]
    symbol = rng.choice(len(symbols), (num_layouts, width, height), p=weights)
    inside = rng.random(symbol.shape) < 0.6
    start = rng.integers(0, (width, height), (num_layouts, 2))
    inside[np.arange(num_layouts), start[:, 0], start[:, 1]] = True
    return Grid(symbols, symbol, inside, start)


def _as_graph(grid: Grid) -> solver.Graph:
    """The same as a transition table of nine moves; those into walls lead to a last state with no way out."""
    num_layouts, width, height = grid.symbol.shape
    x, y = np.divmod(np.arange(width * height), height)
    dead = width * height
    successors = np.full((num_layouts, dead + 1, 9), dead)
    for action, (dx, dy) in enumerate(np.ndindex(3, 3)):
        to_x, to_y = x + dx - 1, y + dy - 1
        within = (to_x >= 0) & (to_x < width) & (to_y >= 0) & (to_y < height)
        to = np.where(within, to_x * height + to_y, 0)
        free = within & grid.inside.reshape(num_layouts, -1)[:, to]
        successors[:, :-1, action] = np.where(free, to, dead)
    labels = grid.symbols[grid.symbol].reshape(num_layouts, dead, -1)
    labels = np.concatenate([labels, np.zeros_like(labels[:, :1])], 1)
    return solver.Graph(successors, labels, grid.start[:, 0] * height + grid.start[:, 1])


@dataclasses.dataclass(frozen=True)
class Path:
    """How to satisfy a task: the places from the start on, int ``[t + 1, 2]``, and the edge that each step takes."""

    places: np.ndarray
    edges: np.ndarray

    @property
    def steps(self) -> int:
        return len(self.edges)


def _shortest_path(grid: Grid, tree: TaskTree, layout: int) -> Path:
    """A path down the tables of least steps; of several, the one through the neighbours of lowest index."""
    one, machine = grid[layout : layout + 1], automaton(tree, grid.symbols)
    tables = {state: table[0] for state, table in _steps_tables(one, machine, machine.initial[:1].tolist()).items()}
    place, state = (int(one.start[0, 0]), int(one.start[0, 1])), int(machine.initial[0])
    places, edges = [place], []
    while state != Automaton.SATISFIED:
        options = []
        for there in _neighbours(one, place):
            symbol = one.symbol[0][there]
            for choice in range(machine.successor.shape[-1]):
                after = int(machine.successor[symbol, state, choice])
                if after != Automaton.VIOLATED:
                    edge = int(machine.edge[symbol, state, choice])
                    ahead = 0.0 if after == Automaton.SATISFIED else float(tables[after][there])
                    options.append((ahead, there, after, edge))
        _, place, state, edge = min(options, key=lambda option: option[0])
        places.append(place)
        edges.append(edge)
    return Path(np.array(places), np.array(edges))


def test_least_steps_are_the_exact_solvers() -> None:
    rng = np.random.default_rng(1)
    finite = 0
    for tree in _trees(25, 3):
        grid = _random_grid(rng, 4, 9, 7)
        expected = solver.optimal_steps(_as_graph(grid), tree)
        np.testing.assert_array_equal(shortest_steps(grid, tree), expected)
        np.testing.assert_array_equal(branch_steps(grid, tree), solver.branch_steps(_as_graph(grid), tree))
        finite += int(np.isfinite(expected).sum())
    assert 20 < finite < 100


def test_nearest_first_is_the_exact_worlds_myopic_agent() -> None:
    rng = np.random.default_rng(2)
    differ = 0
    for tree in _trees(25, 3, seed=1):
        grid = _random_grid(rng, 4, 8, 8)
        found = nearest_first_steps(grid, tree)
        np.testing.assert_array_equal(found, myopic_steps(_as_graph(grid), tree))
        differ += int((found > shortest_steps(grid, tree)).sum())
        assert (found >= shortest_steps(grid, tree)).all()
    assert differ > 5


def test_paths_do_what_they_say() -> None:
    rng = np.random.default_rng(3)
    for tree in _trees(10, 3, seed=2):
        grid = _random_grid(rng, 3, 8, 9)
        for layout, steps in enumerate(shortest_steps(grid, tree)):
            if not np.isfinite(steps):
                continue
            path = _shortest_path(grid, tree, layout)
            assert path.steps == steps == len(path.places) - 1
            assert np.array_equal(path.places[0], grid.start[layout])
            assert np.abs(np.diff(path.places, axis=0)).max() <= 1
            assert grid.inside[layout][tuple(path.places.T)].all()
            taken = path.edges[path.edges != TaskTree.NO_NODE]
            assert np.array_equal(np.asarray(tree.parent)[taken], [0, *taken[:-1]])
            assert tree.accepting[taken[-1]]


# Steps cover 0.1 along x and y at once, so only the longer of the two counts. All from (0, 0).
LENGTHS = {
    "achieve a": 41,  # (5.1 - 1, 3.1)
    "achieve b": 75,
    "achieve c": 76,
    "achieve d": 78,
    "achieve e": 34,
    "achieve a; achieve b": 75,  # a lies on the way
    "achieve d or achieve e": 34,
    "achieve e; achieve d": 78,
    "achieve b ensuring not a": 75,  # past a costs nothing: the way along y has time to spare
}


@pytest.mark.parametrize(("text", "length"), LENGTHS.items())
def test_lengths_in_the_papers_world(text: str, length: int) -> None:
    env = envs_jax.make("walk")
    optimum, myopic = planned_steps(env, _layouts(env, 1), _task(text, env))
    assert optimum.tolist() == [length]
    assert myopic.tolist() == [length]


def test_goals_are_entered_where_the_way_onward_is_best() -> None:
    """b, then c: from b's lower left, at 45 degrees, straight down to the top of c: 8.5 + 4.3 - √2 - 1 = 10.386."""
    env = envs_jax.make("walk")
    (optimum,), (myopic,) = planned_steps(env, _layouts(env, 1), _task("achieve b; achieve c", env))
    assert optimum == 104
    # The nearest place of b first, by the first of the shortest ways.
    assert 104 < myopic <= 112


def test_avoided_discs_are_walked_around() -> None:
    """A disc with a gap of 0.5 above it and none below.

    The way touches it at 45 degrees, at (5 - 5.5/√2, 4 + 5.5/√2) = (1.111, 7.889): 7.889 up to there, and then
    9.1 - 1.111 to the right.
    """
    env = envs_jax.make("walk", discs=(("a", 5.0, 4.0, 5.5), ("b", 9.5, 9.5, 0.4)))
    layouts = _layouts(env, 1)
    (free,), _ = planned_steps(env, layouts, _task("achieve b", env))
    assert 91 <= free <= 94  # max(9.5, 9.5) - 0.4/√2 = 9.217
    (around,), (myopic,) = planned_steps(env, layouts, _task("achieve b ensuring not a", env))
    assert 159 <= around <= 160
    assert myopic == around
    closed = envs_jax.make("walk", discs=(("a", 5.0, 4.0, 6.2), ("b", 9.9, 9.9, 0.05)))
    (around,), (myopic,) = planned_steps(closed, _layouts(closed, 1), _task("achieve b ensuring not a", closed))
    assert around == myopic == np.inf


def test_conjunctions_are_met_where_discs_overlap() -> None:
    env = envs_jax.make("flatworld")
    _, _, start = env.grid(jax.tree.map(lambda x: x[0], _layouts(env, 1)))
    assert start.shape == (2,)
    layouts = _layouts(env, 4)
    both, _ = planned_steps(env, layouts, _task("achieve blue and green", env))
    each = [planned_steps(env, layouts, _task(f"achieve {name}", env))[0] for name in ("blue", "green")]
    assert np.isfinite(both).all()
    assert (both >= np.maximum(*each)).all()
    nowhere, _ = planned_steps(env, layouts, _task("achieve blue and yellow", env))
    assert (nowhere == np.inf).all()


@pytest.mark.parametrize("name", ["walk", "flatworld"])
def test_paths_can_be_walked(name: str) -> None:
    """The world itself, step by step, with the monitor beside it: satisfied after exactly so many steps."""
    env = envs_jax.make(name, layout_seed=3)
    params = env.default_params
    layouts = _layouts(env, 3)
    grid = grid_of(env, layouts)
    step, labels, monitor = jax.jit(env.step_env), jax.jit(env.labels), jax.jit(advance)
    walked = 0
    for i, tree in enumerate(_trees(6, env.num_propositions, seed=4)):
        row = i % 3
        if not np.isfinite(shortest_steps(grid[row : row + 1], tree)[0]):
            continue
        path = _shortest_path(grid, tree, row)
        _, state = env.reset_to(jax.tree.map(lambda x, row=row: x[row], layouts), jax.random.key(0), params)
        task = initial(tree)
        # The next edge of the path is what the planner has assigned.
        ahead = [path.edges[t:][path.edges[t:] != TaskTree.NO_NODE][0] for t in range(path.steps)]
        for t, move in enumerate(np.diff(path.places, axis=0)):
            assert int(task.status) != SATISFIED
            _, state, _, terminated, _, _ = step(jax.random.key(0), state, jnp.asarray(move, jnp.float32), params)
            assert not terminated
            task = monitor(tree, task, labels(state, params), int(ahead[t]))
        assert int(task.status) == SATISFIED
        walked += 1
    assert walked >= 4


def test_layouts_that_are_alike_give_the_same_and_others_do_not() -> None:
    env = envs_jax.make("flatworld")
    layouts = jax.tree.map(lambda x: x[np.array([0, 1, 0, 2, 1])], _layouts(env, 3))
    tree = _task("achieve yellow; achieve aqua", env)
    optimum, myopic = planned_steps(env, layouts, tree)
    alone = [planned_steps(env, jax.tree.map(lambda x, i=i: x[i : i + 1], layouts), tree) for i in range(5)]
    np.testing.assert_array_equal(optimum, np.concatenate([one[0] for one in alone]))
    np.testing.assert_array_equal(myopic, np.concatenate([one[1] for one in alone]))
    assert len(set(optimum.tolist())) > 1


def test_the_grid_loses_less_than_a_step_for_each_sub_task() -> None:
    """Starts on finer and shifted grids agree: the same world with the start moved by parts of a step."""
    env = envs_jax.make("walk")
    own = jax.tree.map(lambda x: x[0], _layouts(env, 1))
    tree = _task("achieve b; achieve c; achieve a; achieve e; achieve d", env)
    shifts = [np.float32([dx, dy]) for dx in (0, 0.03, 0.07) for dy in (0, 0.05)]
    moved = [WalkLayout(start=shift, discs=own.discs) for shift in shifts]
    grid = grid_of(env, jax.tree.map(lambda *x: np.stack(x), *moved))
    steps = shortest_steps(grid, tree)
    assert np.ptp(steps) <= 5
