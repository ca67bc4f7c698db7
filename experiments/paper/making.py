"""Makes the runs that figures and comparisons need, and keeps a record of each that finishes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.paper.panels import Run
from experiments.paper.records import Record, add_record, read_records, record_of
from hrlspec.run.console import PlainConsole
from hrlspec.run.engines import Engine, carry_out, failures
from hrlspec.run.planned import PlannedRun


def make(runs: Sequence[Run], *, work: Path, records: Path, engine: Engine, console: PlainConsole) -> None:
    """Makes runs from the beginning, or from where they were left.

    Args:
        runs: in the order in which they begin.
        work: holds a folder and a log for each.
        records: where the record of a finished run is added, unless it has one.
        engine: makes them.
        console: shows how far everything is.

    Raises:
        Interrupted: SIGINT or SIGTERM came; the runs have saved what they did.
        UserError: the engine cannot be had.
        SystemExit: with a message, when runs failed; the others are done.
    """
    by_plan = {planned(run, work): run for run in runs}

    def keep(plan: PlannedRun) -> None:
        """Adds the record, but for a run that was made again because its checkpoint was gone."""
        run = by_plan[plan]
        record = made(run, work)
        if record is not None and run not in read_records([run], records):
            add_record(run, record, records)

    failed = carry_out([*by_plan], engine, console, keep)
    if failed:
        raise SystemExit(f"error: {failures(failed)}")


def made(run: Run, work: Path) -> Record | None:
    """The record of a run in its folder; ``None`` if it is not finished, or of another number of steps.

    Raises:
        UserError: the folder is damaged.
    """
    record = record_of(work / run.name)
    return record if record is not None and record.settings["config"]["total_steps"] == run.total_steps else None


def planned(run: Run, work: Path) -> PlannedRun:
    """A run with its folder."""
    return PlannedRun(run.name, tuple(run.flags), work / run.name, run.total_steps)


def command(run: Run, work: Path) -> str:
    """The command line that makes a run, or goes on with it."""
    return " ".join(["python -m experiments.run", *planned(run, work).arguments])
