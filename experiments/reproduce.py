"""``python -m experiments.reproduce``: the paper's figures, from the runs that are missing to the pictures.

Finished runs leave a record in ``--out``; whatever has none is run, or resumed where it was cut, each run in a process
of its own. Figures and the report are drawn from the records alone, so they can be had again in seconds.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from rich.console import Console

from experiments.paper.panels import (
    NUM_SEEDS,
    PANELS,
    TRAJECTORIES,
    TRAJECTORY_TASKS,
    TUNING,
    Panel,
    Run,
    read_run,
    record_of,
    trajectory_run,
    write_run,
)
from hrlspec.run.errors import Interrupted, UserError, main_guard
from hrlspec.run.experiment import RECIPES
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import read_metrics
from hrlspec.run.progress import duration
from hrlspec.run.signals import polled_signals

PROGRAM = "python -m experiments.reproduce"
POLL_SECONDS = 2.0
LINE_SECONDS = 60.0


@dataclasses.dataclass(frozen=True)
class ReproduceFlags:
    """Runs what the paper's figures are made of, as far as it is missing, and draws them."""

    only: tuple[str, ...] = ()
    """Figures, such as letter-set1, walk-ablation or walk-trajectories, or walk-tuning and its like; all figures if not
    given."""
    recipes: tuple[str, ...] = RECIPES
    """Whose curves."""
    seeds: int = NUM_SEEDS
    """Runs of each curve, seeds 0, 1, ... One for tuning."""
    steps: int | None = None
    """Environment steps of each run; 1.5 M in Letter, 2 M in Walk and 4 M in Zone if not given."""
    jobs: int | None = None
    """Runs side by side; one for each accelerator or CPU core if not given."""
    out: Path = Path("results/paper")
    """Records and figures."""
    report: Path = Path("docs/results.md")
    """What they say."""
    work: Path = Path("runs/paper")
    """Run folders with their checkpoints."""
    dry_run: bool = False
    """Only say what would be run."""
    draw_only: bool = False
    """Only draw figures and write the page, from the records there are."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line.

    Args:
        argv: the arguments, those of the process by default.

    Raises:
        UserError: bad usage or a damaged folder.
        Interrupted: stopped by a signal; the runs have saved what they did.
    """
    flags = parse_flags(ReproduceFlags, sys.argv[1:] if argv is None else argv, program=PROGRAM)
    panels = _chosen(flags)
    console = Console(stderr=True)
    runs = _runs(panels, flags)
    missing = [run for run in runs if read_run(run, flags.out) is None]
    shown, pictures = trajectory_run(flags.steps), [flags.out / f"{TRAJECTORIES}{end}" for end in (".png", ".svg")]
    to_draw = [] if flags.only and TRAJECTORIES not in flags.only else [file for file in pictures if not file.exists()]
    if to_draw and shown not in missing and record_of(flags.work / shown.name) is None:
        runs, missing = [*runs, shown], [*missing, shown]
    console.print(f"{len(runs)} runs, {len(missing)} of them missing", highlight=False)
    if flags.dry_run:
        for run in missing:
            print(" ".join(_command(run, flags.work)[1:]))
        return
    if not flags.draw_only:
        if missing:
            _make(missing, flags, console)
        for file in to_draw:
            _draw_trajectories(flags.work / shown.name, file)
            console.print(f"written: {file}", highlight=False)
    # The drawing library is an extra, and takes a second to load.
    from experiments.paper.report import write_report

    # The page is about all that is known, whatever was asked for now.
    known = dataclasses.replace(flags, recipes=RECIPES, seeds=max(flags.seeds, NUM_SEEDS))
    every = _runs([*PANELS.values(), *TUNING.values()], known)
    records = {run: record for run in every if (record := read_run(run, flags.out)) is not None}
    for file in write_report(panels, records, flags.out, flags.report):
        console.print(f"written: {file}", highlight=False)


def _chosen(flags: ReproduceFlags) -> list[Panel]:
    known = [*PANELS, *TUNING, TRAJECTORIES]
    for name in flags.only:
        if name not in known:
            raise UserError(f"--only {name}: there is no such figure, expected some of: {', '.join(known)}")
    for name, value in (("seeds", flags.seeds), ("steps", flags.steps), ("jobs", flags.jobs)):
        if value is not None and value < 1:
            raise UserError(f"--{name} is {value}, expected at least 1")
    for recipe in flags.recipes:
        if recipe not in RECIPES:
            raise UserError(f"--recipes {recipe}: there is no such recipe, expected paper, hrlspec or both")
    if not flags.only:
        return list(PANELS.values())
    return [panel for name, panel in (PANELS | TUNING).items() if name in flags.only]


def _runs(panels: Sequence[Panel], flags: ReproduceFlags) -> list[Run]:
    """All runs of the panels, each once; a panel's seeds one after the other."""
    every = [run for panel in panels for run in panel.runs(1 if panel.name in TUNING else flags.seeds, flags.steps)]
    return list({run.name: run for run in every if run.curve.recipe in flags.recipes}.values())


