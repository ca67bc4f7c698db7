"""Makes runs, several side by side, each in a process of its own, and keeps a record of each that finishes."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.paper.panels import Run
from experiments.paper.records import Record, add_record, read_records, record_of
from hrlspec.run.console import PlainConsole
from hrlspec.run.errors import Interrupted, UserError
from hrlspec.run.folder import read_metrics
from hrlspec.run.progress import duration
from hrlspec.run.signals import polled_signals

POLL_SECONDS = 2.0
LINE_SECONDS = 60.0


def make(runs: Sequence[Run], *, work: Path, records: Path, jobs: int | None, console: PlainConsole) -> None:
    """Makes runs from the beginning, or from where they were left.

    Args:
        runs: in the order in which they begin.
        work: holds a folder and a log for each.
        records: where the record of a finished run is added, unless it has one.
        jobs: runs side by side; one for each accelerator or CPU core if ``None``.
        console: says how far everything is.

    Raises:
        Interrupted: SIGINT or SIGTERM came; the runs have saved what they did.
        UserError: runs failed; the others are done.
    """
    waiting, failed = list(runs), list[Run]()
    free = places(jobs)
    running: dict[Run, tuple[subprocess.Popen[bytes], Place]] = {}
    meter = _Meter(runs, work, console)
    with polled_signals() as stop, contextlib.ExitStack() as processes:
        processes.callback(_end, running)
        while (waiting or running) and not stop:
            while waiting and free:
                run, place = waiting.pop(0), free.pop()
                running[run] = _start(run, work, place), place
            stop.wait(POLL_SECONDS)
            for run in [run for run, (process, _) in running.items() if process.poll() is not None]:
                process, place = running.pop(run)
                free.append(place)
                record = record_of(work / run.name) if process.returncode == 0 else None
                if record is None:
                    failed.append(run)
                    meter.note(f"failed: {run.name}, see {work / run.name}.log")
                else:
                    _keep(run, record, records)
                    meter.finished(run)
                    meter.note(f"done: {run.name}, trained in {duration(record.wall_s)}")
            meter.look(running)
    if stop:
        raise Interrupted(f"by {stop.signal_name}; the runs are saved in {work}, the same command goes on")
    if failed:
        raise UserError(f"{len(failed)} runs failed, the first is {failed[0].name}; the same command tries again")


def command(run: Run, work: Path) -> list[str]:
    """The command line that makes a run, or goes on with it."""
    folder = work / run.name
    resume = ["--resume"] if (folder / "config.json").exists() else []
    return [sys.executable, "-m", "experiments.run", *run.flags, "--out", str(folder), *resume]


@dataclasses.dataclass(frozen=True)
class Place:
    """What one of the runs side by side has to itself.

    Attributes:
        variables: added to its environment variables.
        cores: CPU cores that it is bound to, since unbound runs wait for each other's threads; all if empty.
    """

    variables: Mapping[str, str] = dataclasses.field(default_factory=dict)
    cores: Sequence[int] = ()

    def start(self, command: Sequence[str], **how: Any) -> subprocess.Popen[bytes]:
        """Starts a process there.

        Args:
            command: its arguments.
            **how: as for ``subprocess.Popen``.
        """
        process = subprocess.Popen(command, env=os.environ | self.variables, **how)
        if sys.platform == "linux" and self.cores:
            with contextlib.suppress(ProcessLookupError):  # it has failed already
                os.sched_setaffinity(process.pid, self.cores)
        return process


def places(jobs: int | None) -> list[Place]:
    """An accelerator for each of the runs side by side, or else its share of the CPU cores."""
    if jobs is None or jobs > 1:
        # Another process asks, since asking takes hold of the devices.
        code = "import jax; print(jax.default_backend(), jax.device_count())"
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout.split()
        if len(said) == 2 and said[0] == "gpu":
            count = int(said[1])
            return [Place({"CUDA_VISIBLE_DEVICES": str(i % count)}) for i in range(jobs or count)]
    if sys.platform != "linux":  # cores cannot be chosen
        return [Place() for _ in range(jobs or os.cpu_count() or 1)]
    cores = sorted(os.sched_getaffinity(0))
    jobs = jobs or len(cores)
    return [Place(cores=cores[i % len(cores) :: jobs]) for i in range(jobs)]


def _start(run: Run, work: Path, place: Place) -> subprocess.Popen[bytes]:
    work.mkdir(parents=True, exist_ok=True)
    with (work / f"{run.name}.log").open("ab") as log:
        # A process group of its own: Ctrl-C reaches this process alone, which then asks the others to stop.
        return place.start(command(run, work), stdout=log, stderr=log, start_new_session=True)


def _keep(run: Run, record: Record, records: Path) -> None:
    """Adds the record, but for a run that was made again because its checkpoint was gone."""
    if run not in read_records([run], records):
        add_record(run, record, records)


def _end(running: Mapping[Run, tuple[subprocess.Popen[bytes], Place]]) -> None:
    """Asks what is still running to save and stop, and waits for it."""
    for process, _ in running.values():
        process.terminate()
    for process, _ in running.values():
        process.wait()


class _Meter:
    """Says how far everything is and how long it will take, from the steps done since the start."""

    def __init__(self, runs: Sequence[Run], work: Path, console: PlainConsole) -> None:
        self._work, self._console = work, console
        self._steps = {run: _done(run, work) for run in runs}
        self._before, self._began, self._said = sum(self._steps.values()), time.monotonic(), time.monotonic()

    def note(self, line: str) -> None:
        """Prints a line."""
        self._console.say(line)

    def finished(self, run: Run) -> None:
        """Counts all steps of a run."""
        self._steps[run] = run.total_steps

    def look(self, running: Iterable[Run]) -> None:
        """Prints a line if the last one is a minute old."""
        now = time.monotonic()
        if now - self._said < LINE_SECONDS:
            return
        self._said = now
        for run in running:
            self._steps[run] = _done(run, self._work)
        total = sum(run.total_steps for run in self._steps)
        done = sum(min(steps, run.total_steps) for run, steps in self._steps.items())
        rate = (done - self._before) / (now - self._began)
        left = f", {rate:,.0f} steps/s, {duration((total - done) / rate)} left" if rate > 0 else ""
        self.note(f"{done:,}/{total:,} steps{left}")


def _done(run: Run, work: Path) -> int:
    """Environment steps that a run has done, as far as its evaluations tell."""
    rows = read_metrics(work / run.name)
    return int(rows[-1]["env_steps"]) if rows else 0
