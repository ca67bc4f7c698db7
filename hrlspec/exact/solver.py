"""Exact optima of tasks on finite labelled graphs: references for evaluation and for the tests of the library.

Dynamic programming over graph state × automaton state (and time left for returns), for environments that are a
:class:`envs_jax.FiniteGraph`. Numpy, vectorised over layouts.

Axes: **L** layouts, **S** graph states, **A** actions, **P** atomic propositions, **M** automaton states,
**C** children of the root.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Bool, Float32, Int

from envs_jax import FiniteGraph
from envs_jax.base import Layout
from hrlspec.exact.automaton import Automaton, automaton
from hrlspec.spec.tree import TaskTree
from hrlspec.tasks.rewards import RewardMachine

MOST_VALUES = 4_000_000
"""Layouts are solved in groups, so that a table of values holds no more than about this many."""


@dataclasses.dataclass(frozen=True)
class Graph:
    """Deterministic labelled transition graphs, one for each layout.

    Attributes:
        successors: int ``[L, S, A]``, the state each action leads to.
        labels: bool ``[L, S, P]``, the propositions that hold in a state.
        start: int ``[L]``, where episodes begin (labels of the start count only when it is entered again).
    """

    successors: Int[np.ndarray, "L S A"]
    labels: Bool[np.ndarray, "L S P"]
    start: Int[np.ndarray, " L"]

    @property
    def num_layouts(self) -> int:
        """L."""
        return self.labels.shape[0]

    def __getitem__(self, index: slice | list[int] | Int[np.ndarray, " _"] | Bool[np.ndarray, " _"]) -> Graph:
        """Some of the layouts."""
        return Graph(self.successors[index], self.labels[index], self.start[index])


def tabulate(env: FiniteGraph, layouts: Layout) -> Graph:
    """The graphs of an environment's layouts (a layout pytree with a leading axis L)."""
    tables = jax.vmap(env.transition_table, (0, None))(layouts, env.default_params)
    successors, labels, start = (np.asarray(table) for table in tables)
    return Graph(successors.astype(np.int64), labels.astype(bool), start.astype(np.int64))


def optimal_steps(graph: Graph, tree: TaskTree) -> Float32[np.ndarray, " L"]:
    """The least number of steps that satisfies a task under the committed semantics, inf where none does.

    Where several edges are met at once the agent may have assigned any of them, so the least counts.

    Args:
        graph: L layouts.
        tree: one task (unbatched).

    Returns:
        float32 ``[L]``.
    """
    return _from_start(graph, tree, None, steps_table)[:, 0]


def branch_steps(graph: Graph, tree: TaskTree) -> Float32[np.ndarray, "L C"]:
    """The same for each branch: only the first edge to that child of the root may be taken.

    Args:
        graph: L layouts.
        tree: one task (unbatched).

    Returns:
        float32 ``[L, C]``, in the order of :func:`root_children`. The minimum over branches is the optimum.
    """
    return _from_start(graph, tree, None, steps_table)[:, 1:]


def branch_returns(
    graph: Graph, tree: TaskTree, rewards: RewardMachine | None, horizon: int
) -> Float32[np.ndarray, "L C"]:
    """The optimal undiscounted return of each branch: only the first edge to that child of the root may be taken.

    Episodes end on satisfaction, violation or the horizon. The maximum over branches is the optimum.

    Args:
        graph: L layouts.
        tree: one task (unbatched).
        rewards: of the task; 1 for completing it if ``None``.
        horizon: steps in an episode.

    Returns:
        float32 ``[L, C]``, 0 where the branch cannot be entered within the horizon.
    """
    return _from_start(graph, tree, rewards, lambda one: returns_table(one, horizon))[:, 1:]


def root_children(tree: TaskTree) -> Int[np.ndarray, " C"]:
    """The root's children, in the order of the columns of :func:`branch_returns`, int ``[C]``."""
    return np.flatnonzero(np.asarray(tree.valid) & (np.asarray(tree.parent) == TaskTree.ROOT))


def steps_table(product: Product) -> Float32[np.ndarray, "L S M"]:
    """Least steps to satisfaction from every state, float32 ``[L, S, M]``, inf where there is no path.

    Values of exactly k steps appear in sweep k and never change, so a sweep that adds none is the last.
    """
    machine = product.automaton
    steps = np.full((product.num_rows, machine.num_states), np.inf, np.float32)
    steps[:, Automaton.SATISFIED] = 0
    known = 0
    while known < (now_known := int(np.isfinite(steps).sum())):
        known = now_known
        entered = product.enter(steps, np.minimum)
        steps = product.act(entered, np.minimum)
        steps += 1
        steps[:, Automaton.SATISFIED] = 0
    return steps.reshape(*product.shape, machine.num_states)


