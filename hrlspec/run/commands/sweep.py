"""Trains an agent for each combination of settings and seeds: ``hrlspec sweep``, with ``--help`` for the flags.

A run has a folder ``CELL/seed<n>`` in the sweep's, where a cell is a combination such as ``num_envs=64,rounds=1``, and
what it prints is in ``CELL/seed<n>.log``. Beside them are ``results.json`` and ``results.csv``. Exit status: 0 all runs
are finished; 1 some failed, the others are finished; 2 bad usage or input, nothing was begun; 130 interrupted.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Table

from hrlspec.config import setting
from hrlspec.evaluation.stats import Interval
from hrlspec.run.commands.compare import SCORES, means_of, scores_of, scores_to_json
from hrlspec.run.commands.run import check_beginning, check_folder
from hrlspec.run.console import PlainConsole, counted, result_console
from hrlspec.run.engines import EngineFlags, carry_out, engine_of, failures
from hrlspec.run.errors import UserError
from hrlspec.run.files import write_atomically
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import check_writable, holds_run
from hrlspec.run.grids import Cell, cell_name, cells_of, check_shared, flags_of, grid_of, seeds_of, short_names
from hrlspec.run.listing import look_at
from hrlspec.run.planned import PlannedRun
from hrlspec.run.run_flags import experiments_of, parse_run
from hrlspec.run.tables import cell as shown
from hrlspec.run.tables import plain_table

_WIDTH = 160


@dataclasses.dataclass(frozen=True)
class SweepFlags(EngineFlags):
    """Trains an agent for each combination of settings and seeds, and puts their results side by side.

    Flags of run that all of them share follow after --, as in: --seeds 0-4 --grid config.num_envs=64,128 -- --env
    letter. Runs that are finished are left alone, and those that were stopped go on.
    """

    out: Path = Path("runs/sweep")
    """Where the run folders and the results go."""
    seeds: str = "0"
    """Numbers and ranges, such as 0-4 or 0,2,7-9."""
    grid: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A setting and its values, SETTING=VALUE,VALUE,... such as config.num_envs=64,128; to be repeated for more
    settings, of which all combinations are run. A setting is a flag of run without its dashes; a switch is true or
    false."""
    max_runs: int | None = setting(None, least=1)
    """Make at most so many of the runs that are missing; the same command makes the others."""
    dry_run: bool = False
    """Only say what would be run."""
    json: bool = False
    """Print one JSON object and nothing else on standard output."""


@dataclasses.dataclass(frozen=True)
class _Planned:
    """A cell with its runs.

    Attributes:
        cell: its settings.
        runs: one for each seed.
        missing: those that are not finished.
    """

    cell: Cell
    runs: list[PlannedRun]
    missing: list[PlannedRun]


