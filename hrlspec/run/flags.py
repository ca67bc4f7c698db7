"""Flags of a command line as a dataclass; a mistake is one line, as `hrlspec.run.errors` wants it."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from typing import Any, TypeVar

from hrlspec.run.errors import UserError

Flags = TypeVar("Flags")

_FRAME = " │╭╮╰╯─\n"


def parse_flags(flags: type[Flags], argv: Sequence[str], *, program: str, default: Flags | None = None) -> Flags:
    """Parses a command line.

    Args:
        flags: a dataclass.
        argv: the arguments.
        program: what to call the program in its help.
        default: values of the flags that are not given, if they differ from the dataclass's own.

    Raises:
        UserError: a flag is unknown or its value is not allowed; with tyro's reason.
        SystemExit: with status 0, after ``--help`` was printed.
    """
    try:
        import tyro
    except ImportError as error:
        raise UserError('the command lines need the extra "cli": pip install "hrlspec[cli]"') from error
    options: dict[str, Any] = {"args": list(argv), "prog": program, "config": (tyro.conf.FlagCreatePairsOff,)}
    if default is not None:
        options["default"] = default
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            parsed: Flags = tyro.cli(flags, **options)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UserError(f"{_first_block(said.getvalue())} (see {program} --help)") from None
    return parsed


def _first_block(text: str) -> str:
    """What a framed message says, without the frame, its title, and what comes after the first rule."""
    lines: list[str] = []
    for line in text.splitlines():
        content = line.strip(_FRAME)
        if content and not line.startswith(("╭", "╰")):
            lines.append(content)
        elif lines:
            break
    return " ".join(lines) or "the arguments cannot be understood"
