"""A run that is to be made, as a value, and the process that makes it."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

from hrlspec.run.folder import holds_run
from hrlspec.run.places import Place, tethered


@dataclasses.dataclass(frozen=True)
class PlannedRun:
    """A run that is to be made, from its beginning or from where it was left.

    Attributes:
        name: unlike any other's.
        flags: of ``hrlspec run``, without those that say where.
        folder: the run folder.
        total_steps: environment steps that it is to have.
    """

    name: str
    flags: tuple[str, ...]
    folder: Path
    total_steps: int

    @property
    def arguments(self) -> list[str]:
        """The arguments of ``hrlspec run`` that make it, or go on with it."""
        return [*self.flags, "--out", str(self.folder), *(["--resume"] if holds_run(self.folder) else [])]

    @property
    def log(self) -> Path:
        """What it prints, beside its folder."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def last_words(self) -> str:
        """The last line of what it has printed."""
        lines = self.log.read_text(errors="replace").split("\n") if self.log.exists() else []
        return next((line.strip() for line in reversed(lines) if line.strip()), "nothing was said")


def start_run(run: PlannedRun, place: Place, cwd: Path | None = None) -> subprocess.Popen[bytes]:
    """Starts the process that makes a run; it is asked to stop when the thread that called this ends.

    Args:
        run: what to make.
        place: where on this machine.
        cwd: the folder that the run's flags refer to, if not the current one.
    """
    command = [sys.executable, "-m", "hrlspec.run.cli", "run", *run.arguments]
    run.folder.parent.mkdir(parents=True, exist_ok=True)
    with run.log.open("ab") as log:
        # A process group of its own: Ctrl-C reaches this process alone, which then asks the others to stop.
        return place.start(tethered(command), stdout=log, stderr=log, cwd=cwd, start_new_session=True)


def problem_of(status: int) -> str | None:
    """What is said of a process's exit status; nothing of 0."""
    return f"status {status}" if status else None
