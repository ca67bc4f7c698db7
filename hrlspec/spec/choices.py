"""Büchi automata as others write them, with choices of any kind: made to leave no choices but jumps.

An edge without a guard takes no step: a jump. Where several edges are open to a label, one is taken unless the agent
jumps to a place that takes another one; if possible one after which something is left to choose, so that not to choose
is to wait.

Axes: **Q** places, **L** labels.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Int

from hrlspec.spec.ltl.merging import Jumps, explore
from hrlspec.spec.syntax import Position

Label: TypeAlias = frozenset[str]
Guard: TypeAlias = Callable[[Label], bool]
_Place: TypeAlias = tuple[int, int]
"""A state, and which of the edges that are open to a label is taken there: 0 the usual one, or once another one."""
_NOWHERE: _Place = (-1, 0)


@dataclasses.dataclass(frozen=True)
class Edge:
    """What leads from a state to another.

    Attributes:
        position: in the text.
        guard: the labels that it reads; ``None`` if it reads none and takes no step.
        target: the state that follows.
        marked: whether it accepts.
    """

    position: Position
    guard: Guard | None
    target: int
    marked: bool


def with_jumps(
    start: int, states: Sequence[Sequence[Edge]], labels: Sequence[Label]
) -> tuple[Int[np.ndarray, "Q L"], Bool[np.ndarray, "Q L"], Jumps]:
    """Successors, marks and jumps of all places that can be reached, the first of which is the start.

    Args:
        start: the initial state.
        states: the edges of each state.
        labels: the L possible labels.

    Raises:
        SpecError: there are too many places.
    """
    reached = _reached(start, states, labels)
    waits = _may_choose(reached)
    nothing = _Ways([[]] * len(labels), [])

    def after(place: _Place, label: int) -> tuple[_Place, bool]:
        state, which = place
        options = sorted(reached.get(state, nothing).options[label], key=lambda edge: edge.target not in waits)
        return ((options[which].target, 0), options[which].marked) if which < len(options) else (_NOWHERE, False)

    def jumps(place: _Place) -> list[_Place]:
        state, which = place
        ways = reached.get(state, nothing)
        others = [(state, other) for other in range(1, max(map(len, ways.options)))]
        return [] if which else [(edge.target, 0) for edge in ways.jumps] + others

    return explore((start, 0), after, jumps, len(labels))


class _Ways(NamedTuple):
    """What a state may do: the different edges open to each label, and those that take no step."""

    options: list[list[Edge]]
    jumps: list[Edge]

    @property
    def targets(self) -> set[int]:
        """The states that may follow."""
        return {edge.target for edge in itertools.chain(self.jumps, *self.options)}


def _reached(start: int, states: Sequence[Sequence[Edge]], labels: Sequence[Label]) -> dict[int, _Ways]:
    """The ways of all states that can be reached."""
    found: dict[int, _Ways] = {}
    queue = [start]
    for state in queue:  # Grows while it is read.
        if state in found:
            continue
        options = []
        for label in labels:
            edges = [edge for edge in states[state] if edge.guard is not None and edge.guard(label)]
            options.append(list({(edge.target, edge.marked): edge for edge in edges[::-1]}.values())[::-1])
        found[state] = _Ways(options, [edge for edge in states[state] if edge.guard is None])
        queue += found[state].targets
    return found


def _may_choose(reached: Mapping[int, _Ways]) -> set[int]:
    """The states in which there is a choice, now or later."""
    found = {state for state, ways in reached.items() if ways.jumps or max(map(len, ways.options)) > 1}
    while wider := {state for state, ways in reached.items() if ways.targets & found} - found:
        found |= wider
    return found
