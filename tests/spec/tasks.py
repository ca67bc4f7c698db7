"""Random formulas, names and traces for the tests of the language."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from hrlspec.spec import (
    Achieve,
    And,
    Choice,
    Condition,
    Ensuring,
    Formula,
    Not,
    Or,
    Prop,
    Then,
)

NAMES = ["a", "b", "c", "d", "e"]
UNICODE_NAMES = [*NAMES, "é", "ζ_1", "红", "achieved", "order", "_", "e\u0301tage"]


def _parts(items: st.SearchStrategy) -> st.SearchStrategy[tuple]:
    return st.lists(items, min_size=2, max_size=3).map(tuple)


def conditions(names: list[str] = UNICODE_NAMES) -> st.SearchStrategy[Condition]:
    return st.recursive(
        st.sampled_from(names).map(Prop),
        lambda inner: inner.map(Not) | _parts(inner).map(And) | _parts(inner).map(Or),
        max_leaves=6,
    )


def formulas(names: list[str] = UNICODE_NAMES) -> st.SearchStrategy[Formula]:
    return st.recursive(
        conditions(names).map(Achieve),
        lambda inner: (
            _parts(inner).map(Then) | _parts(inner).map(Choice) | st.builds(Ensuring, inner, conditions(names))
        ),
        max_leaves=10,
    )


def goal(rng: np.random.Generator, names: list[str]) -> Condition:
    """What ``achieve`` may take: a proposition, now and then a conjunction or disjunction."""
    chosen = [Prop(str(name)) for name in rng.permutation(names)[:3]]
    kind = rng.random()
    if kind < 0.7:
        return chosen[0]
    if kind < 0.85:
        return And(tuple(chosen[:2]))
    return Or((chosen[0], And(tuple(chosen[1:])))) if kind < 0.92 else Or(tuple(chosen[:2]))


def harm(rng: np.random.Generator, names: list[str]) -> Condition:
    """What ``ensuring`` may take."""
    chosen = [Prop(str(name)) for name in rng.permutation(names)[: rng.integers(1, 3)]]
    if len(chosen) == 1:
        return Not(chosen[0])
    return Not(Or(tuple(chosen))) if rng.random() < 0.5 else And(tuple(map(Not, chosen)))


def random_formula(rng: np.random.Generator, depth: int, names: list[str] = NAMES) -> Formula:
    """A formula that ``compile_task`` takes unless it is too large or can never be done; at most ``depth`` deep."""
    kind = rng.random()
    if depth <= 1 or kind < 0.05:
        return Achieve(goal(rng, names))
    if kind < 0.35:
        return Ensuring(random_formula(rng, depth - 1, names), harm(rng, names))
    parts = tuple(random_formula(rng, depth - 1, names) for _ in range(2))
    return Then(parts) if kind < 0.7 else Choice(parts)


def nesting(formula: Formula) -> int:
    """How deep tasks are nested in tasks; 1 for an ``achieve``."""
    match formula:
        case Ensuring(task=task):
            return 1 + nesting(task)
        case Then(parts=parts) | Choice(parts=parts):
            return 1 + max(map(nesting, parts))
        case _:
            return 1
