"""The solver against brute force over the real environment, monitor and rewards, and against closed forms."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.exact import solver
from hrlspec.exact.automaton import Automaton, automaton
from hrlspec.spec.monitor import RUNNING, SATISFIED, TaskState, advance, initial
from hrlspec.spec.tree import TaskTree
from hrlspec.tasks import rewards as reward_rules
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine
from tests.trees import random_tree, tree_of

SMALL = envs_jax.Letter(size=3, num_letters=3, num_cells=3, horizon=20)
RULES = [Bonus("a", "c", 5.0), Bonus("b", "c", 10.0, ("a",))]


def _layouts(env: envs_jax.Letter, number: int, seed: int = 0) -> jax.Array:
    keys = jax.random.split(jax.random.key(seed), number)
    return jax.jit(jax.vmap(env.sample_layout, (0, None)))(keys, env.default_params)


def _random_graph(
    rng: np.random.Generator, *, num_layouts: int, num_states: int, num_propositions: int
) -> solver.Graph:
    """Any successors, and several labels at once."""
    return solver.Graph(
        rng.integers(0, num_states, (num_layouts, num_states, 2)),
        rng.random((num_layouts, num_states, num_propositions)) < 0.35,
        rng.integers(0, num_states, num_layouts),
    )


# --- Brute force: every action and every assignment, through the library's own step functions. ---

World = Callable[[object, jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
"""``(where it is played, state number, action) -> (state number, labels)``."""


def _letter_world(layout: jax.Array, cell: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
    params = SMALL.default_params
    _, state = SMALL.reset_to(layout, jax.random.key(0), params)
    state = state.replace(position=jnp.stack([cell // SMALL.size, cell % SMALL.size]))
    _, state, *_ = SMALL.step_env(jax.random.key(0), state, action, params)
    return SMALL.graph_state(state), SMALL.labels(state, params)


def _table_world(
    tables: tuple[jax.Array, jax.Array], state: jax.Array, action: jax.Array
) -> tuple[jax.Array, jax.Array]:
    following = tables[0][state, action]
    return following, tables[1][following]


class _Items(NamedTuple):
    """Situations, with a leading axis: state number, task, bonus rules, return so far."""

    place: np.ndarray
    task: TaskState
    rules: np.ndarray
    gained: np.ndarray


@functools.partial(jax.jit, static_argnames=("world", "num_actions"))
def _expand(world: World, where: object, tree: TaskTree, machine: RewardMachine, items: _Items, *, num_actions: int):
    """All that can follow each situation: axes items, actions, assignments (none, then every node)."""

    def one(item: _Items, action: jax.Array, assigned: jax.Array) -> _Items:
        place, labels = world(where, item.place, action)
        task = advance(tree, item.task, labels, assigned)
        taken = task.node != item.task.node
        completed = (task.status == SATISFIED) & (item.task.status == RUNNING)
        rules, reward = reward_rules.step(machine, item.rules, labels, tree.reach[task.node], taken, completed)
        return _Items(place, task, rules, item.gained + reward)

    over_assigned = jax.vmap(one, (None, None, 0))
    over_actions = jax.vmap(over_assigned, (None, 0, None))
    return jax.vmap(over_actions, (0, None, None))(items, jnp.arange(num_actions), jnp.arange(-1, tree.num_nodes))


BLOCK = 64


def brute_force(
    world: World,
    where: object,
    tree: TaskTree,
    machine: RewardMachine,
    *,
    start: int,
    num_actions: int,
    horizon: int,
    first: int | None = None,
) -> tuple[float, float]:
    """Least steps to satisfaction (inf beyond the horizon) and largest return, by breadth-first enumeration.

    With ``first``, no first edge but that into this node may be taken.
    """
    tree = jax.tree.map(jnp.asarray, tree)
    items = jax.tree.map(
        lambda leaf: np.asarray(leaf)[None],
        _Items(np.int32(start), initial(tree), reward_rules.initial(machine), np.float32(0)),
    )
    steps, best = np.inf, 0.0
    for time in range(1, horizon + 1):
        found: dict[bytes, tuple[_Items, float]] = {}
        number = len(items.place)
        padding = -number % BLOCK
        padded = jax.tree.map(lambda leaf, n=padding: np.concatenate([leaf, np.repeat(leaf[:1], n, 0)]), items)
        for at in range(0, number, BLOCK):
            block = jax.tree.map(lambda leaf, at=at: leaf[at : at + BLOCK], padded)
            after = jax.device_get(_expand(world, where, tree, machine, block, num_actions=num_actions))
            width = num_actions * (tree.num_nodes + 1)
            before = np.repeat(block.task.node, width)
            after = jax.tree.map(lambda leaf, w=width: leaf.reshape(BLOCK * w, *leaf.shape[3:]), after)
            barred = (before == TaskTree.ROOT) & ~np.isin(after.task.node, [TaskTree.ROOT, first])
            keep = np.ones(len(before), bool) if first is None else ~barred
            if (keep & (after.task.status == SATISFIED)).any():
                steps = min(steps, time)
            best = max(best, float(after.gained[keep].max(initial=0.0)))
            for i in np.flatnonzero(keep & (after.task.status == RUNNING)):
                item = jax.tree.map(lambda leaf, i=i: leaf[i], after)
                key = b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves((item.place, item.task, item.rules)))
                if key not in found or found[key][1] < item.gained:
                    found[key] = (item, float(item.gained))
        if not found:
            break
        items = jax.tree.map(lambda *leaves: np.stack(leaves), *[item for item, _ in found.values()])
    return steps, best


def _optimal_return(graph: solver.Graph, tree: TaskTree, machine: RewardMachine | None, horizon: int) -> float:
    """Of one layout."""
    return float(solver.branch_returns(graph, tree, machine, horizon)[0].max())


def _assert_matches_brute_force(
    world: World, wheres: list[object], graph: solver.Graph, tree: TaskTree, machine: RewardMachine, horizon: int
) -> None:
    num_actions = graph.successors.shape[-1]
    steps, returns = solver.optimal_steps(graph, tree), solver.branch_returns(graph, tree, machine, horizon)
    by_branch = solver.branch_steps(graph, tree)
    brute = functools.partial(brute_force, tree=tree, machine=machine, num_actions=num_actions, horizon=horizon)
    for i, where in enumerate(wheres):
        expected = brute(world, where, start=int(graph.start[i]))
        assert (steps[i] if steps[i] <= horizon else np.inf, returns[i].max()) == pytest.approx(expected)
        for c, child in enumerate(solver.root_children(tree)):
            expected = brute(world, where, start=int(graph.start[i]), first=int(child))
            within = by_branch[i, c] if by_branch[i, c] <= horizon else np.inf
            assert (within, returns[i, c]) == pytest.approx(expected)


@pytest.mark.parametrize("seed", range(2))
def test_letter_against_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tree = random_tree(rng, num_nodes=6, num_propositions=3)
    machine = reward_machine(SMALL.propositions, subtask=1.0, bonuses=RULES)
    layouts = _layouts(SMALL, 2, seed)
    graph = solver.tabulate(SMALL, layouts)
    _assert_matches_brute_force(_letter_world, list(layouts), graph, tree, machine, horizon=9)


@pytest.mark.parametrize("seed", range(4))
def test_any_graph_against_brute_force(seed: int) -> None:
    """Several labels at once: edges met together, goals beside harm, bonuses armed and barred in one step."""
    rng = np.random.default_rng(100 + seed)
    tree = random_tree(rng, num_nodes=7, num_propositions=4, most_together=2)
    machine = reward_machine("abcd", subtask=1.0, completion=2.0, bonuses=[*RULES, Bonus("d", "d", 3.5, ("c",))])
    graph = _random_graph(rng, num_layouts=2, num_states=6, num_propositions=4)
    wheres = [(jnp.asarray(graph.successors[i]), jnp.asarray(graph.labels[i])) for i in range(2)]
    _assert_matches_brute_force(_table_world, wheres, graph, tree, machine, horizon=8)


def test_all_action_sequences_of_a_tiny_world() -> None:
    """Nothing shared with the search above: 4^6 whole episodes are played and the best is taken."""
    horizon, params = 6, SMALL.default_params
    machine = reward_machine(SMALL.propositions, subtask=1.0, bonuses=RULES)
    sequences = jnp.array(list(itertools.product(range(4), repeat=horizon)))

    @jax.jit
    def play(layout: jax.Array, tree: TaskTree, actions: jax.Array) -> tuple[jax.Array, jax.Array]:
        def body(carry, action):
            state, task, rules = carry
            _, state, *_ = SMALL.step_env(jax.random.key(0), state, action, params)
            labels = SMALL.labels(state, params)
            after = advance(tree, task, labels, TaskTree.NO_NODE)
            taken = after.node != task.node
            completed = (after.status == SATISFIED) & (task.status == RUNNING)
            rules, paid = reward_rules.step(machine, rules, labels, tree.reach[after.node], taken, completed)
            running = task.status == RUNNING
            return (state, after, rules), (jnp.where(running, paid, 0.0), completed)

        _, state = SMALL.reset_to(layout, jax.random.key(0), params)
        _, (paid, completed) = jax.lax.scan(body, (state, initial(tree), reward_rules.initial(machine)), actions)
        return jnp.where(completed.any(), completed.argmax() + 1.0, jnp.inf), paid.sum()

    play_all = jax.jit(jax.vmap(play, (None, None, 0)))
    rng, seen = np.random.default_rng(7), []
    layouts = _layouts(SMALL, 6, 7)
    graph = solver.tabulate(SMALL, layouts)
    for i in range(6):
        # One letter a cell and siblings that differ: what is assigned makes no difference.
        tree = random_tree(rng, num_nodes=5, num_propositions=3, distinct=True)
        steps, returns = play_all(layouts[i], jax.tree.map(jnp.asarray, tree), sequences)
        one = graph[i : i + 1]
        optimum = float(solver.optimal_steps(one, tree)[0])
        assert (optimum if optimum <= horizon else np.inf) == float(steps.min())
        assert _optimal_return(one, tree, machine, horizon) == pytest.approx(float(returns.max()))
        seen.append(optimum)
    assert len(set(seen)) > 2


# --- Closed forms on a map that fits in the head. ---

#      column 0    1    2    3    4
MAP = """ .    .    a    .    b
          .    .    .    .    .
          c    c    c    .    .
          .    d    .    .    .
          .    .    .    .    a """
FIVE = envs_jax.Letter(size=5, num_letters=4, num_cells=4)


@pytest.fixture(scope="module")
def five() -> solver.Graph:
    cells = [-1 if mark == "." else ord(mark) - ord("a") for mark in MAP.split()]
    return solver.tabulate(FIVE, np.array(cells, np.int8).reshape(1, 5, 5))


@pytest.mark.parametrize(
    ("edges", "steps"),
    [
        ([(0, "a", "")], 2),
        ([(0, "b", "")], 1),  # one step to the left, round the edge
        ([(0, "d", "")], 3),  # up twice, then right
        ([(0, "a", ""), (1, "a", "")], 4),  # 2 there, then off it and on it again
        ([(0, "b", ""), (1, "a", "")], 2),  # the other a is beside b
        ([(0, "b", ""), (1, "a", "b")], 2),
        ([(0, "d", "c")], 3),
        ([(0, "c", ""), (1, "d", "")], 4),
        ([(0, "ab", "")], np.inf),
        ([(0, "a", ""), (0, "b", "")], 1),
        ([(0, "a", ""), (1, "d", ""), (0, "b", ""), (3, "c", "")], 4),
        ([(0, "b", ""), (1, "d", "")], 5),
        ([(0, "b", ""), (1, "d", "a")], 5),
    ],
)
def test_steps_in_closed_form(five: solver.Graph, edges: list[tuple[int, str, str]], steps: float) -> None:
    for num_nodes in (0, 9):  # Padding changes nothing.
        assert solver.optimal_steps(five, tree_of(edges, num_propositions=4, num_nodes=num_nodes))[0] == steps


def test_a_wall_that_must_not_be_touched() -> None:
    """With c on all four sides of the start, whatever forbids c is violated at the first step."""
    layout = np.full((1, 5, 5), -1, np.int8)
    layout[0, [0, 0, 1, 4], [1, 4, 0, 0]] = 2
    layout[0, 2, 2] = 0
    graph = solver.tabulate(FIVE, layout)
    assert solver.optimal_steps(graph, tree_of([(0, "a", "")], num_propositions=4))[0] == 4
    assert solver.optimal_steps(graph, tree_of([(0, "a", "c")], num_propositions=4))[0] == np.inf
    either = tree_of([(0, "a", "c"), (0, "c", "")], num_propositions=4)
    assert solver.branch_returns(graph, either, None, 75).tolist() == [[0.0, 1.0]]
    assert solver.optimal_steps(graph, either)[0] == 1
    after = tree_of([(0, "c", ""), (1, "a", "c")], num_propositions=4)
    assert solver.optimal_steps(graph, after)[0] == 4


def test_returns_in_closed_form(five: solver.Graph) -> None:
    machine = reward_machine(
        FIVE.propositions, subtask=1.0, bonuses=[Bonus("a", "d", 5.0), Bonus("b", "d", 10.0, ("a",))]
    )
    value = functools.partial(_optimal_return, five)
    chain = tree_of([(0, "a", ""), (1, "d", "")], num_propositions=4)
    # Set 1 pays for completion alone; set 2 for both sub-tasks, completion and the bonus.
    assert value(chain, None, 75) == 1.0
    assert value(chain, machine, 75) == 2 + 1 + 5
    # (0, 2) is 2 away, and d another 3, round the edge: two rows up, one column to the left.
    assert value(chain, machine, 5) == 8.0
    assert value(chain, machine, 4) == 1.0
    assert value(chain, machine, 1) == 0.0
    # b before a: the second rule counts although another sub-task lies between its letters.
    longer = tree_of([(0, "b", ""), (1, "a", ""), (2, "d", "")], num_propositions=4)
    assert value(longer, machine, 75) == 3 + 1 + 5 + 10
    # Reaching a first bars it.
    barred = tree_of([(0, "a", ""), (1, "b", ""), (2, "d", "")], num_propositions=4)
    assert value(barred, machine, 75) == 3 + 1 + 5
    # Of two branches the one worth more is taken, though it is longer.
    both = tree_of([(0, "c", ""), (0, "b", ""), (2, "d", "")], num_propositions=4)
    assert solver.branch_returns(five, both, machine, 75).tolist() == [[2.0, 13.0]]
    assert value(both, machine, 75) == 13.0
    assert value(both, machine, 2) == 2.0


def test_one_edge_is_not_both_letters_of_a_bonus() -> None:
    """A letter that is first and second of a rule must be reached by two edges."""
    layout = np.full((1, 5, 5), -1, np.int8)
    layout[0, 0, 1] = 0
    graph = solver.tabulate(FIVE, layout)
    machine = reward_machine(FIVE.propositions, bonuses=[Bonus("a", "a", 7.0)])
    assert _optimal_return(graph, tree_of([(0, "a", "")], num_propositions=4), machine, 9) == 1.0
    twice = tree_of([(0, "a", ""), (1, "a", "")], num_propositions=4)
    assert _optimal_return(graph, twice, machine, 9) == 8.0
    assert solver.optimal_steps(graph, twice)[0] == 3.0


def test_a_batch_equals_its_layouts(monkeypatch: pytest.MonkeyPatch) -> None:
    env = envs_jax.make("letter")
    graph = solver.tabulate(env, _layouts(env, 6))
    tree = tree_of([(0, "a", "c"), (1, "b", ""), (0, "d", "e"), (3, "c", ""), (3, "e", "a")], num_nodes=16)
    machine = reward_machine(env.propositions, subtask=1.0, bonuses=[Bonus("a", "b", 5.0)])
    steps, returns = solver.optimal_steps(graph, tree), solver.branch_returns(graph, tree, machine, 75)
    assert len(set(steps.tolist())) > 2
    for i in range(6):
        assert solver.optimal_steps(graph[i : i + 1], tree)[0] == steps[i]
    monkeypatch.setattr(solver, "MOST_VALUES", 2000)  # One layout or two at a time.
    np.testing.assert_array_equal(solver.optimal_steps(graph, tree), steps)
    np.testing.assert_array_equal(solver.branch_returns(graph, tree, machine, 75), returns)
    assert solver.optimal_steps(graph[:0], tree).shape == (0,)


def test_the_automaton_of_a_single_edge() -> None:
    tree = tree_of([(0, "a", "b")], num_propositions=2)
    symbols = np.array([[False, False], [True, False], [False, True], [True, True]])
    found = automaton(tree, symbols)
    start = found.initial[0]
    assert found.successor[:, start, 0].tolist() == [start, Automaton.SATISFIED, *[Automaton.VIOLATED] * 2]
    assert found.edge[:, start, 0].tolist() == [-1, 1, -1, -1]
    assert found.reward[:, start, 0].tolist() == [0, 1, 0, 0]
    assert found.open_edges[start].tolist() == [False, True]
    assert found.children.tolist() == [1]


def test_edges_met_together_are_choices() -> None:
    tree = tree_of([(0, "a", ""), (0, "ab", ""), (1, "c", ""), (2, "c", ""), (0, "b", "c")], num_propositions=3)
    found = automaton(tree, np.array([[True, True, False], [True, True, True]]))
    start = found.initial[0]
    assert found.edge[:, start].tolist() == [[2, 1, 5], [2, 1, 2]]  # the most specific first, harmed ones not at all


def test_propositions_must_agree(five: solver.Graph) -> None:
    with pytest.raises(ValueError, match=r"expected \[K, 3\]"):
        solver.optimal_steps(five, tree_of([(0, "a", "")], num_propositions=3))
    with pytest.raises(ValueError, match="rewards over 5 propositions, expected 4"):
        solver.branch_returns(five, tree_of([(0, "a", "")], num_propositions=4), reward_machine("abcde"), 75)
