"""The syntax tree of linear temporal logic. Nodes are immutable, compare by content and remember their place."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from typing import Literal

from hrlspec.spec.syntax import Node, shorten

UnaryOperator = Literal["!", "X", "F", "G"]
BinaryOperator = Literal["U", "R", "W", "M", "->", "<->"]
NaryOperator = Literal["&", "|"]

MAX_DEPTH = 200
"""Deepest nesting of a formula; traversals are recursive, and this is far below Python's limit."""

NAME = re.compile(r"[^\W\d]\w*")
OPERATOR_LETTERS = "XFGURWM"


class Formula(Node):
    """A formula of linear temporal logic."""

    @property
    def children(self) -> tuple[Formula, ...]:
        """The operands, from left to right."""
        return ()


@dataclasses.dataclass(frozen=True)
class Constant(Formula):
    """``true`` or ``false``."""

    value: bool


@dataclasses.dataclass(frozen=True)
class Proposition(Formula):
    """An atomic proposition.

    Raises:
        SpecError: for a name that is no identifier, or that reads as an operator or a constant.
    """

    name: str

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name) or is_keyword(self.name):
            raise self.error(f"{shorten(self.name)} cannot name a proposition in LTL")


@dataclasses.dataclass(frozen=True)
class Unary(Formula):
    """``!`` not, ``X`` next (strong: there is a next step), ``F`` finally, ``G`` globally."""

    operator: UnaryOperator
    operand: Formula

    @property
    def children(self) -> tuple[Formula, ...]:
        """The operand."""
        return (self.operand,)


@dataclasses.dataclass(frozen=True)
class Binary(Formula):
    """``U`` until, ``R`` release, ``W`` weak until, ``M`` strong release, ``->`` implies, ``<->`` if and only if."""

    operator: BinaryOperator
    left: Formula
    right: Formula

    @property
    def children(self) -> tuple[Formula, ...]:
        """Left and right."""
        return (self.left, self.right)


@dataclasses.dataclass(frozen=True)
class Nary(Formula):
    """``&`` and, ``|`` or, of two parts or more."""

    operator: NaryOperator
    parts: tuple[Formula, ...]

    @property
    def children(self) -> tuple[Formula, ...]:
        """The parts."""
        return self.parts


def is_keyword(word: str) -> bool:
    """Whether a word is a constant, or operators written without spaces, such as ``GF``."""
    return word in ("true", "false") or (bool(word) and all(letter in OPERATOR_LETTERS for letter in word))


def subformulas(formula: Formula) -> Iterator[Formula]:
    """The formula and all below it, parents first; a node that several others share comes once."""
    stack, seen = [formula], {id(formula)}
    while stack:
        node = stack.pop()
        yield node
        fresh = {id(child): child for child in node.children if id(child) not in seen}
        seen |= fresh.keys()
        stack.extend(reversed(fresh.values()))


def propositions_of(formula: Formula) -> tuple[str, ...]:
    """The names that occur, sorted."""
    return tuple(sorted({node.name for node in subformulas(formula) if isinstance(node, Proposition)}))
