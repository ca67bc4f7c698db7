"""Text to syntax tree, where the grammars in use agree.

    formula = operand { binary operand }
    operand = { "!" | "X" | "F" | "G" } ( name | "true" | "false" | "(" formula ")" )
    binary  = "&" | "|" | "U" | "R" | "W" | "M" | "->" | "=>" | "<->"

Unary operators bind most tightly, then U, R, W and M, then ``&``, then ``|``. Two grammars are in use, and they differ:
implication binds as tightly as U in one and most loosely in the other, and U groups to the left in one and to the right
in the other. What they read alike is read (``a -> b U c``); what they read differently needs parentheses and is refused
without.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from typing import cast

from hrlspec.spec.ltl.syntax import (
    MAX_DEPTH,
    NAME,
    Binary,
    BinaryOperator,
    Constant,
    Formula,
    Nary,
    NaryOperator,
    Proposition,
    Unary,
    UnaryOperator,
    is_keyword,
)
from hrlspec.spec.syntax import MAX_TEXT, Position, SpecError
from hrlspec.spec.tokens import END, Cursor, Token

_UNARY = "!XFG"
_TEMPORAL = ("U", "R", "W", "M")
_ARROWS = ("->", "<->")
_SYMBOL = re.compile(r"<->|[-=]>|[!&|()]")
_SPACE = re.compile(r"\s+")


@dataclasses.dataclass(frozen=True)
class _Token(Token):
    """An operator, a parenthesis, a constant, a name or the end."""

    @property
    def is_binary(self) -> bool:
        return self.text in ("&", "|", *_TEMPORAL, *_ARROWS)


def parse_ltl(text: str) -> Formula:
    """Reads one formula.

    Args:
        text: see the module; ``=>`` is ``->``, and unary operators may stand together, as in ``GF a``.

    Raises:
        SpecError: with line, column, what was found and what was expected; where the grammars in use disagree; beyond
            the limits on length and nesting.
        TypeError: if ``text`` is no string.
    """
    if not isinstance(text, str):
        raise TypeError(f"parse_ltl takes a string, found {type(text).__name__}")
    if len(text) > MAX_TEXT:
        raise SpecError(f"the text has {len(text):,} characters, at most {MAX_TEXT:,} are read", 1, 1)
    return _Parser(_tokens(text)).whole()


def _tokens(text: str) -> list[_Token]:
    """Splits the text, ending with an empty token."""
    tokens: list[_Token] = []
    line, line_start, i = 1, 0, 0
    while i < len(text):
        position = Position(line, i - line_start + 1)
        if space := _SPACE.match(text, i):
            i = space.end()
            if newlines := space[0].count("\n"):
                line, line_start = line + newlines, text.rindex("\n", 0, i) + 1
            continue
        match = _SYMBOL.match(text, i) or NAME.match(text, i)
        if match is None:
            raise position.error(f"found {text[i]!r}, expected a proposition, an operator or a parenthesis")
        word, i = match[0], match.end()
        if is_keyword(word) and word not in ("true", "false"):
            tokens += [_Token(x, Position(line, position.column + k)) for k, x in enumerate(word)]
        else:
            tokens.append(_Token("->" if word == "=>" else word, position))
    tokens.append(_Token(END, Position(line, i - line_start + 1)))
    return tokens


class _Parser(Cursor[_Token]):
    """Recursive descent; recursion happens at parentheses and unary operators, and those are counted."""

    def __init__(self, tokens: list[_Token]) -> None:
        super().__init__(tokens)
        self.depth = 0

    def take(self) -> _Token:
        self.index += 1
        return self.tokens[self.index - 1]

    def whole(self) -> Formula:
        if self.token.text == END:
            raise self.token.unexpected("a formula, such as 'F (a & F b)'")
        formula = self.formula()
        if self.token.text != END:
            raise self.token.unexpected("an operator between two formulas or the end of the text")
        return formula

    def formula(self) -> Formula:
        operands, operators = [self.operand()], []
        while self.token.is_binary:
            operators.append(self.take())
            operands.append(self.operand())
        return _grouped(operands, operators)

    def operand(self) -> Formula:
        token = self.take()
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise token.position.error(f"operators and parentheses nested more than {MAX_DEPTH} deep")
        result: Formula
        if token.text and token.text in _UNARY:
            result = Unary(cast("UnaryOperator", token.text), self.operand(), position=token.position)
        elif token.text == "(":
            result = self.formula()
            closing = self.take()
            if closing.text != ")":
                where = f"line {token.position.line}, column {token.position.column}"
                raise closing.unexpected(f"an operator between two formulas or ')' for the '(' at {where}")
        elif token.text in ("true", "false"):
            result = Constant(token.text == "true", position=token.position)
        elif NAME.fullmatch(token.text) and not token.is_binary:
            result = Proposition(token.text, position=token.position)
        else:
            raise token.unexpected("a proposition, '!', 'X', 'F', 'G' or '('")
        self.depth -= 1
        return result


def _grouped(operands: list[Formula], operators: list[_Token]) -> Formula:
    """Operands joined by binary operators, without parentheses between them."""
    texts = [operator.text for operator in operators]
    for at, operator in enumerate(operators):
        others = texts[:at] + texts[at + 1 :]
        # Whatever binds how tightly, one U on the right of an arrow belongs to its right side.
        alike = at == 0 and len(others) <= 1 and all(other in _TEMPORAL for other in others)
        if operator.text in _ARROWS and not alike:
            raise _ambiguous(operator, others[0])
    if texts and texts[0] in _ARROWS:
        return _binary(operators[0], operands[0], _grouped(operands[1:], operators[1:]))
    joints: tuple[NaryOperator, ...] = ("|", "&")
    for joint in joints:
        if joint in texts:
            cuts = [-1, *(at for at, text in enumerate(texts) if text == joint), len(texts)]
            parts = tuple(
                _grouped(operands[start + 1 : end + 1], operators[start + 1 : end])
                for start, end in itertools.pairwise(cuts)
            )
            return Nary(joint, parts, position=parts[0].position)
    if len(operators) > 1:
        raise _ambiguous(operators[1], texts[0])
    return _binary(operators[0], *operands) if operators else operands[0]


def _ambiguous(operator: _Token, other: str) -> SpecError:
    return operator.position.error(f"{operator.text!r} beside {other!r} is read in two ways; use parentheses")


def _binary(operator: _Token, left: Formula, right: Formula) -> Formula:
    return Binary(cast("BinaryOperator", operator.text), left, right, position=left.position)
