"""States of automata with accepting transitions: all there are, which can still accept, and which are the same.

Axes: **Q** states, **L** labels.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import TypeAlias, TypeVar

import numpy as np
from jaxtyping import Bool, Int, Int32

from hrlspec.spec.ltl.translate import MAX_STATES
from hrlspec.spec.syntax import SpecError

Jumps: TypeAlias = tuple[tuple[int, ...], ...]
"""To which states each state may jump."""


State = TypeVar("State", bound=Hashable)


def explore(
    start: State,
    after: Callable[[State, int], tuple[State, bool]],
    jumps: Callable[[State], Iterable[State]],
    num_labels: int,
) -> tuple[Int[np.ndarray, "Q L"], Bool[np.ndarray, "Q L"], Jumps]:
    """Successors, marks and jumps of all states that can be reached, the first of which is the start.

    Args:
        start: the initial state.
        after: the state after a label, by its number, and whether the transition accepts.
        jumps: to which states one may jump.
        num_labels: L.

    Raises:
        SpecError: there are more than `MAX_STATES`.
    """
    numbers, states = {start: 0}, [start]

    def number(state: State) -> int:
        if state not in numbers:
            if len(states) == MAX_STATES:
                raise SpecError(f"the task is too large: its automaton has more than {MAX_STATES:,} states")
            numbers[state] = len(states)
            states.append(state)
        return numbers[state]

    successors: list[list[int]] = []
    marks: list[list[bool]] = []
    targets: list[tuple[int, ...]] = []
    for state in states:  # Grows while it is read.
        found = [after(state, label) for label in range(num_labels)]
        successors.append([number(target) for target, _ in found])
        marks.append([marked for _, marked in found])
        targets.append(tuple(map(number, jumps(state))))
    return np.array(successors), np.array(marks), tuple(targets)


def alive_states(
    successors: Int[np.ndarray, "Q L"], marks: Bool[np.ndarray, "Q L"], jumps: Jumps
) -> Bool[np.ndarray, " Q"]:
    """From which states some continuation takes accepting transitions for ever, bool ``[Q]``."""
    alive = np.ones(len(successors), bool)
    while True:  # A largest fixed point: another round can be completed in a state from which that is so.
        found: Bool[np.ndarray, " Q"] = np.asarray((marks & alive[successors]).any(1))
        while True:
            wider = found | found[successors].any(1)
            for state, targets in enumerate(jumps):
                wider[state] |= any(wider[target] for target in targets)
            if np.array_equal(wider, found):
                break
            found = wider
        if np.array_equal(found, alive):
            return alive
        alive = found


def merged(
    successors: Int[np.ndarray, "Q L"], marks: Bool[np.ndarray, "Q L"], jumps: Jumps
) -> tuple[Int32[np.ndarray, "Q L"], Bool[np.ndarray, "Q L"], Jumps, int | None]:
    """Merges states that no continuation tells apart, numbered as they are reached; and which one is rejecting, if any.

    Rejecting is whatever accepts no continuation; no transition to it accepts, and jumps to it are left out.
    """
    jumping = [state for state, targets in enumerate(jumps) if targets]
    alive = alive_states(successors, marks, jumps)
    marks = marks & alive[successors] & alive[:, None]

    def elsewhere(state: int) -> tuple[int, ...]:
        """The kinds to which a state may jump."""
        kinds = dict.fromkeys(int(kind[target]) for target in jumps[state] if alive[target])
        return tuple(other for other in kinds if other != kind[state])

    kind = np.unique(np.column_stack([alive, marks]), axis=0, return_inverse=True)[1].reshape(-1)
    while True:
        choices = np.zeros_like(kind)
        numbers: dict[tuple[int, ...], int] = {(): 0}
        for state in jumping:
            choices[state] = numbers.setdefault(tuple(sorted(elsewhere(state))), len(numbers))
        seen = np.column_stack([kind, kind[successors], choices])
        finer = np.unique(seen, axis=0, return_inverse=True)[1].reshape(-1)
        if finer.max() == kind.max():
            break
        kind = finer
    example = dict(zip(*np.unique(kind, return_index=True), strict=True))
    number, order = {int(kind[0]): 0}, [int(kind[0])]
    for group in order:  # Grows while it is read.
        row = example[group]
        for after in (*kind[successors[row]].tolist(), *elsewhere(row)):
            if after not in number:
                number[after] = len(order)
                order.append(after)
    rows = [int(example[group]) for group in order]
    dead = [place for place, row in enumerate(rows) if not alive[row]]
    table = np.array([[number[group] for group in kind[successors[row]].tolist()] for row in rows], np.int32)
    onward = tuple(tuple(number[group] for group in elsewhere(row)) for row in rows)
    return table, marks[rows], onward, dead[0] if dead else None
