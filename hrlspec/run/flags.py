"""Flags of a command line as a dataclass; a mistake is one line, as `hrlspec.run.errors` wants it."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from hrlspec.config import ConfigError
from hrlspec.run.errors import UserError

Flags = TypeVar("Flags")

_ELSEWHERE = re.compile(r"(gs|s3):|[A-Za-z][\w+.-]+:/")  # pathlib makes one slash of two
_SETTING = re.compile(r"(?:Error parsing (\S+): )?([A-Z]\w*)\.([\w.]+)(?= is )")
_NO_TYPE = re.compile(r"no type matching (\S+) could be instantiated from \[(.*)\]\.?")
_WORDS = {"INT": "a whole number", "FLOAT": "a number", "PATH": "a path"}


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
        UserError: a flag is unknown or its value is not allowed; the message says why.
        SystemExit: with status 0, after ``--help`` was printed.
    """
    options: dict[str, Any] = {
        "args": list(argv),
        "prog": program,
        "config": (tyro.conf.FlagCreatePairsOff,),
        "registry": _kinds(),
    }
    if default is not None:
        options["default"] = default
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            parsed: Flags = tyro.cli(flags, description=about, **options)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UserError(f"{in_flags(_reason(said.getvalue()), default)} (see {program} --help)") from None
    for name, value in vars(parsed).items():
        if isinstance(value, Path) and _ELSEWHERE.match(str(value)):
            raise UserError(
                f"{flag_of(name)} is {value}, expected a path on this machine; storage elsewhere has to be mounted"
            )
    return parsed


def _kinds() -> ConstructorRegistry:
    """How values are read where the parser's own way would not do."""
    kinds = ConstructorRegistry()

    @kinds.primitive_rule
    def whole_numbers(kind: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[int] | None:
        if kind.type is not int:
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="INT",
            instance_from_str=lambda words: _whole_number(words[0]),
            is_instance=lambda value: type(value) is int,
            str_from_instance=lambda value: [str(value)],
        )

    return kinds


def _whole_number(text: str) -> int:
    """The number, which may be written with an exponent: ``1e6``."""
    with contextlib.suppress(ValueError):
        return int(text)
    with contextlib.suppress(ValueError):
        if (value := float(text)).is_integer():
            return int(value)
    raise ValueError(f"found {text!r}, expected a whole number")


def in_flags(message: str | ConfigError, flags: Any) -> str:
    """A `ConfigError`'s message with the setting as its flag: ``PPOConfig.clip is -1`` as ``--config.low.clip is -1``.

    Args:
        message: as the settings say it, or as the parser does, which tells where they are.
        flags: a dataclass of flags, where settings of that name are looked for unless the message tells. Where there
            are several it stays as it is.
    """
    found = _SETTING.match(str(message))
    if found is None:
        return str(message)
    where, kind, name = found.groups()
    places = [place for place, some in settings_in(flags) if type(some).__name__ == kind]
    if where is not None:
        place = "" if where == kind else where.replace("-", "_")  # flags themselves are called by their class
    elif len(places) == 1:
        (place,) = places
    else:
        return str(message)
    return f"{flag_of(f'{place}.{name}')}{str(message)[found.end() :]}"


def flag_of(name: str) -> str:
    """The flag of a setting: ``--config.low.clip`` of ``config.low.clip``, ``--seed`` of ``.seed``."""
    # The settings of a method are told under its flag.
    return "--" + name.lstrip(".").replace("method_settings", "method").replace("_", "-")


def settings_in(flags: object, place: str = "") -> Iterator[tuple[str, Any]]:
    """All dataclasses within a dataclass, itself included, under dotted names."""
    if dataclasses.is_dataclass(flags):
        yield place, flags
        for field in dataclasses.fields(flags):
            yield from settings_in(getattr(flags, field.name), f"{place}.{field.name}".lstrip("."))


def _reason(text: str) -> str:
    """What the parser's message says: not its title nor what comes after it, without frame or, in ASCII, rules."""
    blocks: list[list[str]] = [[]]
    for line in text.splitlines():
        content = line.strip(" │")
        if content.startswith(("╭", "╰")):
            continue
        if content.strip("-─"):
            blocks[-1].append(content)
        else:
            blocks.append([])
    said = [" ".join(block) for block in blocks if block]
    title = 0 if "╭" in text else 1  # a framed title stands in the frame
    if len(said) <= title:
        return "the arguments cannot be understood"
    return _NO_TYPE.sub(lambda match: f"found {match[2]}, expected {_in_words(match[1])}", said[title])


def _in_words(types: str) -> str:
    """Alternatives such as ``{None}|INT``; nobody types what stands for no value."""
    return " or ".join(_WORDS.get(name, name) for name in types.split("|") if name != "{None}")
