"""Conditions of an automaton's transitions in words, for people. Axes: **L** labels, **P** atomic propositions."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Int

Literals = tuple[tuple[int, bool], ...]
"""Propositions by index, and whether each holds or not."""


def guards(holds: Bool[np.ndarray, "L P"], leads: Int[np.ndarray, " L"], names: Sequence[str]) -> dict[int, str]:
    """When each place that a state's labels lead to comes next, such as ``a and not b or c``.

    Args:
        holds: the propositions of each label that can occur; no two are the same.
        leads: where each label leads.
        names: of the P propositions.

    Returns:
        A condition for each of the places, ``always`` where there is but one. Of labels that cannot occur it may say
        anything.
    """
    matter = _that_matter(holds, leads)
    return {int(place): _cover(holds, leads == place, matter, names) for place in np.unique(leads)}


def _that_matter(holds: Bool[np.ndarray, "L P"], leads: Int[np.ndarray, " L"]) -> list[int]:
    """Propositions that tell all places apart, none of which can be done without."""
    kept = list(range(holds.shape[1]))
    for proposition in reversed(range(holds.shape[1])):
        rest = [x for x in kept if x != proposition]
        seen = np.unique(holds[:, rest], axis=0)
        if len(seen) == len(np.unique(np.column_stack([holds[:, rest], leads]), axis=0)):
            kept = rest
    return kept


def _cover(
    holds: Bool[np.ndarray, "L P"], wanted: Bool[np.ndarray, " L"], matter: list[int], names: Sequence[str]
) -> str:
    """Few and short conjunctions that hold of the wanted labels and of no other."""
    missing, chosen = wanted.copy(), []
    for literals in _conjunctions(matter):
        met = np.ones(len(holds), bool)
        for proposition, value in literals:
            met &= holds[:, proposition] == value
        if (met & missing).any() and not (met & ~wanted).any():
            missing &= ~met
            chosen.append(" and ".join(names[x] if value else f"not {names[x]}" for x, value in literals) or "always")
        if not missing.any():
            break
    return " or ".join(chosen)


def _conjunctions(propositions: Sequence[int]) -> Iterator[Literals]:
    """All of them, the shortest first and of these what holds before what does not."""
    for size in range(len(propositions) + 1):
        for values in sorted(itertools.product((True, False), repeat=size), key=lambda some: some.count(False)):
            for some in itertools.combinations(propositions, size):
                yield tuple(zip(some, values, strict=True))