def _draw_trajectories(folder: Path, file: Path) -> None:
    """One episode of each of a few tasks, by a run's agent."""
    file.parent.mkdir(parents=True, exist_ok=True)
    tasks = folder / "trajectories.txt"
    tasks.write_text("\n".join(TRAJECTORY_TASKS) + "\n")
    draw = ["--run", str(folder), "--spec-file", str(tasks), "--draw", str(file), "--episodes", "6", "--json"]
    subprocess.run([sys.executable, "-m", "experiments.evaluate", *draw], check=True, stdout=subprocess.DEVNULL)


def _command(run: Run, work: Path) -> list[str]:
    folder = work / run.name
    resume = ["--resume"] if (folder / "config.json").exists() else []
    return [sys.executable, "-m", "experiments.run", *run.flags, "--out", str(folder), *resume]


def _make(missing: Sequence[Run], flags: ReproduceFlags, console: Console) -> None:
    """Makes the missing runs, several side by side, and keeps the record of each as soon as it is finished."""
    waiting, failed = list(missing), list[Run]()
    free = _places(flags.jobs)
    running: dict[Run, tuple[subprocess.Popen[bytes], _Place]] = {}
    meter = _Meter(missing, flags.work, console)
    with polled_signals() as stop, contextlib.ExitStack() as processes:
        processes.callback(_end, running)
        while (waiting or running) and not stop:
            while waiting and free:
                run, place = waiting.pop(0), free.pop()
                running[run] = _start(run, flags.work, place), place
            time.sleep(POLL_SECONDS)
            for run in [run for run, (process, _) in running.items() if process.poll() is not None]:
                process, place = running.pop(run)
                free.append(place)
                record = record_of(flags.work / run.name) if process.returncode == 0 else None
                if record is None:
                    failed.append(run)
                    meter.note(f"failed: {run.name}, see {flags.work / run.name}.log")
                else:
                    write_run(run, record, flags.out)
                    meter.finished(run)
                    meter.note(f"done: {run.name}, trained in {duration(record['wall_s'])}")
            meter.look(running)
    if stop:
        raise Interrupted(f"by {stop.signal_name}; the runs are saved in {flags.work}, the same command goes on")
    if failed:
        raise UserError(f"{len(failed)} runs failed, the first is {failed[0].name}; the same command tries again")


@dataclasses.dataclass(frozen=True)
class _Place:
    """Where one of the runs side by side takes place.

    Attributes:
        variables: added to its environment variables.
        cores: it keeps to these, or two runs would wait for each other's threads; none: it is free.
    """

    variables: Mapping[str, str] = dataclasses.field(default_factory=dict)
    cores: Sequence[int] = ()


def _places(jobs: int | None) -> list[_Place]:
    """An accelerator for each of the runs side by side, or else its share of the cores."""
    if jobs is None or jobs > 1:
        # Asked in another process, since asking takes hold of the devices.
        code = "import jax; print(jax.default_backend(), jax.device_count())"
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout.split()
        if len(said) == 2 and said[0] == "gpu":
            count = int(said[1])
            return [_Place({"CUDA_VISIBLE_DEVICES": str(i % count)}) for i in range(jobs or count)]
    if not hasattr(os, "sched_getaffinity"):  # other systems than Linux
        return [_Place() for _ in range(jobs or os.cpu_count() or 1)]
    cores = sorted(os.sched_getaffinity(0))
    jobs = jobs or len(cores)
    return [_Place(cores=cores[i % len(cores) :: jobs]) for i in range(jobs)]


def _start(run: Run, work: Path, place: _Place) -> subprocess.Popen[bytes]:
    work.mkdir(parents=True, exist_ok=True)
    with (work / f"{run.name}.log").open("ab") as log:
        # A process group of its own: Ctrl-C reaches this process alone, which then asks the others to stop.
        process = subprocess.Popen(
            _command(run, work), stdout=log, stderr=log, env=os.environ | place.variables, start_new_session=True
        )
    if place.cores:
        with contextlib.suppress(ProcessLookupError):  # it has failed already
            os.sched_setaffinity(process.pid, place.cores)
    return process


def _end(running: Mapping[Run, tuple[subprocess.Popen[bytes], _Place]]) -> None:
    """Asks what is still running to save and stop, and waits for it."""
    for process, _ in running.values():
        process.terminate()
    for process, _ in running.values():
        process.wait()


class _Meter:
    """Says how far everything is and how long it will take, from the steps done since the start."""

    def __init__(self, missing: Sequence[Run], work: Path, console: Console) -> None:
        self._work, self._console = work, console
        self._steps = {run: _done(run, work) for run in missing}
        self._before, self._began, self._said = sum(self._steps.values()), time.monotonic(), time.monotonic()

    def note(self, line: str) -> None:
        """A line that stays."""
        self._console.print(line, highlight=False, soft_wrap=True)

    def finished(self, run: Run) -> None:
        """All steps of a run are done."""
        self._steps[run] = run.total_steps

    def look(self, running: Iterable[Run]) -> None:
        """Once a minute a line."""
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
    rows = read_metrics(work / run.name) if (work / run.name / "metrics.jsonl").exists() else []
    return int(rows[-1]["env_steps"]) if rows else 0


if __name__ == "__main__":
    sys.exit(main_guard(main))
