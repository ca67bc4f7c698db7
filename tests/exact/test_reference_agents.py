"""The myopic agent, branch scores and contested choices against plain-Python searches."""

from __future__ import annotations

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.exact import solver
from hrlspec.exact.contested import contested_suite, find_contested, first_visits, two_step_task
from hrlspec.exact.reference_agents import branch_scores, myopic_steps
from hrlspec.spec.monitor import RUNNING, SATISFIED, advance, initial, open_edges
from hrlspec.spec.tree import TaskTree, subtask_avoid
from hrlspec.tasks.rewards import Bonus, reward_machine
from tests.probes import padded
from tests.trees import random_tree, tree_of

LETTER = envs_jax.make("letter")


@functools.cache
def _pool() -> solver.Graph:
    keys = jax.random.split(jax.random.key(0), 3000)
    return solver.tabulate(LETTER, jax.jit(jax.vmap(LETTER.sample_layout, (0, None)))(keys, LETTER.default_params))


def _letter_graph(number: int) -> solver.Graph:
    """The first of 3,000 random layouts."""
    return _pool()[:number]


def _random_graph(rng: np.random.Generator, num_layouts: int) -> solver.Graph:
    """Any successors, and several labels at once."""
    return solver.Graph(
        rng.integers(0, 8, (num_layouts, 8, 3)), rng.random((num_layouts, 8, 4)) < 0.25, rng.integers(0, 8, num_layouts)
    )


def _distance(successors: np.ndarray, start: int, goals: set[int], forbidden: set[int]) -> float:
    """Steps (at least one) to the nearest goal without entering a forbidden state."""
    queue, seen = collections.deque([(start, 0)]), set()
    while queue:
        state, steps = queue.popleft()
        for following in successors[state].tolist():
            if following in forbidden or following in seen:
                continue
            if following in goals:
                return steps + 1
            seen.add(following)
            queue.append((following, steps + 1))
    return np.inf


def _plain_myopic(graph: solver.Graph, tree: TaskTree) -> float:
    """One layout, step by step, with the library's monitor."""
    successors, labels, place = graph.successors[0], graph.labels[0], int(graph.start[0])
    tree = jax.tree.map(jnp.asarray, tree)
    reach, avoid = np.asarray(tree.reach), np.asarray(subtask_avoid(tree))
    task, steps = initial(tree), 0
    while int(task.status) == RUNNING:
        options = []
        for edge in np.flatnonzero(_open_edges(tree, task)):
            forbidden = {s for s in range(len(labels)) if (labels[s] & avoid[edge]).any()}
            goals = {s for s in range(len(labels)) if (labels[s] >= reach[edge]).all()} - forbidden
            for action, following in enumerate(successors[place].tolist()):
                if following in goals:
                    options.append((1.0, edge, action))
                elif following not in forbidden:
                    options.append((1 + _distance(successors, following, goals, forbidden), edge, action))
        if not options or min(options)[0] == np.inf:
            return np.inf
        _, edge, action = min(options)
        place = int(successors[place][action])
        task = _advance(tree, task, labels[place], edge)
        steps += 1
    return steps if int(task.status) == SATISFIED else np.inf


_advance, _open_edges = jax.jit(advance), jax.jit(open_edges)


@pytest.mark.parametrize("seed", range(5))
def test_myopic_agent_on_letter(seed: int) -> None:
    tree = random_tree(np.random.default_rng(seed), num_nodes=8, num_propositions=5)
    graph = _letter_graph(5)
    assert myopic_steps(graph, tree).tolist() == [_plain_myopic(graph[i : i + 1], tree) for i in range(5)]


def test_myopic_agent_on_any_graph() -> None:
    rng, found = np.random.default_rng(0), []
    for _ in range(25):
        tree = random_tree(rng, num_nodes=8, num_propositions=4, most_together=2)
        graph = _random_graph(rng, 2)
        steps = myopic_steps(graph, tree)
        assert steps.tolist() == [_plain_myopic(graph[i : i + 1], tree) for i in range(2)]
        assert (steps >= solver.optimal_steps(graph, tree)).all()
        found += steps.tolist()
    assert 0.2 < np.isfinite(found).mean() < 0.9


