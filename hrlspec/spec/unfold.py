"""From an automaton to task trees: what the agent is shown in each state.

In a state q that is a tree rooted at q: useful simple paths to acceptance (of a task that goes on for ever: to its next
accepting transition), shortest first. A move is useful unless whatever is accepted after it would have been accepted
without it. A sub-task's p₊ is the least that must hold for the automaton to move, its p₋ what takes the way on from it.
A move may begin with a jump: the agent that chose it jumps where p₊ comes to hold, so that this is read after the jump.
Where after a move something must hold at every step, p₊ is to be held.

Axes: **Q** states, **L** labels, **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

import collections
import dataclasses
import heapq
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int32

from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.tree import TaskTree

Label = frozenset[str]


class Move(NamedTuple):
    """A step of the automaton that a sub-task can ask for.

    Attributes:
        reach: p₊, propositions that hold together.
        avoid: p₋ without what other moves of the state reach.
        origin: the state that reads it: that from which it is made, or one to which this jumps.
        target: the state that it leads to.
    """

    reach: Label
    avoid: Label
    origin: int
    target: int


class Unfolded(NamedTuple):
    """What the agent is shown in each state of an automaton.

    Attributes:
        trees: leading axis Q; numpy leaves. In a state without moves the tree is a root without children. Of an edge
            at the root whose p₊ is to be held for ever ``hold`` is 2, else 1.
        cut: bool ``[Q]``, paths were left out because N nodes are too few.
        silent: bool ``[Q]``, a way on is left out because it begins where nothing holds, which no sub-task can ask for.
        origin: int32 ``[Q, N]``, of each edge at the root the state that reads what meets it: q, unless it begins with
            a jump; q also for all other nodes.
    """

    trees: TaskTree
    cut: Bool[np.ndarray, " Q"]
    silent: Bool[np.ndarray, " Q"]
    origin: Int32[np.ndarray, "Q N"]


def unfold(automaton: Automaton, propositions: Sequence[str], max_nodes: int) -> Unfolded:
    """The task tree of each state of an automaton.

    Args:
        automaton: over these propositions.
        propositions: names of the P propositions.
        max_nodes: N, padded size of the trees.
    """
    moves = _Moves(automaton if automaton.marks is None else _until_accepting(automaton, automaton.marks))
    rows, cut = [], []
    origin = np.repeat(np.arange(automaton.num_states, dtype=np.int32)[:, None], max_nodes, 1)
    hold = np.ones_like(origin)
    for state in range(automaton.num_states):
        nodes, complete = _paths(moves, state, max_nodes)
        rows.append(_tree(nodes, propositions, max_nodes))
        cut.append(not complete)
        for number, path in enumerate(nodes):
            if len(path) == 1:
                origin[state, number] = path[0].origin
                hold[state, number] += _stays(automaton, path[0])
    trees: TaskTree = dataclasses.replace(jax.tree.map(lambda *x: np.stack(x), *rows), hold=hold)
    silent = np.array([moves.silent(state) for state in range(automaton.num_states)])
    return Unfolded(trees, np.array(cut), silent & ~_rests(automaton), origin)


def _stays(automaton: Automaton, move: Move) -> bool:
    """Whether after a move its p₊ may hold for ever, and nothing may not."""
    if automaton.marks is None or frozenset() not in automaton.labels:
        return False
    here, nothing = (automaton.labels.index(label) for label in (move.reach, frozenset[str]()))
    after = automaton.successors[automaton.successors[move.origin, here]]
    return bool(after[nothing] == automaton.rejecting != after[here])


def _rests(automaton: Automaton) -> Bool[np.ndarray, " Q"]:
    """States in which rounds go by while nothing holds: nothing need be done there."""
    empty: Label = frozenset()
    if automaton.marks is None or empty not in automaton.labels:
        return np.zeros(automaton.num_states, bool)
    column = automaton.labels.index(empty)
    stays = automaton.successors[:, column] == np.arange(automaton.num_states)
    return np.asarray(automaton.marks[:, column] & stays)


def _until_accepting(automaton: Automaton, marks: Bool[np.ndarray, "Q L"]) -> Automaton:
    """Where a task that goes on for ever has a round to complete: its accepting transitions lead to one more state."""
    accepting = automaton.num_states
    successors = np.where(marks, accepting, automaton.successors)
    successors = np.vstack([successors, np.full_like(successors[:1], accepting)])
    jumps = (*automaton.jumps, ()) if automaton.jumps else ()
    return Automaton(automaton.labels, successors.astype(np.int32), accepting, automaton.rejecting, jumps=jumps)


class _Moves:
    """The moves of each state, and how far acceptance is."""

    def __init__(self, automaton: Automaton) -> None:
        self.automaton = automaton
        self.after = {label: automaton.successors[:, column].tolist() for column, label in enumerate(automaton.labels)}
        self.origins = [automaton.origins(state) for state in range(automaton.num_states)]
        self._known: dict[int, tuple[Move, ...]] = {}
        self.distance = self._distances()
        self.within = self._inclusions()

    def of(self, state: int) -> tuple[Move, ...]:
        """The useful moves of a state, those that ask for least first."""
        if state not in self._known:
            self._known[state] = self._found(state)
        return self._known[state]

    def _found(self, state: int) -> tuple[Move, ...]:
        ways: dict[tuple[int, int], list[Label]] = collections.defaultdict(list)
        for label in self.after:
            if label:
                for way in self._ways(state, label):
                    ways[way].append(label)
        moves = []
        for (origin, target), labels in ways.items():
            least = [label for label in labels if not any(other < label for other in labels)]
            moves += [Move(label, self._avoid(state, label, origin, target), origin, target) for label in least]
        return tuple(sorted(moves, key=lambda move: (len(move.reach), sorted(move.reach))))

    def silent(self, state: int) -> bool:
        """Whether a useful move begins where nothing holds."""
        nothing: Label = frozenset()
        return nothing in self.after and bool(self._ways(state, nothing))

    def _ways(self, state: int, label: Label) -> list[tuple[int, int]]:
        """Useful moves by a label, as the states that read it and those that follow; of jumps, those worth a jump."""
        after, found = self.after[label], list[tuple[int, int]]()
        for origin in self.origins[state]:
            target = after[origin]
            if self._is_useful(state, target) and not any(self.within[target, other] for _, other in found):
                found = [way for way in found if not self.within[way[1], target]]
                found.append((origin, target))
        return found

    def _is_useful(self, state: int, target: int) -> bool:
        """Whether acceptance can be reached after a move, and something is accepted that was not before."""
        return target in self.distance and not self.within[target, state]

    def _avoid(self, state: int, reach: Label, origin: int, target: int) -> Label:
        """All that holds, besides p₊, where the automaton goes astray.

        That is where it does not go where p₊ leads to, although p₊ holds; and where it goes to a state from which p₊
        leads to less.
        """
        harmful = set()
        for label, after in self.after.items():
            if label >= reach:
                onward = [after[origin]]
            else:
                onward = [self.after[reach][other] for other in self.origins[after[state]]]
            if not any(self.within[target, other] for other in onward):
                harmful.add(label - reach)
        # Where nothing at all holds cannot be avoided by avoiding something.
        harmful.discard(frozenset())
        # Clear of the least that does harm it is clear of all that holds besides.
        return frozenset().union(*(some for some in harmful if not any(other < some for other in harmful)))

    def _inclusions(self) -> Bool[np.ndarray, "Q Q"]:
        """Entry (q, r): what is accepted from q is accepted from r, step by step; the largest such relation."""
        successors, states = self.automaton.successors, np.arange(self.automaton.num_states)
        accepting = states == self.automaton.accepting
        within = ~accepting[:, None] | accepting
        different = np.unique(successors.T, axis=0)  # many labels make no difference
        jumping = [state for state in states.tolist() if len(self.origins[state]) > 1]
        while True:
            narrower = within.copy()
            for after in different:
                less = within[np.ix_(after, after)]
                if jumping:
                    less = np.column_stack([less[:, origins].any(1) for origins in self.origins])
                narrower &= less
            for state in jumping:
                narrower[state] &= within[list(self.origins[state])].all(0)
            if np.array_equal(narrower, within):
                return within
            within = narrower

    def _distances(self) -> dict[int, int]:
        """Least moves to acceptance, of the states from which it can be reached where something holds at each."""
        accepting = self.automaton.accepting
        if accepting is None:
            return {}
        found, queue = {accepting: 0}, collections.deque([accepting])
        before: dict[int, set[int]] = collections.defaultdict(set)
        for label, after in self.after.items():
            for state, origins in enumerate(self.origins if label else ()):
                for origin in origins:
                    if state != after[origin]:
                        before[after[origin]].add(state)
        while queue:
            state = queue.popleft()
            for earlier in before[state] - found.keys():
                found[earlier] = found[state] + 1
                queue.append(earlier)
        return found


_Path = tuple[Move, ...]


def _paths(moves: _Moves, start: int, max_nodes: int) -> tuple[list[_Path], bool]:
    """Nodes of the tree, each by the path to it, parents first; and whether all paths found room."""
    nodes: dict[_Path, None] = {(): None}
    complete = True
    for path in _simple_paths(moves, start):
        prefixes = [path[:length] for length in range(1, len(path) + 1)]
        new = [prefix for prefix in prefixes if prefix not in nodes]
        if len(nodes) + len(new) > max_nodes:
            complete = False
            break
        nodes.update(dict.fromkeys(new))
    return sorted(nodes, key=len), complete


def _simple_paths(moves: _Moves, start: int) -> Iterator[_Path]:
    """Paths to acceptance that visit no state twice, shortest first; never more of them than are asked for."""
    accepting = moves.automaton.accepting
    if start not in moves.distance or start == accepting:
        return
    count = itertools.count()
    queue: list[tuple[int, int, int, _Path]] = [(moves.distance[start], 0, next(count), ())]
    while queue:
        _, _, _, path = heapq.heappop(queue)
        here = path[-1].target if path else start
        if here == accepting:
            yield path
            continue
        visited = {start, *(move.target for move in path)}
        for move in moves.of(here):
            if move.target not in visited:
                length = len(path) + 1
                bound = length + moves.distance[move.target]
                heapq.heappush(queue, (bound, -length, next(count), (*path, move)))


def _tree(nodes: Sequence[_Path], propositions: Sequence[str], max_nodes: int) -> TaskTree:
    """A tree with numpy leaves, padded."""
    index = {path: number for number, path in enumerate(nodes)}
    parent = np.full(max_nodes, TaskTree.NO_NODE, np.int32)
    reach, avoid = np.zeros((2, max_nodes, len(propositions)), bool)
    depth = np.zeros(max_nodes, np.int32)
    place = {name: column for column, name in enumerate(propositions)}
    for path, node in index.items():
        if path:
            parent[node], depth[node] = index[path[:-1]], len(path)
            reach[node, [place[name] for name in path[-1].reach]] = True
            avoid[node, [place[name] for name in path[-1].avoid]] = True
    valid = np.arange(max_nodes) < len(nodes)
    inner = np.zeros(max_nodes, bool)
    inner[parent[parent >= 0]] = True
    leaves: dict[str, Any] = {
        "parent": parent,
        "reach": reach,
        "avoid": avoid,
        "accepting": valid & ~inner & (parent >= 0),
        "valid": valid,
        "depth": depth,
    }
    return TaskTree(**leaves)