def returns_table(product: Product, horizon: int) -> Float32[np.ndarray, "L S M"]:
    """Optimal return with ``horizon`` steps left, from every state, float32 ``[L, S, M]``."""
    values = np.zeros((product.num_rows, product.automaton.num_states), np.float32)
    for _ in range(horizon):
        following = product.act(product.enter(values, np.maximum, rewarded=True), np.maximum)
        if np.array_equal(following, values):
            break  # A fixed point: more steps earn nothing.
        values = following
    return values.reshape(*product.shape, product.automaton.num_states)


class Product:
    """The product of graphs with a task's automaton: rows are (layout, graph state), columns automaton states.

    Attributes:
        automaton: of the task.
        symbol: int ``[L, S]``, the label set of each graph state, a row of ``automaton.symbols``.
        shape: (L, S).
    """

    def __init__(self, graph: Graph, machine: Automaton, symbol: Int[np.ndarray, "L S"]) -> None:
        """Builds the tables; :func:`product` computes ``machine`` and ``symbol``."""
        num_layouts, num_states = symbol.shape
        self.automaton, self.symbol, self.shape = machine, symbol, (num_layouts, num_states)
        first_row = num_states * np.arange(num_layouts)
        self._next_row = (graph.successors + first_row[:, None, None]).reshape(-1, graph.successors.shape[-1])
        # Most states have no label and leave the automaton where it is: only the others are looked up.
        at_rest = machine.successor == np.arange(machine.num_states)[:, None]
        inert = at_rest.all((1, 2)) & (machine.reward == 0).all((1, 2))
        flat = symbol.reshape(-1)
        self._rows = np.flatnonzero(~inert[flat])
        successor = machine.successor[flat[self._rows]].astype(np.int64)
        self._choices = successor + (self._rows * machine.num_states)[:, None, None]
        self._rewards = machine.reward[flat[self._rows]]

    @property
    def num_rows(self) -> int:
        """L · S."""
        return self.shape[0] * self.shape[1]

    def enter(
        self, values: Float32[np.ndarray, "rows M"], best: np.ufunc, *, rewarded: bool = False
    ) -> Float32[np.ndarray, "rows M"]:
        """Values of entering each row: ``values`` ``[L·S, M]`` after the transition of the automaton on its labels."""
        entered = values.copy()
        outcomes = values.reshape(-1)[self._choices]
        if rewarded:
            outcomes = outcomes + self._rewards
        entered[self._rows] = best.reduce(outcomes, axis=-1)
        return entered

    def act(self, entered: Float32[np.ndarray, "rows M"], best: np.ufunc) -> Float32[np.ndarray, "rows M"]:
        """Values of the best action in each row, ``[L·S, M]``."""
        result = entered[self._next_row[:, 0]]
        for action in range(1, self._next_row.shape[1]):
            best(result, entered[self._next_row[:, action]], out=result)
        return result


def product(graph: Graph, tree: TaskTree, rewards: RewardMachine | None = None) -> Product:
    """The product of all layouts with the task's automaton.

    Raises:
        ValueError: if graphs, tree and rewards are over different numbers of propositions.
    """
    return Product(graph, *_machine(graph, tree, rewards))


def _from_start(
    graph: Graph,
    tree: TaskTree,
    rewards: RewardMachine | None,
    solve: Callable[[Product], Float32[np.ndarray, "L S M"]],
) -> Float32[np.ndarray, "L _"]:
    """Values at the start state for each of the automaton's initial states, float32 ``[L, 1 + C]``."""
    machine, symbol = _machine(graph, tree, rewards)
    size = max(1, MOST_VALUES // (symbol.shape[1] * machine.num_states))
    values = np.empty((graph.num_layouts, len(machine.initial)), np.float32)
    for first in range(0, graph.num_layouts, size):
        group = slice(first, first + size)
        part = graph[group]
        table = solve(Product(part, machine, symbol[group]))
        values[group] = table[np.arange(part.num_layouts)[:, None], part.start[:, None], machine.initial]
    return values


def _machine(graph: Graph, tree: TaskTree, rewards: RewardMachine | None) -> tuple[Automaton, Int[np.ndarray, "L S"]]:
    """The task's automaton over the label sets that occur, and the label set of each state, int ``[L, S]``."""
    symbols, symbol = _distinct(graph.labels.reshape(-1, graph.labels.shape[-1]))
    return automaton(tree, symbols, rewards), symbol.reshape(graph.labels.shape[:2])


def _distinct(labels: Bool[np.ndarray, "rows P"]) -> tuple[Bool[np.ndarray, "K P"], Int[np.ndarray, " rows"]]:
    """The distinct rows, bool ``[K, P]``, and the index of each row among them, int ``[rows]``."""
    packed = np.packbits(labels, axis=-1)
    words = np.ascontiguousarray(packed).view(np.dtype((np.void, packed.shape[-1])))[:, 0]
    _, first, which = np.unique(words, return_index=True, return_inverse=True)
    return labels[first], which.reshape(-1)