def test_how_much_a_myopic_agent_loses() -> None:
    """Published figures for 5 letters × 2 at depth 2: 3.8 % more steps, on 13 % of the maps."""
    graph, tree = _letter_graph(3000), two_step_task(0, 1, 5)
    optimum, myopic = solver.optimal_steps(graph, tree), myopic_steps(graph, tree)
    assert myopic.mean() / optimum.mean() == pytest.approx(1.038, abs=0.008)
    assert (myopic > optimum).mean() == pytest.approx(0.13, abs=0.02)


def test_branch_scores_in_closed_form() -> None:
    graph = _letter_graph(3)
    machine = reward_machine("abcde", subtask=1.0, bonuses=[Bonus("a", "d", 5.0), Bonus("b", "e", 10.0, ("a",))])
    tree = tree_of([(0, "c", ""), (1, "b", ""), (2, "c", ""), (0, "a", ""), (4, "d", ""), (0, "b", ""), (6, "e", "")])
    scores = branch_scores(graph, tree, machine, 75)
    assert scores.optimal.tolist() == [13.0] * 3  # b, e and the end, with the larger bonus
    assert scores.longest.tolist() == [4.0] * 3  # c, b, c and the end
    assert scores.random == pytest.approx((13 + 4 + 8) / 3)
    assert scores.matters.all()
    # Under set 1 all branches are worth the same, and with no time at all nothing is worth anything.
    assert not branch_scores(graph, tree, None, 75).matters.any()
    assert not branch_scores(graph, tree, machine, 0).matters.any()


def test_what_counts_as_mattering() -> None:
    graph = _letter_graph(3)
    tree = tree_of([(0, "c", ""), (1, "b", ""), (0, "a", "")])
    machine = reward_machine("abcde", subtask=1.0, completion=1.0)  # the branches are worth 3 and 2
    assert branch_scores(graph, tree, machine, 75).matters.all()
    assert branch_scores(graph, tree, machine, 75, least_difference=1 / 3).matters.all()
    assert not branch_scores(graph, tree, machine, 75, least_difference=0.34).matters.any()
    tied = tree_of([(0, "c", ""), (0, "a", "")])
    bonus = reward_machine("abcde", completion=1.0, subtask=1.0, bonuses=[Bonus("c", "c", 1.0)])
    assert branch_scores(graph, tied, bonus, 75).longest.tolist() == [2.0] * 3


@pytest.mark.parametrize(("first_avoid", "second_avoid"), [("", ""), ("c", ""), ("cd", "e"), ("b", "a")])
def test_first_visits_against_a_plain_search(first_avoid: str, second_avoid: str) -> None:
    tree, graph = tree_of([(0, "a", first_avoid), (1, "b", second_avoid)]), _letter_graph(40)
    found = first_visits(graph, tree)
    letters = [
        {letter: set(np.flatnonzero(layout[:, i])) for i, letter in enumerate("abcde")} for layout in graph.labels
    ]
    for i, at in enumerate(letters):
        harms = [set().union(*(at[letter] for letter in avoid)) for avoid in (first_avoid, second_avoid)]
        for cell in range(49):
            steps = total = np.inf
            if cell in at["a"]:
                steps = _distance(graph.successors[i], 0, {cell}, harms[0] | at["a"] - {cell})
                total = steps + _distance(graph.successors[i], cell, at["b"], harms[1])
            assert (found.steps[i, cell], found.total[i, cell]) == (steps, total)
    np.testing.assert_array_equal(found.total.min(-1), solver.optimal_steps(graph, tree))


def test_first_visits_on_any_graph() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        tree = random_tree(rng, num_nodes=6, num_propositions=4, most_together=2)
        graph = _random_graph(rng, 4)
        found = first_visits(graph, tree)
        np.testing.assert_array_equal(found.total.min(-1), solver.optimal_steps(graph, tree))
        assert (found.total >= found.steps).all()


def _map(rows: str) -> np.ndarray:
    return np.array([-1 if mark == "." else ord(mark) - ord("a") for mark in rows.split()], np.int8).reshape(1, 7, 7)


EMPTY = " . . . . . . . "