def main(argv: Sequence[str], *, program: str = "hrlspec sweep") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage or input; nothing was begun.
        AgentFileError: the agent to begin from cannot be used; nothing was begun.
        Interrupted: stopped by a signal; the runs have saved what they did.
        SystemExit: with a message, when runs failed; the others are finished.
    """
    words = [*argv, "--"]
    own, shared = words[: words.index("--")], words[words.index("--") + 1 : -1]
    flags = parse_flags(SweepFlags, own, program=program)
    grid = grid_of(flags.grid)
    check_shared(shared, grid)
    names, seeds = short_names(grid), seeds_of(flags.seeds)
    engine = engine_of(flags)
    check_writable(flags.out)
    planned = [_plan(one, cell_name(one, names), shared, seeds, flags.out) for one in cells_of(grid)]
    # Seed by seed, so that all cells grow alike.
    by_seed = [run for runs in zip(*(some.runs for some in planned), strict=True) for run in runs]
    unfinished = {run for some in planned for run in some.missing}
    missing = [run for run in by_seed if run in unfinished]
    console = PlainConsole(stderr=True)
    console.say(f"{counted(len(planned), 'cell')}, {counted(len(by_seed), 'run')}, {len(missing)} of them missing")
    if flags.dry_run:
        for run in missing[: flags.max_runs]:
            print(program.removesuffix("sweep") + "run", *run.arguments)
        return
    failed = []
    if missing:
        failed = carry_out(missing[: flags.max_runs], engine, console)
    results = [_result(some, names) for some in planned]
    _write(results, [*names.values()], flags.out)
    if flags.json:
        print(json.dumps({"cells": [_to_json(result) for result in results]}, allow_nan=False), flush=True)
    else:
        result_console(_WIDTH).print(_table(results, [*names.values()]))
    if failed:
        raise SystemExit(f"error: {failures(failed)}")


def _plan(cell: Cell, name: str, shared: Sequence[str], seeds: Sequence[int], out: Path) -> _Planned:
    """The runs of a cell, checked as ``hrlspec run`` checks them.

    Raises:
        UserError: one could not be made; the message begins with the cell.
    """
    try:
        words = flags_of(cell, shared)
        first = parse_run(words)
        ((experiment, _),) = experiments_of(first)
        check_beginning(first, experiment)
        experiment.agent  # noqa: B018  the libraries of its environment are there
        runs, missing = [], []
        for seed in seeds:
            run = PlannedRun(
                "/".join(filter(None, (name, f"seed{seed}"))),
                (*words, "--seed", str(seed)),
                out / name / f"seed{seed}",
                experiment.config.total_steps,
            )
            runs.append(run)
            if not check_folder(dataclasses.replace(experiment, seed=seed), run.folder, first):
                missing.append(run)
    except UserError as error:
        raise UserError(f"{name}: {error}" if name else str(error)) from None
    return _Planned(cell, runs, missing)


@dataclasses.dataclass(frozen=True)
class _Result:
    """A cell's results.

    Attributes:
        settings: of the cell, under short names.
        asked: how many runs it is to have.
        seeds: of those that are finished.
        means: over them, with Student's t intervals; NaN where there is no number.
    """

    settings: Mapping[str, str]
    asked: int
    seeds: list[int]
    means: Mapping[str, Interval]


def _result(planned: _Planned, names: Mapping[str, str]) -> _Result:
    found = [look_at(run.folder) for run in planned.runs if holds_run(run.folder)]
    done = [run for run in found if run.state == "finished"]
    nothing = dict.fromkeys(SCORES, Interval(math.nan, math.nan, math.nan))
    if len(done) == 1:  # what one run says is no interval over seeds
        means = {name: Interval(score.estimate, math.nan, math.nan) for name, score in scores_of(done[0]).items()}
    else:
        means = (means_of(done) if done else None) or nothing
    settings = {names[name]: value for name, value in planned.cell.items()}
    return _Result(settings, len(planned.runs), [run.settings["seed"] for run in done], means)


def _to_json(result: _Result) -> dict[str, Any]:
    means = scores_to_json(result.means) if result.seeds else None
    return {"settings": dict(result.settings), "runs": result.asked, "seeds": result.seeds, "mean": means}


def _write(results: Sequence[_Result], names: Sequence[str], out: Path) -> None:
    """Writes the results as JSON and as CSV; an interval has columns for its bounds."""
    out.mkdir(parents=True, exist_ok=True)
    cells = [_to_json(result) for result in results]
    write_atomically(out / "results.json", json.dumps({"cells": cells}, indent=2, allow_nan=False) + "\n")
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    bounds = [f"{score}{part}" for score in SCORES for part in ("", "_low", "_high")]
    table.writerow([*names, "seeds", *bounds])
    for result in results:
        numbers = [number for score in SCORES for number in result.means[score]]
        found = ["" if math.isnan(number) else number for number in numbers]
        table.writerow([*result.settings.values(), len(result.seeds), *found])
    write_atomically(out / "results.csv", text.getvalue())


def _table(results: Sequence[_Result], names: Sequence[str]) -> Table:
    titles = [title.replace(" ", "\n") for title, _ in SCORES.values()]
    table = plain_table(
        "Means over seeds",
        [*names, "seeds", *titles],
        "final results on unseen tasks; 95 % intervals over seeds (Student's t); steps of successful episodes",
    )
    for result in results:
        done = f"{len(result.seeds)}" + f" of {result.asked}" * (len(result.seeds) < result.asked)
        scores = [shown(result.means[score]).replace(" ", "\n") for score in SCORES]
        table.add_row(*result.settings.values(), done, *scores)
    return table
