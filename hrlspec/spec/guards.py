"""The transitions of an automaton with short guards, for people to read: ``a & !b`` in place of eight labels.

A guard says no more than what must hold for the labels that can occur: labels that cannot occur are told apart from
nothing. It is a disjunction of as few conjunctions as there can be, and of those with the fewest literals.

Sets of propositions are integers here, bit i standing for the i-th name in alphabetical order.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from hrlspec.spec.ltl.automaton import Automaton

Place = TypeVar("Place")
JUMP = "ε"
"""Stands for the guard of a jump, which reads no label."""


class Transition(NamedTuple):
    """All labels that lead from one state to another, or to the same.

    Attributes:
        source: the state before.
        target: the state after.
        accepting: a round of a task that goes on for ever is complete.
        guard: which labels, in the syntax of LTL; ``true`` for all that can occur, `JUMP` for a jump.
    """

    source: int
    target: int
    accepting: bool
    guard: str


class _Cube(NamedTuple):
    """A conjunction of literals: on the propositions that it names the label is this."""

    named: int
    holding: int


def transitions(automaton: Automaton) -> list[Transition]:
    """State by state; accepting transitions and jumps apart from others between the same states."""
    marks = np.zeros_like(automaton.successors) if automaton.marks is None else automaton.marks
    found = []
    for state in range(automaton.num_states):
        goes = {
            label: (int(target), bool(marked))
            for label, target, marked in zip(automaton.labels, automaton.successors[state], marks[state], strict=True)
        }
        found += [Transition(state, *place, guard) for place, guard in guards(goes).items()]
        found += [Transition(state, target, False, JUMP) for target in automaton.origins(state)[1:]]
    return found


def guards(goes: Mapping[frozenset[str], Place]) -> dict[Place, str]:
    """When each place comes next, in the syntax of LTL.

    Args:
        goes: where each label that can occur leads.
    """
    names = tuple(sorted(frozenset().union(*goes)))
    leads = {sum(1 << names.index(name) for name in label): place for label, place in goes.items()}
    for bit in (1 << i for i in range(len(names))):
        if all(leads.get(code ^ bit) == place for code, place in leads.items()):  # it makes no difference
            leads = {code: place for code, place in leads.items() if not code & bit}
    return {
        place: _text(
            frozenset(code for code, other in leads.items() if other == place),
            frozenset(code for code, other in leads.items() if other != place),
            names,
        )
        for place in dict.fromkeys(leads.values())
    }


@functools.lru_cache(maxsize=1024)  # states have many guards in common
def _text(on: frozenset[int], off: frozenset[int], names: Sequence[str]) -> str:
    """A guard of the labels ``on`` and of none of ``off``."""

    def conjunction(cube: _Cube) -> str:
        named = ((i, name) for i, name in enumerate(names) if cube.named >> i & 1)
        return " & ".join(name if cube.holding >> i & 1 else f"!{name}" for i, name in named)

    return " | ".join(map(conjunction, _cover(on, off))) or "true"


def _cover(on: Collection[int], off: Collection[int]) -> list[_Cube]:
    """The fewest conjunctions that hold on all of ``on`` and on none of ``off``, and of those the shortest."""
    from scipy.optimize import Bounds, LinearConstraint, milp  # takes a third of a second to import

    primes = sorted({_Cube(named, code & named) for code in on for named in _hitting({code ^ other for other in off})})
    covers = np.array([[code & cube.named == cube.holding for cube in primes] for code in on])
    literals = np.array([cube.named.bit_count() for cube in primes])
    cost = 1 + literals.sum() + literals  # one conjunction less counts for more than any number of literals
    chosen = milp(cost, integrality=1, bounds=Bounds(0, 1), constraints=LinearConstraint(covers.astype(float), 1)).x
    return [cube for cube, taken in zip(primes, chosen, strict=True) if taken > 0.5]


def _hitting(sets: Collection[int]) -> list[int]:
    """All minimal sets that meet each of the given ones, by Berge's algorithm."""
    found = [0]
    for one in sorted(_minimal(sets), key=int.bit_count):
        kept = [some for some in found if some & one]
        members = [1 << i for i in range(one.bit_length()) if one >> i & 1]
        wider = {some | member for some in found if not some & one for member in members}
        found = _minimal([*kept, *wider])
    return found


def _minimal(sets: Collection[int]) -> list[int]:
    """Those without another one inside."""
    kept: list[int] = []
    for one in sorted(set(sets), key=int.bit_count):
        if all(other & ~one for other in kept):
            kept.append(one)
    return kept
