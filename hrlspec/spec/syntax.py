"""The syntax tree of SPECTRL (paper, "Task Specification Language"), its errors and its limits.

Tasks are :class:`Formula`: ``achieve``, ``ensuring``, ``;`` and ``or``. What ``achieve`` and ``ensuring`` take is a
:class:`Condition`: a Boolean combination of atomic propositions. Nodes are immutable, compare by content and
remember where they stood in the text.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable
from dataclasses import dataclass, field

#: Longest text that is read, in characters.
MAX_TEXT = 20_000
#: Deepest nesting of parentheses in a text and of nodes in a syntax tree; far below Python's recursion limit.
MAX_NESTING = 64
#: Most nodes of a syntax tree.
MAX_TERMS = 20_000
#: Most edges and alternatives that are handled while one formula is compiled; about a second of work.
MAX_WORK = 500_000

KEYWORDS = frozenset({"achieve", "ensuring", "and", "or", "not"})


class SpecError(ValueError):
    """A specification that is not SPECTRL, cannot be expressed as a task graph, or is too large.

    Attributes:
        message: what was found and what was expected.
        line: 1-based line, ``None`` for a formula that was not parsed from text.
        column: 1-based column in characters, ``None`` likewise.
        source: name of the text that the line is of, such as a file's; ``None`` where there is one text alone.
    """

    def __init__(
        self, message: str, line: int | None = None, column: int | None = None, source: str | None = None
    ) -> None:
        super().__init__(message, line, column, source)
        self.message = message
        self.line = line
        self.column = column
        self.source = source

    def __str__(self) -> str:
        place = None if self.line is None else f"line {self.line}, column {self.column}"
        where = ", ".join(part for part in (self.source, place) if part)
        return f"{where}: {self.message}" if where else self.message


class SpecWarning(UserWarning):
    """A specification that is legal but probably not what its author meant."""


class TooLarge(Exception):
    """A limit was exceeded, at a place that the raiser does not know; the message says which limit."""


class Budget:
    """Bounds the work of compiling one formula, so that no text can make it hang."""

    def __init__(self) -> None:
        self._left = MAX_WORK

    def spend(self, amount: int) -> None:
        """Takes ``amount``.

        Raises:
            TooLarge: if that is more than what is left.
        """
        self._left -= amount
        if self._left < 0:
            raise TooLarge(f"the task is too large: more than {MAX_WORK:,} edges and alternatives to combine")


@dataclass(frozen=True)
class Position:
    """A place in a text: 1-based line and column."""

    line: int
    column: int

    def error(self, message: str) -> SpecError:
        """A :class:`SpecError` at this place."""
        return SpecError(message, self.line, self.column)


@dataclass(frozen=True)
class Node:
    """What tasks and conditions have in common. ``position`` does not take part in comparisons."""

    position: Position | None = field(default=None, compare=False, repr=False, kw_only=True)

    def error(self, message: str) -> SpecError:
        """A :class:`SpecError` where this node stood in the text, if it came from one."""
        return SpecError(message) if self.position is None else self.position.error(message)


class Condition(Node):
    """A Boolean combination of atomic propositions."""


class Formula(Node):
    """A task."""


@dataclass(frozen=True)
class Prop(Condition):
    """An atomic proposition; its name is a Unicode identifier in normal form C and no keyword.

    Raises:
        SpecError: for any other name.
    """

    name: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", check_name(self.name, self.error))


@dataclass(frozen=True)
class Not(Condition):
    """``not operand``."""

    operand: Condition


@dataclass(frozen=True)
class And(Condition):
    """``x and y and …``, two parts or more."""

    parts: tuple[Condition, ...]


@dataclass(frozen=True)
class Or(Condition):
    """``x or y or …``, two parts or more."""

    parts: tuple[Condition, ...]


@dataclass(frozen=True)
class Achieve(Formula):
    """``achieve goal``: reach a state where the goal holds."""

    goal: Condition


@dataclass(frozen=True)
class Ensuring(Formula):
    """``task ensuring condition``: the condition holds all along."""

    task: Formula
    condition: Condition


@dataclass(frozen=True)
class Then(Formula):
    """``x; y; …``, two parts or more, one after the other."""

    parts: tuple[Formula, ...]


@dataclass(frozen=True)
class Choice(Formula):
    """``x or y or …``, two parts or more, one of them."""

    parts: tuple[Formula, ...]


def normalise(name: str) -> str:
    """The name in Unicode normal form C, so that both spellings of "é" are one name."""
    return name if name.isascii() else unicodedata.normalize("NFC", name)


def check_name(name: object, error: Callable[[str], SpecError] = SpecError) -> str:
    """The normalised name of a proposition.

    Raises:
        SpecError: made by ``error``, if it is not a Unicode identifier or is a keyword.
    """
    if not isinstance(name, str):
        raise error(f"a proposition's name is a string, found {type(name).__name__}")
    name = normalise(name)
    if not name.isidentifier():
        raise error(f"{shorten(name)} cannot name a proposition: letters, digits and '_', not starting with a digit")
    if name in KEYWORDS:
        raise error(f"{name!r} is a keyword and cannot name a proposition")
    return name


def shorten(text: str, length: int = 40) -> str:
    """``text`` in quotes, cut to a length that fits a message."""
    return repr(text if len(text) <= length else text[: length - 1] + "…")


def check(formula: Formula) -> None:
    """Checks a syntax tree, which may have been built by hand, without recursion.

    Raises:
        SpecError: if a part is of the wrong kind, missing, or if the tree is too deep or too large.
    """
    pending: list[tuple[object, type[Node], Node | None, int]] = [(formula, Formula, None, 1)]
    count = 0
    while pending:
        node, kind, parent, depth = pending.pop()
        if not isinstance(node, kind) or type(node) in (Node, Formula, Condition):
            report = SpecError if parent is None else parent.error
            raise report(f"expected a {kind.__name__}, found {type(node).__name__}")
        count += 1
        if depth > MAX_NESTING:
            raise node.error(f"nested more than {MAX_NESTING} deep")
        if count > MAX_TERMS:
            raise node.error(f"more than {MAX_TERMS:,} terms")
        pending += [(part, expected, node, depth + 1) for part, expected in _parts(node)]


def _parts(node: Node) -> list[tuple[object, type[Node]]]:
    """The children of ``node`` and the type each must have."""
    match node:
        case Achieve(goal=goal):
            return [(goal, Condition)]
        case Ensuring(task=task, condition=condition):
            return [(task, Formula), (condition, Condition)]
        case Not(operand=operand):
            return [(operand, Condition)]
        case Then(parts=parts) | Choice(parts=parts) | And(parts=parts) | Or(parts=parts):
            if not isinstance(parts, tuple) or len(parts) < 2:
                raise node.error(f"{type(node).__name__} takes a tuple of two parts or more")
            kind: type[Node] = Formula if isinstance(node, Formula) else Condition
            return [(part, kind) for part in parts]
        case _:
            return []
