"""A task as an explicit finite automaton, of which the exact solver takes the product with a finite environment.

A state is a state of the monitor (node and blocked edges) with a state of the bonus rules; the alphabet is the set of
label sets that occur. The automaton is enumerated in plain Python from the definitions of monitor and rewards, not
from their code, so that each can be tested against the other.

Axes: **M** automaton states, **K** distinct label sets, **B** choices when several edges are met at once,
**N** tree nodes, **C** children of the root, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32

from hrlspec.spec.tree import TaskTree
from hrlspec.tasks.rewards import RewardMachine


@dataclasses.dataclass(frozen=True)
class Automaton:
    """The reachable states of a task and their transitions.

    States ``SATISFIED`` and ``VIOLATED`` are absorbing, with reward 0.

    Attributes:
        symbols: bool ``[K, P]``, the distinct label sets.
        node: int32 ``[M]``, the tree node a state is at, ``TaskTree.NO_NODE`` for the two absorbing ones.
        open_edges: bool ``[M, N]``, the edges that may still be taken.
        successor: int32 ``[K, M, B]``, the state after symbol k in state m under choice b. Choice 0 is the transition
            when no sub-task is assigned; choices beyond the last possible one repeat it.
        edge: int32 ``[K, M, B]``, the edge taken, ``TaskTree.NO_NODE`` for none.
        reward: float32 ``[K, M, B]``, of the transition.
        initial: int32 ``[1 + C]``: entry 0 is the task's initial state; entry 1 + c is the same, except that taking
            any other first edge than that to ``children[c]`` ends the episode as violated, with reward 0.
        children: int32 ``[C]``, the root's children.
    """

    SATISFIED: ClassVar[int] = 0
    VIOLATED: ClassVar[int] = 1

    symbols: Bool[np.ndarray, "K P"]
    node: Int32[np.ndarray, " M"]
    open_edges: Bool[np.ndarray, "M N"]
    successor: Int32[np.ndarray, "K M B"]
    edge: Int32[np.ndarray, "K M B"]
    reward: Float32[np.ndarray, "K M B"]
    initial: Int32[np.ndarray, " _"]  # [1 + C]
    children: Int32[np.ndarray, " C"]

    @property
    def num_states(self) -> int:
        """M."""
        return self.node.shape[0]


class _State(NamedTuple):
    """A running state. ``first`` is the edge that must be taken first, kept at the root only; sets are bit masks."""

    node: int
    blocked: int
    rules: tuple[int, ...]
    first: int


_Move = tuple[_State | int, int, float]
"""A transition: the next state (a running one, or an absorbing one's number), the edge taken, the reward."""

_WAITING, _ARMED, _OVER = RewardMachine.WAITING, RewardMachine.ARMED, RewardMachine.PAID
_ANY = TaskTree.NO_NODE


def automaton(tree: TaskTree, symbols: Bool[np.ndarray, "..."], rewards: RewardMachine | None = None) -> Automaton:
    """Enumerates the states of a task that are reachable by sequences of the given label sets.

    Args:
        tree: one task (unbatched).
        symbols: bool ``[K, P]``, the label sets that occur, each once.
        rewards: of the task; by default 1 for completing it.

    Raises:
        ValueError: if tree, symbols and rewards are over different numbers of propositions.
    """
    rules = _Rules(tree, rewards)
    if symbols.ndim != 2 or symbols.shape[1] != tree.num_propositions:
        raise ValueError(f"label sets of shape {symbols.shape}, expected [K, {tree.num_propositions}] as in the tree")
    masks = [_mask(symbol) for symbol in symbols]
    waiting = (_WAITING,) * len(rules.bonuses)
    firsts = (_ANY, *rules.children[TaskTree.ROOT])
    initial = [_State(TaskTree.ROOT, 0, rules.forget(TaskTree.ROOT, waiting), first) for first in firsts]
    index: dict[_State | int, int] = {Automaton.SATISFIED: 0, Automaton.VIOLATED: 1}
    queue: list[_State] = []

    def number(state: _State | int) -> int:
        if state not in index:
            assert isinstance(state, _State)
            index[state] = len(index)
            queue.append(state)
        return index[state]

    starts = [number(state) for state in initial]
    table: list[list[list[tuple[int, int, float]]]] = []
    for state in queue:  # Grows while it is read.
        moves = [rules.moves(state, labels) for labels in masks]
        table.append([[(number(to), edge, paid) for to, edge, paid in options] for options in moves])
    return _tabulate(table, queue, starts, symbols, rules)


def _tabulate(
    table: list[list[list[tuple[int, int, float]]]],
    states: Sequence[_State],
    starts: Sequence[int],
    symbols: Bool[np.ndarray, "K P"],
    rules: _Rules,
) -> Automaton:
    """The enumerated transitions as arrays, with the absorbing states in front."""
    num_symbols, num_states = len(symbols), len(states) + 2
    width = max((len(options) for moves in table for options in moves), default=1)
    successor = np.zeros((num_symbols, num_states, width), np.int32)
    successor[:, Automaton.VIOLATED] = Automaton.VIOLATED
    edge = np.full(successor.shape, TaskTree.NO_NODE, np.int32)
    reward = np.zeros(successor.shape, np.float32)
    for m, moves in enumerate(table, 2):
        for k, options in enumerate(moves):
            padded = options + options[:1] * (width - len(options))
            successor[k, m], edge[k, m], reward[k, m] = zip(*padded, strict=True)
    open_edges = np.zeros((num_states, rules.num_nodes), bool)
    for m, state in enumerate(states, 2):
        open_edges[m, [child for child in rules.children[state.node] if not state.blocked >> child & 1]] = True
    return Automaton(
        symbols=np.asarray(symbols, bool),
        node=np.array([TaskTree.NO_NODE] * 2 + [state.node for state in states], np.int32),
        open_edges=open_edges,
        successor=successor,
        edge=edge,
        reward=reward,
        initial=np.array(starts, np.int32),
        children=np.array(rules.children[TaskTree.ROOT], np.int32),
    )


class _Rules:
    """One task and its rewards as Python numbers, and their transition function."""

    def __init__(self, tree: TaskTree, rewards: RewardMachine | None) -> None:
        parent, valid = np.asarray(tree.parent).tolist(), np.asarray(tree.valid).tolist()
        self.num_nodes = tree.num_nodes
        self.reach = [_mask(row) for row in np.asarray(tree.reach)]
        self.avoid = [_mask(row) for row in np.asarray(tree.avoid)]
        self.accepting: list[bool] = np.asarray(tree.accepting).tolist()
        self.children: list[list[int]] = [[] for _ in range(self.num_nodes)]
        for node in range(self.num_nodes):
            if valid[node] and parent[node] != TaskTree.NO_NODE:
                self.children[parent[node]].append(node)
        self.completion, self.subtask = 1.0, 0.0
        self.bonuses: list[tuple[int, int, int, float]] = []
        if rewards is not None:
            if rewards.avoid.shape[-1] != tree.num_propositions:
                found, expected = rewards.avoid.shape[-1], tree.num_propositions
                raise ValueError(f"rewards over {found} propositions, expected {expected} as in the tree")
            self.completion, self.subtask = float(rewards.completion), float(rewards.subtask)
            first, second = np.asarray(rewards.first).tolist(), np.asarray(rewards.second).tolist()
            avoid, bonus = [_mask(row) for row in np.asarray(rewards.avoid)], np.asarray(rewards.bonus).tolist()
            self.bonuses = list(zip((1 << i for i in first), (1 << i for i in second), avoid, bonus, strict=True))
        self.payable = [[self._payable(node, rule) for rule in self.bonuses] for node in range(self.num_nodes)]

    def moves(self, state: _State, labels: int) -> list[_Move]:
        """Transitions of a state on one label set; the first is the one when no sub-task is assigned."""
        edges = [child for child in self.children[state.node] if not state.blocked >> child & 1]
        unharmed = [child for child in edges if not self.avoid[child] & labels]
        met = [child for child in unharmed if self.reach[child] & ~labels == 0]
        if not met:
            if not unharmed:
                return [(Automaton.VIOLATED, TaskTree.NO_NODE, 0.0)]
            blocked = state.blocked | sum(1 << child for child in edges if child not in unharmed)
            rules, _ = self.forward(state.node, state.rules, labels, None)
            return [(_State(state.node, blocked, rules, state.first), TaskTree.NO_NODE, 0.0)]
        if state.first != _ANY:
            met = [child for child in met if child == state.first]
            if not met:
                return [(Automaton.VIOLATED, TaskTree.NO_NODE, 0.0)]
        met.sort(key=lambda child: (-self.reach[child].bit_count(), child))
        return [self._take(state, labels, child) for child in met]

    def _take(self, state: _State, labels: int, child: int) -> _Move:
        rules, bonus = self.forward(child, state.rules, labels, self.reach[child])
        if self.accepting[child]:
            return Automaton.SATISFIED, child, self.completion + self.subtask + bonus
        return _State(child, 0, rules, _ANY), child, self.subtask + bonus

    def forward(
        self, node: int, rules: tuple[int, ...], labels: int, reached: int | None
    ) -> tuple[tuple[int, ...], float]:
        """Next states of the bonus rules and their reward, given labels and the reach set of the edge taken, if any."""
        after, paid = [], 0.0
        for (first, second, avoid, bonus), rule in zip(self.bonuses, rules, strict=True):
            if rule == _WAITING and avoid & labels:
                rule = _OVER
            elif rule == _WAITING and reached is not None and reached & first:
                rule = _ARMED
            elif rule == _ARMED and reached is not None and reached & second:
                rule = _OVER
                paid += bonus
            after.append(rule)
        return self.forget(node, tuple(after)), paid

    def forget(self, node: int, rules: tuple[int, ...]) -> tuple[int, ...]:
        """Merges the states of rules that no path below ``node`` can make pay: fewer states, the same rewards."""
        return tuple(
            _OVER if rule == _OVER or not can_pay[rule] else rule
            for can_pay, rule in zip(self.payable[node], rules, strict=True)
        )

    def _payable(self, node: int, rule: tuple[int, int, int, float]) -> tuple[bool, bool]:
        """Whether a waiting rule, and an armed one, can still pay on some path below ``node``."""
        first, second, _, _ = rule
        pending = [(child, False) for child in self.children[node]]
        waiting = armed = False
        while pending:
            below, seen = pending.pop()
            armed |= bool(self.reach[below] & second)
            waiting |= seen and bool(self.reach[below] & second)
            seen |= bool(self.reach[below] & first)
            pending += [(child, seen) for child in self.children[below]]
        return waiting, armed


def _mask(flags: Bool[np.ndarray, " P"]) -> int:
    """A set as the bits of an integer."""
    return sum(1 << i for i, flag in enumerate(flags) if flag)
