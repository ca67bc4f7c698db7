"""The exact semantics of SPECTRL on finite traces (paper, "Task Specification Language", rules 1 to 4).

A segment of a trace is a half-open range of steps. For every formula and every first step, the set of ends
at which the formula holds is one Python integer, bit ``e`` standing for the segment that ends before step e.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from hrlspec.spec.syntax import (
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
    check,
    normalise,
)


def satisfies(formula: Formula, trace: Sequence[Collection[str]]) -> bool:
    """Whether some prefix of the trace satisfies the formula.

    1. ``achieve b`` holds on a segment if ``b`` holds at one of its steps;
    2. ``φ ensuring b`` if φ does and ``b`` holds at all of its steps;
    3. ``φ1; φ2`` if the segment splits into one of φ1 and, from the very next step, one of φ2;
    4. ``φ1 or φ2`` if one of them does.

    This accepts whatever the monitor calls satisfied, and more: the monitor commits to its first visits.
    Takes time cubic in the length of the trace, with a small constant, and linear in the size of the formula.

    Args:
        formula: any formula, also such as ``compile_task`` refuses.
        trace: the labels of s₁…s_h, one set of names per step after the first action; nothing of s₀.

    Raises:
        SpecError: if the formula is malformed.
        TypeError: if a step of the trace is not a set of names.
    """
    check(formula)
    holds: dict[str, int] = {}
    for i, names in enumerate(trace):
        if isinstance(names, str | bytes):
            raise TypeError(f"step {i} of the trace is {names!r}, expected a set of names")
        for name in map(normalise, names):
            holds[name] = holds.get(name, 0) | 1 << i
    return _ends(formula, holds, len(trace))[0] != 0


def _ends(formula: Formula, holds: dict[str, int], length: int) -> list[int]:
    """For each first step 0..length, the ends at which the formula holds, as bits."""
    match formula:
        case Achieve(goal=goal):
            every_end = (1 << (length + 1)) - 1
            first = _first_at_or_after(_steps(goal, holds, length), length)
            # A segment that starts at or before step i and ends after it.
            return [0 if i == length else every_end & (-1 << (i + 1)) for i in first]
        case Ensuring(task=task, condition=condition):
            harm = ~_steps(condition, holds, length) & ((1 << length) - 1)
            first = _first_at_or_after(harm, length)
            return [ends & ((1 << (i + 1)) - 1) for ends, i in zip(_ends(task, holds, length), first, strict=True)]
        case Then(parts=parts):
            result = _ends(parts[-1], holds, length)
            for part in reversed(parts[:-1]):
                result = [_union_at(ends, result) for ends in _ends(part, holds, length)]
            return result
        case Choice(parts=parts):
            result = [0] * (length + 1)
            for part in parts:
                result = [a | b for a, b in zip(result, _ends(part, holds, length), strict=True)]
            return result
        case _:
            raise TypeError(type(formula).__name__)


def _union_at(middles: int, after: list[int]) -> int:
    """Ends of what follows, from each of the steps where the first part may end."""
    union = 0
    while middles:
        lowest = middles & -middles
        union |= after[lowest.bit_length() - 1]
        middles ^= lowest
    return union


def _first_at_or_after(steps: int, length: int) -> list[int]:
    """For each step 0..length the first one of ``steps`` from there on, ``length`` if there is none."""
    first = [length] * (length + 1)
    for i in reversed(range(length)):
        first[i] = i if steps >> i & 1 else first[i + 1]
    return first


def _steps(condition: Condition, holds: dict[str, int], length: int) -> int:
    """The steps at which a condition holds, as bits."""
    everywhere = (1 << length) - 1
    match condition:
        case Prop(name=name):
            return holds.get(name, 0)
        case Not(operand=operand):
            return everywhere & ~_steps(operand, holds, length)
        case And(parts=parts):
            result = everywhere
            for part in parts:
                result &= _steps(part, holds, length)
            return result
        case Or(parts=parts):
            result = 0
            for part in parts:
                result |= _steps(part, holds, length)
            return result
        case _:
            raise TypeError(type(condition).__name__)
