"""The card of an agent: what its parameters are of, where they come from, and what they achieve."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

FORMAT = 1
LICENCE = "Apache-2.0"
_LARGEST = 1_000_000  # bytes
_LONGEST = 300  # characters of a file's content in a message
_KINDS = {dict: "an object", str: "text", int: "a whole number"}


class AgentFileError(ValueError):
    """A file of an agent that cannot be used. The message is one clear line."""

    def __init__(self, file: Path, reason: object) -> None:
        # The reason may quote the file, which may hold anything.
        said = "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(str(reason).split())[:_LONGEST])
        super().__init__(f"cannot use {file}: {said}")


@dataclasses.dataclass(frozen=True)
class Card:
    """What stands in JSON beside an agent's parameters, entry by entry.

    Attributes:
        format: of both files.
        file: name of the file of parameters, which lies beside the card.
        sha256: of that file.
        licence: of both.
        config: what determined the run, as its ``config.json`` has it: environment, method, recipe, reward set, seed,
            all settings.
        env_steps: environment steps trained.
        trained: ``commit`` and ``versions`` that the agent was trained with; no commit where git did not know it.
        evaluated: the same of the evaluation.
        results: on each test suite, as `hrlspec.evaluation.SuiteResult.to_json` has them, without those of single
            tasks. Intervals have 95 % coverage.
        success_at_least: on each test suite the lower end of the success rate's interval, rounded down.
    """

    format: int
    file: str
    sha256: str
    licence: str
    config: Mapping[str, Any]
    env_steps: int
    trained: Mapping[str, Any]
    evaluated: Mapping[str, Any]
    results: Mapping[str, Any]
    success_at_least: Mapping[str, float]

    def text(self) -> str:
        """The file's content."""
        return json.dumps(dataclasses.asdict(self), indent=1, allow_nan=False) + "\n"


def read_card(file: Path) -> Card:
    """Reads and checks a card; its settings are those of somebody's run and are checked where they are used.

    Raises:
        AgentFileError: there is no such file, or it is not a card of this format.
    """
    entries = _entries(file)
    if entries.get("format") != FORMAT:
        raise AgentFileError(file, f"its format is {entries.get('format')!r}, this version of hrlspec reads {FORMAT}")
    expected = {field.name: field.type for field in dataclasses.fields(Card)}
    if entries.keys() != expected.keys():
        name = min(entries.keys() ^ expected.keys())
        raise AgentFileError(file, f"{name!r} is {'missing' if name in expected else 'no entry of a card'}")
    for name, kind in expected.items():
        wanted = next((some for some in (int, str) if some.__name__ == kind), dict)
        if type(entries[name]) is not wanted:
            raise AgentFileError(file, f"{name} is {entries[name]!r}, expected {_KINDS[wanted]}")
    if entries["file"] != file.with_suffix(".safetensors").name:
        raise AgentFileError(file, f"it is the card of {entries['file']!r}, not of the file beside it")
    for suite, bound in entries["success_at_least"].items():
        if type(bound) not in (int, float) or not 0 <= bound <= 1:
            raise AgentFileError(file, f"success_at_least of {suite!r} is {bound!r}, expected a number from 0 to 1")
    return Card(**entries)


def _entries(file: Path) -> dict[str, Any]:
    """The object in a JSON file. What readers of JSON do not agree on is refused: names given twice, NaN, infinity."""
    try:
        if file.stat().st_size > _LARGEST:
            raise AgentFileError(file, f"it is larger than {_LARGEST} bytes")
        entries = json.loads(
            file.read_bytes().decode(), object_pairs_hook=_once, parse_constant=_no_number, parse_float=_finite
        )
    except OSError as error:
        raise AgentFileError(file, error.strerror) from error
    except AgentFileError:
        raise
    except (ValueError, RecursionError) as error:
        raise AgentFileError(file, f"it is not JSON: {error}") from None
    if not isinstance(entries, dict):
        raise AgentFileError(file, "it is not an object in JSON")
    return entries


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is given twice")
    return entries


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number")


def _finite(text: str) -> float:
    return number if math.isfinite(number := float(text)) else _no_number(text)
