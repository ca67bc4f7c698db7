"""The terminal as the commands write to it: names and paths as they are, in whatever it can show."""

from __future__ import annotations

from typing import Any

from rich.console import Console


def counted(number: int, thing: str) -> str:
    """A number of things: ``1 task``, ``2,000 tasks``."""
    return f"{number:,} {thing}" if number == 1 else f"{number:,} {thing}s"


class PlainConsole(Console):
    """A console to which text is text: brackets are no markup, and nothing is coloured that is not told to be.

    Args:
        **options: as `rich.console.Console` takes them.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def show_cursor(self, show: bool = True) -> bool:
        """Leaves the cursor as it is: if the process ended at once, nobody would show it again."""
        del show
        return False

    def say(self, line: str) -> None:
        """Prints a line, however long, as one."""
        self.print(line, soft_wrap=True)


def result_console(width: int = 100) -> PlainConsole:
    """Standard output; where it is no terminal, so many columns wide, enough for any table of results."""
    console = PlainConsole()
    return console if console.is_terminal else PlainConsole(width=width)
