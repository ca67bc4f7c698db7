"""What the parsers of both languages read: words with their places, and a place in a list of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Generic, TypeVar

from hrlspec.spec.syntax import Position, SpecError, shorten

END = ""
"""The text of the token at the end."""


@dataclasses.dataclass(frozen=True)
class Token:
    """A word of a language, or the end of the text."""

    text: str
    position: Position

    def unexpected(self, expected: str) -> SpecError:
        """An error at this token: what was found, and what was expected."""
        found = "the end of the text" if self.text == END else shorten(self.text)
        return self.position.error(f"found {found}, expected {expected}")


T = TypeVar("T", bound=Token)


class Cursor(Generic[T]):
    """The next token of a text, of which the last is its end."""

    def __init__(self, tokens: Sequence[T]) -> None:
        self.tokens = tokens
        self.index = 0

    @property
    def token(self) -> T:
        """The next token."""
        return self.tokens[self.index]
