"""The finite reading of a formula, from its definition, for whoever wants to check the automaton."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from hrlspec.spec.ltl.syntax import Binary, Constant, Formula, Nary, Proposition, Unary


def satisfies_ltl(formula: Formula, trace: Sequence[Collection[str]]) -> bool:
    """Whether some non-empty prefix of a trace satisfies the formula, as LTL over finite traces.

    On a prefix of n steps, at step i: ``X φ`` if i + 1 < n and φ holds at i + 1; ``φ U ψ`` if ψ holds at some k with
    i <= k < n and φ at all j with i <= j < k; ``F φ`` and ``G φ`` if φ holds at some, at all such k; ``φ R ψ`` is
    ``!(!φ U !ψ)``, ``φ W ψ`` is ``(φ U ψ) | G φ``, ``φ M ψ`` is ``(φ R ψ) & F φ``.

    Args:
        formula: the formula.
        trace: the propositions that hold after the first action, after the second, and so on.
    """
    return any(_holds(formula, trace[:n])[0] for n in range(1, len(trace) + 1))


def _holds(formula: Formula, trace: Sequence[Collection[str]]) -> list[bool]:
    """Whether the formula holds at each step of a finite trace."""
    steps = range(len(trace))
    below = [_holds(child, trace) for child in formula.children]
    match formula:
        case Constant(value):
            return [value for _ in steps]
        case Proposition(name):
            return [name in labels for labels in trace]
        case Unary("!", _):
            return [not x for x in below[0]]
        case Unary("X", _):
            return [i + 1 < len(trace) and below[0][i + 1] for i in steps]
        case Unary("F", _):
            return [any(below[0][i:]) for i in steps]
        case Unary("G", _):
            return [all(below[0][i:]) for i in steps]
        case Nary("&", _):
            return [all(column) for column in zip(*below, strict=True)]
        case Nary("|", _):
            return [any(column) for column in zip(*below, strict=True)]
        case Binary(operator, _, _):
            left, right = below
            if operator == "->":
                return [not x or y for x, y in zip(left, right, strict=True)]
            if operator == "<->":
                return [x == y for x, y in zip(left, right, strict=True)]
            if operator == "U":
                return _until(left, right)
            if operator == "W":
                return [x or all(left[i:]) for i, x in enumerate(_until(left, right))]
            released = [not x for x in _until([not x for x in left], [not x for x in right])]
            return released if operator == "R" else [x and any(left[i:]) for i, x in enumerate(released)]
    raise TypeError(f"satisfies_ltl takes a formula, found {type(formula).__name__}")


def _until(left: list[bool], right: list[bool]) -> list[bool]:
    steps = range(len(left))
    return [any(right[k] and all(left[i:k]) for k in steps[i:]) for i in steps]
