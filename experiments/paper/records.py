"""Records of runs: what is kept of each, in one JSON Lines file for each environment and recipe.

A line is of one of three kinds; what many runs share stands once, before the first that refers to it::

    {"config": HASH, "settings": {...}}     what a run folder's config.json has, without the seed
    {"source": HASH, "circumstances": {"commit": ..., "machine": ..., "versions": {...}}}
    {"run": NAME, "asked_steps": ..., "seed": ..., "flags": ..., "config": HASH, "source": HASH,
     "env_steps": ..., "wall_s": ..., "curve": {...}, "final": {...}}

``run`` says environment, method, recipe, reward set, switches and seed; together with ``asked_steps`` it identifies the
record. ``curve`` holds the evaluations during training as columns, ``final`` the scores at the end with their 95 %
intervals, those of each depth as columns. Lines are added and never edited: a run that is to be made again has its line
deleted.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.paper.panels import Run
from hrlspec.run.configuration import config_hash
from hrlspec.run.errors import UserError
from hrlspec.run.folder import read_metrics, read_record, read_summary

CURVE = ("env_steps", "wall_s", "level", "eval/return_mean", "eval/success_rate", "eval/steps_mean", "train/violations")
"""Metrics kept of each evaluation during training."""
_HASH_DIGITS = 12
_SHARED = {"config": "settings", "source": "circumstances"}


@dataclasses.dataclass(frozen=True)
class Record:
    """One finished run.

    Attributes:
        settings: the resolved experiment, as in the run folder's ``config.json``.
        circumstances: ``commit``, ``machine`` and ``versions``.
        env_steps: environment steps done.
        wall_s: seconds of training, with compilation and evaluations.
        curve: name of a metric to its values, one for each evaluation during training.
        final: scores at the end: ``suite``, ``contested_choice`` and ``return_over_optimum``; the latter two are
            ``None`` where they are not known.
    """

    settings: Mapping[str, Any]
    circumstances: Mapping[str, Any]
    env_steps: int
    wall_s: float
    curve: Mapping[str, Sequence[Any]]
    final: Mapping[str, Any]


def record_of(folder: Path) -> Record | None:
    """The record of a run folder, ``None`` while the run is not finished.

    Raises:
        UserError: the folder is damaged.
    """
    summary = read_summary(folder) if folder.exists() else None
    if summary is None:
        return None
    made, rows = read_record(folder), read_metrics(folder)
    return Record(
        settings=made["config"],
        circumstances={name: made[name] for name in ("commit", "machine", "versions")},
        env_steps=summary["env_steps"],
        wall_s=summary["wall_s"],
        curve={name: [row[name] for row in rows] for name in CURVE},
        final={name: _by_columns(scores) for name, scores in summary["final"].items()},
    )


def _by_columns(scores: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Scores without those of single tasks, and with those of each depth as columns."""
    if scores is None:
        return None
    kept = {name: value for name, value in scores.items() if name != "per_task"}
    by_depth: Mapping[str, Mapping[str, Any]] = kept.get("per_depth") or {}
    if by_depth:
        names = next(iter(by_depth.values()))
        columns = {name: [row[name] for row in by_depth.values()] for name in names}
        kept["per_depth"] = {"depth": [int(depth) for depth in by_depth], **columns}
    return kept


def record_file(run: Run, folder: Path) -> Path:
    """The file of all records with a run's environment and recipe."""
    return folder / f"{run.env}-{run.curve.recipe}.jsonl"


def read_records(runs: Iterable[Run], folder: Path) -> dict[Run, Record]:
    """The records of those runs that have one.

    Args:
        runs: a record is of the run with the same name and the same number of steps.
        folder: of the files.

    Raises:
        UserError: a file cannot be read, or a line of it is not a record.
    """
    runs = list(runs)
    files = dict.fromkeys(record_file(run, folder) for run in runs)
    known = {key: record for file in files for key, record in _read(file)[0].items()}
    return {run: known[_key(run)] for run in runs if _key(run) in known}


def add_record(run: Run, record: Record, folder: Path) -> Path:
    """Adds a finished run to its file: all of it or, if the process is killed, nothing.

    One process at a time adds records to a folder.

    Args:
        run: which run this is.
        record: what is kept of it.
        folder: of the files; made if it is missing.

    Returns:
        The file.

    Raises:
        UserError: the run has a record already, or the file is damaged.
    """
    file = record_file(run, folder)
    records, shared = _read(file)
    if _key(run) in records:
        raise UserError(f"{file} has a record of {run.name} with {run.total_steps} steps; delete its line first")
    settings = {name: value for name, value in record.settings.items() if name != "seed"}
    lines, references = list[dict[str, Any]](), {}
    for kind, value in (("config", settings), ("source", record.circumstances)):
        references[kind] = _hash(value)
        if f"{kind} {references[kind]}" not in shared:
            lines.append({kind: references[kind], _SHARED[kind]: value})
    lines.append(
        {
            "run": run.name,
            "asked_steps": run.total_steps,
            "seed": record.settings["seed"],
            "flags": " ".join(run.flags),
            **references,
            **{name: getattr(record, name) for name in ("env_steps", "wall_s", "curve", "final")},
        }
    )
    before = file.read_bytes() if file.exists() else b""
    added = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines)
    folder.mkdir(parents=True, exist_ok=True)
    scratch = file.with_suffix(".new")
    scratch.write_bytes(before + added.encode())
    scratch.replace(file)
    return file


_Key = tuple[str, int]
_Shared = dict[str, Mapping[str, Any]]  # by kind and hash, such as "config 0123456789ab"


def _key(run: Run) -> _Key:
    return run.name, run.total_steps


def _hash(value: Mapping[str, Any]) -> str:
    return config_hash(value)[:_HASH_DIGITS]


def _read(file: Path) -> tuple[dict[_Key, Record], _Shared]:
    """The records of a file, and what they share; nothing if there is no file."""
    records, shared = dict[_Key, Record](), _Shared()
    try:
        lines = file.read_text().splitlines()
    except FileNotFoundError:
        return records, shared
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {file}: {error}") from error
    for number, text in enumerate(lines, start=1):
        try:
            line = json.loads(text)
            if "run" not in line:
                shared.update([_read_shared(line)])
                continue
            key, record = _read_run(line, shared)
            if key in records:
                raise ValueError(f"a second record of {key[0]} with {key[1]} steps")
            records[key] = record
        except (ValueError, TypeError, KeyError) as error:
            reason = f"{error.args[0]} is missing" if isinstance(error, KeyError) else error
            raise UserError(f"{file}, line {number}: {reason}; a run whose line is deleted is made again") from error
    return records, shared


def _read_shared(line: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    kind = "config" if "config" in line else "source"
    value = line[_SHARED[kind]]
    if line[kind] != _hash(value):
        raise ValueError(f"the {_SHARED[kind]} do not match their hash {line[kind]}")
    return f"{kind} {line[kind]}", value


def _read_run(line: Mapping[str, Any], shared: _Shared) -> tuple[_Key, Record]:
    settings, circumstances = (shared[f"{kind} {line[kind]}"] for kind in _SHARED)
    record = Record(
        settings={**settings, "seed": line["seed"]},
        circumstances=circumstances,
        **{name: line[name] for name in ("env_steps", "wall_s", "curve", "final")},
    )
    return (line["run"], line["asked_steps"]), record
