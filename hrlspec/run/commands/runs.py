"""Lists run folders, at any time: ``hrlspec runs``, with ``--help`` for the flags."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import tyro

from hrlspec.config import Checked
from hrlspec.run.console import result_console
from hrlspec.run.errors import UserError
from hrlspec.run.flags import parse_flags
from hrlspec.run.listing import FoundRun, look_at, runs_below
from hrlspec.run.progress import duration
from hrlspec.run.tables import plain_table

Column = Literal[
    "run", "env", "method", "recipe", "reward_set", "seed", "state", "env_steps", "success_rate", "wall_s", "commit"
]
_TITLES = {
    "run": "run",
    "env": "environment",
    "method": "method",
    "recipe": "recipe",
    "reward_set": "set",
    "seed": "seed",
    "state": "state",
    "env_steps": "steps",
    "total_steps": "of",
    "success_rate": "success",
    "wall_s": "time",
    "commit": "commit",
}
_SETTINGS = ("env", "method", "recipe", "reward_set", "seed")
_WIDTH = 180


@dataclasses.dataclass(frozen=True)
class RunsFlags(Checked):
    """Lists the run folders in some folders, at any depth, and how far each of them has come."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = (Path("runs"),)
    """Where to look."""
    sort: Column = "run"
    """By which column; what has no value there comes last."""
    descending: bool = False
    """Largest first."""
    json: bool = False
    """Print one JSON object and nothing else on standard output."""


def main(argv: Sequence[str], *, program: str = "hrlspec runs") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage, or no such folder.
    """
    flags = parse_flags(RunsFlags, argv, program=program)
    for folder in flags.folders:
        if not folder.is_dir():
            raise UserError(f"there is no folder {folder}: say where the runs are, {program} FOLDER")
    found = dict.fromkeys(path for folder in flags.folders for path in runs_below(folder))
    rows = _ordered([entries(look_at(path)) for path in found], flags.sort, flags.descending)
    if flags.json:
        print(json.dumps({"runs": rows}, allow_nan=False), flush=True)
        return
    console = result_console(_WIDTH)
    if not rows:
        console.say(f"no runs in {' '.join(map(str, flags.folders))}")
        return
    table = plain_table(
        "Runs",
        [*_TITLES.values()],
        "success: newest evaluation, on tasks for validation; time: up to then; stopped: run --resume goes on",
    )
    table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
    for row in rows:
        table.add_row(*_cells(row))
    console.print(table)
    for row in rows:
        if row["damage"]:
            console.say(f"{row['run']}: {row['damage']}")


def entries(run: FoundRun) -> dict[str, Any]:
    """What is told of a run, as plain values; ``None`` for what is not known."""
    return {
        "run": str(run.path),
        **{name: run.settings.get(name) for name in _SETTINGS},
        "state": run.state,
        "env_steps": run.env_steps,
        "total_steps": run.total_steps,
        "success_rate": run.success_rate,
        "wall_s": run.wall_s,
        "commit": run.record.get("commit"),
        "damage": run.damage or None,
    }


def _ordered(rows: list[dict[str, Any]], column: str, descending: bool) -> list[dict[str, Any]]:
    """By a column, and by their paths where it is the same."""
    by_path = sorted(rows, key=lambda row: _natural(row["run"]))
    known = [row for row in by_path if row[column] is not None]
    if column == "run":
        return known[::-1] if descending else known
    known.sort(key=lambda row: row[column], reverse=descending)
    return known + [row for row in by_path if row[column] is None]


def _natural(text: str) -> list[str | int]:
    """A key by which ``seed10`` comes after ``seed9``."""
    return [int(part) if number % 2 else part for number, part in enumerate(re.split(r"(\d+)", text))]


def _cells(row: Mapping[str, Any]) -> list[str]:
    shown = {name: "-" if row[name] is None else str(row[name]) for name in _TITLES}
    shown |= {name: f"{row[name]:,}" for name in ("env_steps", "total_steps") if row[name] is not None}
    if row["success_rate"] is not None:
        shown["success_rate"] = f"{row['success_rate']:.3f}"
    if row["wall_s"] is not None:
        shown["wall_s"] = duration(row["wall_s"])
    if row["commit"] is not None:
        shown["commit"] = row["commit"][:7] + "+" * row["commit"].endswith("+changes")
    return [shown[name] for name in _TITLES]
