"""Text to syntax tree. The grammar, precedence and limits are in ``docs/language.md``.

    task     = sequence { "or" sequence }
    sequence = safe { ";" safe }
    safe     = atom { "ensuring" condition }
    atom     = "achieve" condition | "(" task ")"
    condition, with "not" before "and" before "or", over names and parentheses

An ``or`` after a condition joins two tasks if a task follows it (parentheses aside, the next word is
``achieve``) and belongs to the condition otherwise.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from hrlspec.spec.syntax import (
    KEYWORDS,
    MAX_NESTING,
    MAX_TEXT,
    Achieve,
    And,
    Choice,
    Condition,
    Ensuring,
    Formula,
    Not,
    Or,
    Position,
    Prop,
    SpecError,
    Then,
    check,
)
from hrlspec.spec.tokens import END, Cursor, Token

_BYTE_ORDER_MARK = "\ufeff"


@dataclass(frozen=True)
class _Token(Token):
    """A keyword, a punctuation mark, a name or the end."""

    @property
    def is_name(self) -> bool:
        return self.text not in KEYWORDS and self.text.isidentifier()


def parse(text: str, *, line: int = 1) -> Formula:
    """Reads one SPECTRL formula.

    Args:
        text: see ``docs/language.md``; may span lines and hold ``#`` comments.
        line: number of its first line, where it is part of a larger text.

    Raises:
        SpecError: with line, column, what was found and what was expected; also beyond the limits on length
            and nesting.
        TypeError: if ``text`` is no string.
    """
    if not isinstance(text, str):
        raise TypeError(f"parse takes a string, found {type(text).__name__}")
    if len(text) > MAX_TEXT:
        raise SpecError(f"the text has {len(text):,} characters, at most {MAX_TEXT:,} are read", line, 1)
    formula = _Parser(_tokens(text, line)).whole()
    check(formula)
    return formula


def bare_lines(text: str) -> list[str]:
    """The lines of a text, without comments and without a byte order mark at its beginning."""
    return [line.split("#", 1)[0] for line in re.split("\r\n|\r|\n", text.removeprefix(_BYTE_ORDER_MARK))]


def _tokens(text: str, line: int) -> list[_Token]:
    """Splits the text, ending with an empty token."""
    tokens: list[_Token] = []
    line_start = i = 0
    if text.startswith(_BYTE_ORDER_MARK):
        line_start = i = 1
    while i < len(text):
        char, start = text[i], i
        position = Position(line, i - line_start + 1)
        i += 1
        if char == "\n" or (char == "\r" and text[i : i + 1] != "\n"):
            line, line_start = line + 1, i
        elif char == "#":
            while i < len(text) and text[i] not in "\r\n":
                i += 1
        elif char in ";()":
            tokens.append(_Token(char, position))
        elif char.isidentifier():
            while i < len(text) and ("_" + text[i]).isidentifier():
                i += 1
            tokens.append(_Token(text[start:i], position))
        elif not char.isspace():
            raise position.error(f"found {char!r}, expected a keyword, a proposition, ';', '(' or ')'")
    tokens.append(_Token(END, Position(line, i - line_start + 1)))
    return tokens


class _Parser(Cursor[_Token]):
    """Recursive descent; recursion happens at parentheses alone, and those are counted."""

    def __init__(self, tokens: list[_Token]) -> None:
        super().__init__(tokens)
        self.nesting = 0
        # Whether a task starts at each token: the next one that is no "(" is "achieve".
        self.starts_task = [False] * len(tokens)
        for i in reversed(range(len(tokens))):
            word = tokens[i].text
            self.starts_task[i] = word == "achieve" or (word == "(" and self.starts_task[i + 1])

    def accept(self, text: str) -> _Token | None:
        """Takes the next token if it is ``text``."""
        token = self.token
        if token.text != text:
            return None
        self.index += 1
        return token

    def open(self) -> _Token | None:
        """Takes a "(", counting how deep it stands."""
        token = self.accept("(")
        if token is not None:
            self.nesting += 1
            if self.nesting > MAX_NESTING:
                raise token.position.error(f"parentheses nested more than {MAX_NESTING} deep")
        return token

    def close(self, opened: _Token, expected: str) -> None:
        if self.accept(")") is None:
            line, column = opened.position.line, opened.position.column
            raise self.token.unexpected(f"{expected} or ')' for the '(' at line {line}, column {column}")
        self.nesting -= 1

    def whole(self) -> Formula:
        if self.token.text == END:
            raise self.token.unexpected("a task, such as 'achieve a; achieve b'")
        formula = self.task()
        if self.token.text != END:
            raise self.token.unexpected("';', 'or', 'ensuring', 'and' or the end of the text")
        return formula

    def task(self) -> Formula:
        choices: list[Formula] = []
        while True:
            sequence = [self.safe()]
            while self.accept(";"):
                sequence.append(self.safe())
            choices.append(Then(tuple(sequence), position=sequence[0].position) if len(sequence) > 1 else sequence[0])
            if self.accept("or") is None:
                return Choice(tuple(choices), position=choices[0].position) if len(choices) > 1 else choices[0]

    def safe(self) -> Formula:
        formula: Formula
        if word := self.accept("achieve"):
            formula = Achieve(self.condition(), position=word.position)
        elif opened := self.open():
            formula = self.task()
            self.close(opened, "';', 'or', 'ensuring', 'and'")
        else:
            hint = f"; to reach a proposition write 'achieve {self.token.text}'" if self.token.is_name else ""
            raise self.token.unexpected("'achieve' or '('" + (hint if len(hint) < 80 else ""))
        for count in range(1, len(self.tokens)):
            word = self.accept("ensuring")
            if word is None:
                break
            if count >= MAX_NESTING:
                raise word.position.error(f"more than {MAX_NESTING - 1} times 'ensuring' in a row; join them by 'and'")
            formula = Ensuring(formula, self.condition(), position=word.position)
        return formula

    def condition(self) -> Condition:
        disjuncts: list[Condition] = []
        while True:
            parts = [self.literal()]
            while self.accept("and"):
                parts.append(self.literal())
            disjuncts.append(And(tuple(parts), position=parts[0].position) if len(parts) > 1 else parts[0])
            if self.token.text != "or" or self.starts_task[self.index + 1]:
                return Or(tuple(disjuncts), position=disjuncts[0].position) if len(disjuncts) > 1 else disjuncts[0]
            self.index += 1

    def literal(self) -> Condition:
        negations: list[Position] = []
        while word := self.accept("not"):
            negations.append(word.position)
            if len(negations) >= MAX_NESTING:
                raise word.position.error(f"more than {MAX_NESTING - 1} times 'not' in a row")
        token = self.token
        result: Condition
        if token.is_name:
            self.index += 1
            result = Prop(token.text, position=token.position)
        elif opened := self.open():
            result = self.condition()
            self.close(opened, "'and', 'or'")
        else:
            hint = "; tasks are joined by ';' or 'or'" if token.text == "achieve" else ""
            raise token.unexpected("a proposition, 'not' or '('" + hint)
        for position in reversed(negations):
            result = Not(result, position=position)
        return result
