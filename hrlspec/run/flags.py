"""Flags of a command line as a dataclass; a mistake is one line, as `hrlspec.run.errors` wants it."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from hrlspec.config import ConfigError
from hrlspec.run.errors import UserError

Flags = TypeVar("Flags")

_FRAME = " │╭╮╰╯─\n"
_SETTING = re.compile(r"(?:Error parsing (\S+): )?([A-Z]\w*)\.([\w.]+)(?= is )")


def parse_flags(
    flags: type[Flags], argv: Sequence[str], *, program: str, default: Flags | None = None, about: str | None = None
) -> Flags:
    """Parses a command line.

    Args:
        flags: a dataclass.
        argv: the arguments.
        program: what to call the program in its help.
        default: values of the flags that are not given, if they differ from the dataclass's own.
        about: what the help begins with, if not the dataclass's docstring.

    Raises:
        UserError: a flag is unknown or its value is not allowed; with the reason.
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
            parsed: Flags = tyro.cli(flags, description=about, **options)
    except SystemExit as stop:
        if not stop.code:
            raise
        reason = in_flags(_first_block(said.getvalue()), flags() if default is None else default)
        raise UserError(f"{reason} (see {program} --help)") from None
    return parsed


def in_flags(message: str | ConfigError, flags: Any) -> str:
    """A `ConfigError`'s message with the setting as its flag: ``PPOConfig.clip is -1`` as ``--config.low.clip is -1``.

    Args:
        message: as the settings say it, or as the parser does, which tells where they are.
        flags: a dataclass of flags, where settings of that name are looked for. Where there are several the message
            stays as it is.
    """
    found = _SETTING.match(str(message))
    if found is None:
        return str(message)
    where, kind, name = found.groups()
    places = [place for place, some in _settings(flags) if type(some).__name__ == kind]
    if where is not None:
        place = "" if where == type(flags).__name__ else where.replace("-", "_")
    elif len(places) == 1:
        (place,) = places
    else:
        return str(message)
    # The settings of a method are told under its flag.
    flag = f"{place}.{name}".lstrip(".").replace("method_settings", "method").replace("_", "-")
    return f"--{flag}{str(message)[found.end() :]}"


def _settings(flags: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """All dataclasses within a dataclass, itself included, under dotted names."""
    yield place, flags
    for field in dataclasses.fields(flags):
        value = getattr(flags, field.name)
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{place}.{field.name}".lstrip("."))


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