@pytest.mark.parametrize(
    ("rows", "contested", "control"),
    [
        # The near a, (6, 0), is 1 away and b another 6; the far one is 5 away and beside b: 7 against 6.
        (EMPTY * 3 + " . . a b . . . " + EMPTY * 2 + " a . . . . . . ", False, False),
        # The same one row up: b is still 6 from the near a, but the far one is 4 away: 7 against 5.
        (EMPTY * 2 + " . . a b . . . " + EMPTY * 3 + " a . . . . . . ", True, False),
        # The near a is beside b: 2 in all; the far one costs more.
        (" . a b . . . . " + EMPTY * 3 + " . . . . a . . " + EMPTY * 2, False, True),
        # Two a at the same distance: no nearest one.
        (" . a b . . . . " + EMPTY * 5 + " a . . . . . . ", False, False),
        # One a only: nothing to choose.
        (" . a b . . . . " + EMPTY * 6, False, False),
        # No b at all.
        (" . a . a . . . " + EMPTY * 6, False, False),
    ],
)
def test_contested_maps(rows: str, contested: bool, control: bool) -> None:
    found = find_contested(solver.tabulate(LETTER, _map(rows)), two_step_task(0, 1, 5))
    assert (bool(found.contested[0]), bool(found.control[0])) == (contested, control)


def test_contested_choices_follow_the_definition() -> None:
    graph, tree = _letter_graph(1500), padded(two_step_task(2, 3, 5), 16)
    found = find_contested(graph, tree)
    assert not (found.contested & found.control).any()
    assert find_contested(graph, tree, margin=1).contested.mean() == pytest.approx(0.07, abs=0.015)
    checked = np.r_[np.flatnonzero(found.contested)[:8], np.flatnonzero(found.control)[:8]]
    assert len(checked) == 16
    for i in checked:
        at = [set(np.flatnonzero(graph.labels[i, :, letter]).tolist()) for letter in (2, 3)]
        ways = {}
        for cell in at[0]:
            before = _distance(graph.successors[i], 0, {cell}, at[0] - {cell})
            ways[cell] = before, before + _distance(graph.successors[i], cell, at[1], set())
        nearest = min(ways, key=lambda cell: ways[cell][0])
        best = min(total for _, total in ways.values())
        assert found.nearest[i] == nearest
        assert found.optimum[i] == best == solver.optimal_steps(graph[i : i + 1], tree)[0]
        assert set(np.flatnonzero(found.right[i])) == {cell for cell in ways if ways[cell][1] == best}
        if found.contested[i]:
            assert ways[nearest][1] >= best + 2
            assert not found.right[i, nearest]
            assert myopic_steps(graph[i : i + 1], tree)[0] >= best + 2
        else:
            assert min(total for cell, (_, total) in ways.items() if cell != nearest) >= ways[nearest][1] + 2
            assert myopic_steps(graph[i : i + 1], tree)[0] == best


def test_contested_suite() -> None:
    suite = contested_suite(jax.random.key(3), LETTER, num_cases=24)
    assert suite.contested.tolist() == [True] * 12 + [False] * 12
    assert suite.layouts.shape == (24, 7, 7)
    assert suite.tasks.reach.shape == (24, 3, 5)
    assert len({tree.tobytes() for tree in suite.tasks.reach}) > 6
    for q in range(24):
        graph = solver.tabulate(LETTER, suite.layouts[q : q + 1])
        found = find_contested(graph, jax.tree.map(lambda leaf, q=q: leaf[q], suite.tasks))
        assert bool(found.contested[0]) == suite.contested[q] != bool(found.control[0])
        np.testing.assert_array_equal(found.right[0], suite.right[q])
        assert found.optimum[0] == suite.optimum[q]
    # Always the nearest, and never the nearest: both get half.
    nearest_is_right = suite.right[np.arange(24), suite.nearest]
    assert nearest_is_right.tolist() == (~suite.contested).tolist()
    again = contested_suite(jax.random.key(3), LETTER, num_cases=24)
    np.testing.assert_array_equal(suite.layouts, again.layouts)


def test_contested_suite_refuses() -> None:
    with pytest.raises(ValueError, match="num_cases is 3"):
        contested_suite(jax.random.key(0), LETTER, num_cases=3)
    single = envs_jax.make("letter", num_letters=5, num_cells=5)
    with pytest.raises(ValueError, match="letter: only 0 contested and 0 control cases in 512 layouts"):
        contested_suite(jax.random.key(0), single, num_cases=2, most_rounds=1)
    alone = envs_jax.make("letter", num_letters=1, num_cells=2)
    with pytest.raises(ValueError, match="letter has one proposition"):
        contested_suite(jax.random.key(0), alone, num_cases=2)
    with pytest.raises(ValueError, match="walk has no exact solver and no contested layouts"):
        contested_suite(jax.random.key(0), envs_jax.make("walk"), num_cases=2)
