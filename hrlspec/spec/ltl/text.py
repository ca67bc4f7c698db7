"""Syntax tree to text, which `parse_ltl` reads back as the same tree."""

from __future__ import annotations

from hrlspec.spec.ltl.syntax import Binary, Constant, Formula, Nary, Proposition, Unary


def ltl_text(formula: Formula) -> str:
    """The formula as text, with parentheses around every compound operand."""
    match formula:
        case Constant(value):
            return "true" if value else "false"
        case Proposition(name):
            return name
        case Unary(operator, operand):
            return f"{operator}{'' if operator == '!' else ' '}{_operand(operand)}"
        case Binary(operator, left, right):
            return f"{_operand(left)} {operator} {_operand(right)}"
        case Nary(operator, parts):
            return f" {operator} ".join(map(_operand, parts))
    raise TypeError(f"ltl_text takes a formula, found {type(formula).__name__}")


def _operand(formula: Formula) -> str:
    text = ltl_text(formula)
    return f"({text})" if isinstance(formula, Binary | Nary) else text
