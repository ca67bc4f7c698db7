"""Run folders as they are found, whatever state they are in. Looking at one writes nothing and stops nobody."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from hrlspec import checkpoint
from hrlspec.run.errors import UserError
from hrlspec.run.folder import is_being_written, read_metrics, read_record, read_summary

State = Literal["running", "stopped", "finished", "damaged"]
_MARKS = {"config.json", "metrics.jsonl", "summary.json"}
Part = TypeVar("Part")


@dataclasses.dataclass(frozen=True)
class FoundRun:
    """A run folder as it was when it was looked at.

    Attributes:
        path: the folder.
        state: ``running``: a process writes to it; ``stopped``: ``--resume`` goes on; ``finished``; ``damaged``: some
            of it cannot be read. Checkpoints, of which that would take long, are not looked into.
        damage: what cannot be read, and why; empty if all can be.
        record: ``config.json``; empty where it cannot be read.
        rows: of ``metrics.jsonl``.
        summary: ``summary.json``, ``None`` while there is none.
        env_steps: done, as far as rows and checkpoints tell.
    """

    path: Path
    state: State
    damage: str
    record: Mapping[str, Any]
    rows: Sequence[Mapping[str, Any]]
    summary: Mapping[str, Any] | None
    env_steps: int

    @property
    def settings(self) -> Mapping[str, Any]:
        """The resolved experiment; empty where it cannot be read."""
        settings: Mapping[str, Any] = self.record.get("config", {})
        return settings

    @property
    def total_steps(self) -> int | None:
        """Environment steps that it is to have, before they are rounded up to whole iterations."""
        steps: int | None = self.settings.get("config", {}).get("total_steps")
        return steps

    @property
    def success_rate(self) -> float | None:
        """On tasks for validation, at the newest evaluation."""
        rate: float | None = self.rows[-1].get("eval/success_rate") if self.rows else None
        return rate

    @property
    def wall_s(self) -> float | None:
        """Seconds of training up to the newest evaluation, with compilation and evaluations, in all processes."""
        seconds: float | None = self.rows[-1].get("wall_s") if self.rows else None
        return seconds


def runs_below(folder: Path) -> Iterator[Path]:
    """The run folders in a folder, itself included and hidden ones left out; links are followed."""
    seen = set()
    for name, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(name)
        if real in seen or _MARKS & {*files}:
            folders.clear()  # a run holds no other
        else:
            folders[:] = [name for name in folders if not name.startswith(".")]
        if real not in seen and _MARKS & {*files}:
            yield Path(name)
        seen.add(real)


def look_at(folder: Path) -> FoundRun:
    """What a run folder holds."""
    damage: list[str] = []

    def part(read: Callable[[Path], Part], nothing: Part) -> Part:
        try:
            return read(folder)
        except UserError as error:
            damage.append(str(error))
        except OSError as error:
            damage.append(f"cannot read {error.filename or folder}: {error.strerror}")
        return nothing

    running = part(is_being_written, False)
    record: Mapping[str, Any] = part(read_record, {})
    rows: Sequence[Mapping[str, Any]] = part(read_metrics, [])
    summary: Mapping[str, Any] | None = part(read_summary, None)
    saved: Sequence[int] = part(lambda folder: checkpoint.steps(folder / "checkpoints"), [])
    state: State = "stopped"
    if damage:
        state = "damaged"
    elif running:
        state = "running"
    elif summary is not None and "pictures" in summary:
        state = "finished"
    done = max([0, *saved[-1:], *(row["env_steps"] for row in rows[-1:])])
    return FoundRun(folder, state, "; ".join(damage), record, rows, summary, done)
