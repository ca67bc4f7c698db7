"""Many runs, carried out by an engine: on this machine, or on a Ray cluster (``hrlspec/run/ray_engine.py``).

A run is a process of its own in either case, writes to its own folder, and goes on from what is there. So whatever ends
early, a run, a node, or all of it, the same command goes on.
"""

from __future__ import annotations

import dataclasses
import subprocess
from collections.abc import Callable, Sequence
from typing import Protocol, Self

from hrlspec.config import Checked, ConfigError, setting
from hrlspec.run.console import PlainConsole, counted
from hrlspec.run.errors import Interrupted
from hrlspec.run.extras import check_ray
from hrlspec.run.places import Place, places
from hrlspec.run.planned import PlannedRun, problem_of, start_run
from hrlspec.run.run_table import RunTable
from hrlspec.run.signals import polled_signals

POLL_SECONDS = 0.5


class Engine(Protocol):
    """Whoever carries out runs; a context manager. What has not ended when it is left has saved what it did."""

    def __enter__(self) -> Self:
        """Takes hold of what runs need."""

    def __exit__(self, *exception: object) -> None:
        """Asks runs to save and stop, waits for them, and lets go of everything."""

    def submit(self, run: PlannedRun) -> None:
        """Has a run made, when there is room and those submitted before have begun."""

    def ended(self) -> Sequence[tuple[PlannedRun, str | None]]:
        """The runs that have ended since this was last asked: each with what went wrong, ``None`` if it is finished."""


@dataclasses.dataclass(frozen=True)
class EngineFlags(Checked):
    """Where runs are made."""

    jobs: int | None = setting(None, least=1)
    """Runs side by side on this machine; one for each accelerator or CPU core if not given."""
    ray: str | None = None
    """Make the runs on a Ray cluster: its address, such as 10.0.0.1:6379, or auto for the one that this machine belongs
    to; local starts one of this machine alone. Run folders must lie on storage that all nodes share."""
    cores_per_run: int | None = setting(None, least=1)
    """CPU cores that a run has on the cluster; 1 if not given."""
    gpus_per_run: float | None = setting(None, least=0, most=1024)
    """GPUs that a run has on the cluster, or the part of one that it shares, such as 0.25; none if not given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        kind = type(self).__name__
        if self.ray is None:
            for name in ("cores_per_run", "gpus_per_run"):
                if getattr(self, name) is not None:
                    raise ConfigError(f"{kind}.{name} is {getattr(self, name)}, expected to stand beside --ray")
        elif self.jobs is not None:
            raise ConfigError(f"{kind}.jobs is {self.jobs}, expected none beside --ray, where --cores-per-run decides")
        if self.gpus_per_run is not None and self.gpus_per_run > 1 and self.gpus_per_run % 1:
            raise ConfigError(f"{kind}.gpus_per_run is {self.gpus_per_run}, expected a part of one, or a whole number")


def engine_of(flags: EngineFlags) -> Engine:
    """The engine that flags ask for; nothing has begun yet.

    Raises:
        UserError: a library is missing.
    """
    if flags.ray is None:
        return LocalEngine(flags.jobs)
    check_ray()
    from hrlspec.run.ray_engine import RayEngine

    return RayEngine(flags.ray, cores=flags.cores_per_run or 1, gpus=flags.gpus_per_run or 0)


def carry_out(
    runs: Sequence[PlannedRun],
    engine: Engine,
    console: PlainConsole,
    finished: Callable[[PlannedRun], None] = lambda run: None,
) -> list[PlannedRun]:
    """Makes runs; one that fails is named in a line, and the others go on.

    Args:
        runs: in the order in which they begin.
        engine: makes them.
        console: shows how far all of them are.
        finished: called with each that finishes.

    Returns:
        Those that failed.

    Raises:
        Interrupted: SIGINT or SIGTERM came; the runs have saved what they did.
        UserError: the engine cannot be had.
    """
    left, failed = {*runs}, list[PlannedRun]()
    with polled_signals() as stop, engine, RunTable(runs, console) as table:
        for run in runs:
            engine.submit(run)
        while left and not stop:
            stop.wait(POLL_SECONDS)
            for run, problem in engine.ended():
                left.remove(run)
                if problem is None:
                    finished(run)
                    table.ended(run, "finished")
                else:
                    failed.append(run)
                    table.ended(run, "failed")
                    console.say(f"failed: {run.name} ({problem}): {run.last_words}; all it said is in {run.log}")
            table.update()
    if stop and left:
        raise Interrupted(f"by {stop.signal_name}; the runs are saved in their folders, the same command goes on")
    return failed


def failures(failed: Sequence[PlannedRun]) -> str:
    """What a command ends with whose runs failed."""
    return f"{counted(len(failed), 'run')} failed, the first is {failed[0].name}; the same command tries again"


class LocalEngine:
    """This machine: as many runs side by side as there are places.

    Args:
        jobs: how many; one for each accelerator or CPU core if ``None``.
    """

    def __init__(self, jobs: int | None) -> None:
        self._jobs = jobs
        self._free: list[Place] = []
        self._waiting: list[PlannedRun] = []
        self._running: dict[PlannedRun, tuple[subprocess.Popen[bytes], Place]] = {}

    def __enter__(self) -> Self:
        self._free = places(self._jobs)[::-1]
        return self

    def __exit__(self, *exception: object) -> None:
        _end([process for process, _ in self._running.values()])

    def submit(self, run: PlannedRun) -> None:
        """Starts the run, or has it wait for a place."""
        self._waiting.append(run)
        self._fill()

    def ended(self) -> list[tuple[PlannedRun, str | None]]:
        """The runs whose processes have ended; others have taken their places."""
        status = {run: process.poll() for run, (process, _) in self._running.items()}
        done = {run: code for run, code in status.items() if code is not None}
        for run in done:
            self._free.append(self._running.pop(run)[1])
        self._fill()
        return [(run, problem_of(code)) for run, code in done.items()]

    def _fill(self) -> None:
        while self._waiting and self._free:
            run, place = self._waiting.pop(0), self._free.pop()
            self._running[run] = start_run(run, place), place


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Asks processes to save and stop, all at once, and waits for them."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait()
