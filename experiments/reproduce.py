"""``python -m experiments.reproduce``: the paper's figures, from the runs that are missing to the pictures.

A finished run leaves a record in ``--out``; a run without one is made, or resumed where it was stopped, in a process of
its own. Figures and the page are drawn from the records alone, in seconds.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.paper.making import command, make
from experiments.paper.panels import (
    NUM_SEEDS,
    PANELS,
    TRAJECTORIES,
    TRAJECTORY_TASKS,
    TRIAL_SEEDS,
    TUNING,
    Panel,
    Run,
    trajectory_run,
)
from experiments.paper.records import read_records, record_of
from hrlspec.config import setting
from hrlspec.presets import RECIPES
from hrlspec.run.cli import call
from hrlspec.run.console import PlainConsole
from hrlspec.run.engines import EngineFlags, engine_of
from hrlspec.run.errors import UserError
from hrlspec.run.extras import check_drawing
from hrlspec.run.flags import parse_flags
from hrlspec.run.signals import leave


@dataclasses.dataclass(frozen=True)
class ReproduceFlags(EngineFlags):
    """Runs what the paper's figures are made of, as far as it is missing, and draws them."""

    only: tuple[str, ...] = ()
    """Figures, such as letter-set1, walk-ablation or walk-trajectories, or walk-tuning and its like; all figures if not
    given."""
    recipes: tuple[str, ...] = RECIPES
    """Whose curves."""
    seeds: int = setting(NUM_SEEDS, least=1)
    """Runs of each curve, seeds 0, 1, ... For tuning at most three."""
    steps: int | None = setting(None, least=1)
    """Environment steps of each run; 1.5 M in Letter, 2 M in Walk and 4 M in Zone if not given."""
    out: Path | None = None
    """Records and figures; in the checkout results/paper if not given."""
    report: Path | None = None
    """What they say; results.md in --out if not given, or without it docs/results.md."""
    work: Path | None = None
    """Run folders with their checkpoints; runs in --out if not given, or without it runs/paper."""
    dry_run: bool = False
    """Only say what would be run."""
    draw_only: bool = False
    """Only draw figures and write the page, from the records there are."""


def main(argv: Sequence[str], *, program: str = "hrlspec reproduce") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage, a missing library, or a damaged folder or file of records.
        Interrupted: stopped by a signal; the runs have saved what they did.
        SystemExit: with a message, when runs failed; the others are done.
    """
    flags = parse_flags(ReproduceFlags, argv, program=program)
    _check(flags)
    places = _places(flags)
    if not flags.dry_run:
        check_drawing()
    engine = engine_of(flags)
    console = PlainConsole(stderr=True)
    panels = [panel for name, panel in (PANELS | TUNING).items() if name in (flags.only or PANELS)]
    runs = _runs(panels, flags)
    known = read_records(runs, places.out)
    missing = [run for run in runs if run not in known]
    shown, picture = trajectory_run(flags.steps), places.out / f"{TRAJECTORIES}.png"
    to_draw = (not flags.only or TRAJECTORIES in flags.only) and not picture.exists()
    if to_draw and shown not in missing and record_of(places.work / shown.name) is None:
        missing.append(shown)  # its checkpoint is gone, or it is of no panel asked for
    console.say(f"{len({*runs, *missing})} runs, {len(missing)} of them missing")
    if flags.dry_run:
        for run in missing:
            print(command(run, places.work))
        return
    if not flags.draw_only:
        if missing:
            make(missing, work=places.work, records=places.out, engine=engine, console=console)
        if to_draw:
            _draw_trajectories(places.work / shown.name, picture)
            console.say(f"written: {picture}")
    # The drawing library is an extra, and takes a second to load.
    from experiments.paper.report import write_report

    # The page is about all that is known, whatever was asked for now.
    everything = dataclasses.replace(flags, recipes=RECIPES, seeds=max(flags.seeds, NUM_SEEDS))
    records = read_records(_runs([*PANELS.values(), *TUNING.values()], everything), places.out)
    for file in write_report(panels, records, places.out, places.report):
        console.say(f"written: {file}")


@dataclasses.dataclass(frozen=True)
class Places:
    """Where everything is.

    Attributes:
        out: records and figures.
        report: the page.
        work: run folders.
    """

    out: Path
    report: Path
    work: Path


def _places(flags: ReproduceFlags) -> Places:
    """The project's own records and page belong to its checkout; elsewhere nothing is written where nobody said.

    Raises:
        UserError: this is no checkout and --out is missing.
    """
    if flags.out is not None:
        default = Places(flags.out, flags.out / "results.md", flags.out / "runs")
    elif Path().resolve() == Path(__file__).resolve().parents[1]:
        default = Places(Path("results/paper"), Path("docs/results.md"), Path("runs/paper"))
    else:
        raise UserError(
            f"{Path().resolve()} is not the checkout that this program is of, whose records and page it would renew: "
            "run it there, or give --out"
        )
    return Places(default.out, flags.report or default.report, flags.work or default.work)


def _check(flags: ReproduceFlags) -> None:
    known = [*PANELS, *TUNING, TRAJECTORIES]
    for name in flags.only:
        if name not in known:
            raise UserError(f"--only {name}: there is no such figure, expected some of: {', '.join(known)}")
    for recipe in flags.recipes:
        if recipe not in RECIPES:
            raise UserError(f"--recipes {recipe}: there is no such recipe, expected some of: {', '.join(RECIPES)}")


def _runs(panels: Sequence[Panel], flags: ReproduceFlags) -> list[Run]:
    """All runs of the panels, each once; a panel's seeds one after the other."""
    seeds = {name: min(flags.seeds, TRIAL_SEEDS) for name in TUNING}
    every = [run for panel in panels for run in panel.runs(seeds.get(panel.name, flags.seeds), flags.steps)]
    return list(dict.fromkeys(run for run in every if run.curve.recipe in flags.recipes))


def _draw_trajectories(folder: Path, file: Path) -> None:
    """Draws one episode of each of a few tasks, by a run's agent."""
    file.parent.mkdir(parents=True, exist_ok=True)
    tasks = folder / "trajectories.txt"
    tasks.write_text("\n".join(TRAJECTORY_TASKS) + "\n")
    draw = ["--run", str(folder), "--spec-file", str(tasks), "--draw", str(file), "--episodes", "6", "--json"]
    subprocess.run([sys.executable, "-m", "experiments.evaluate", *draw], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    leave(call("reproduce", program="python -m experiments.reproduce"))
