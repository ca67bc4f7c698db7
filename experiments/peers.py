"""``python -m experiments.peers``: our agents on the formulas of others, beside what others have published.

Runs that have no record yet are made, or resumed where they were stopped; evaluations that are missing follow, and the
page is written from the records alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from experiments.paper.making import command, made, make
from experiments.paper.panels import NUM_SEEDS
from experiments.paper.records import read_records
from experiments.published.comparisons import COMPARISONS, Comparison
from experiments.published.evaluations import Evaluation, evaluate, read_evaluations
from experiments.published.report import page
from hrlspec.config import setting
from hrlspec.run.cli import call
from hrlspec.run.console import PlainConsole
from hrlspec.run.engines import EngineFlags, engine_of
from hrlspec.run.errors import UserError
from hrlspec.run.files import write_atomically
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import check_writable
from hrlspec.run.signals import leave


@dataclasses.dataclass(frozen=True)
class PeersFlags(EngineFlags):
    """Runs and evaluates what the comparison with published results is made of, as far as it is missing."""

    only: tuple[str, ...] = ()
    """Worlds, such as letter12 or conveyor-simple-8; all if not given."""
    seeds: int = setting(NUM_SEEDS, least=1)
    """Runs of each world, seeds 0, 1, ..."""
    out: Path | None = None
    """Records and the page, peers.md; in the checkout results/peers if not given."""
    work: Path | None = None
    """Run folders with their checkpoints; runs in --out if not given, or without it runs/peers."""
    dry_run: bool = False
    """Only say what would be run."""


def main(argv: Sequence[str], *, program: str = "hrlspec peers") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage, an evaluation failed, or a damaged folder or file of records.
        SystemExit: with a message, when runs failed; the others are done.
        Interrupted: stopped by a signal; the runs have saved what they did.
    """
    flags = parse_flags(PeersFlags, argv, program=program)
    for name in flags.only:
        if name not in COMPARISONS:
            raise UserError(f"--only {name}: there is no such world, expected some of: {', '.join(COMPARISONS)}")
    engine = engine_of(flags)
    out = flags.out or Path("results/peers")
    work = flags.work or (flags.out / "runs" if flags.out else Path("runs/peers"))
    console = PlainConsole(stderr=True)
    asked = [comparison for name, comparison in COMPARISONS.items() if name in (flags.only or COMPARISONS)]
    wanted = _evaluations(asked, flags.seeds)
    known = read_evaluations(wanted, out)
    missing = [one for one in wanted if one not in known]
    agents = list(dict.fromkeys(one.run for one in missing))
    recorded = read_records(agents, out)
    # One that is finished and has no record was stopped in between: made again it is found finished, and recorded.
    runs = [run for run in agents if run not in recorded or made(run, work) is None]
    console.say(f"{len(wanted)} evaluations, {len(missing)} of them missing, and {len(runs)} runs for them")
    if flags.dry_run:
        for run in runs:
            print(command(run, work))
        return
    for folder in (out, work):
        check_writable(folder)
    if runs:
        make(runs, work=work, records=out, engine=engine, console=console)
    for run in agents:
        if made(run, work) is None:
            what = f"another run of that name than the one of {run.total_steps:,} steps that is asked for"
            raise UserError(f"{work / run.name} holds {what}; move it away, and the same command makes this one")
    for done in evaluate(missing, work=work, folder=out, jobs=flags.jobs):
        console.say(f"evaluated: {done.run.name} on {done.suite}")
    # The page is about all that is known, whatever was asked for now.
    every = _evaluations([*COMPARISONS.values()], max(flags.seeds, NUM_SEEDS))
    scores, records = read_evaluations(every, out), read_records({one.run for one in every}, out)
    write_atomically(out / "peers.md", "\n".join(page(records, scores)) + "\n")
    console.say(f"written: {out / 'peers.md'}")


def _evaluations(comparisons: Sequence[Comparison], seeds: int) -> list[Evaluation]:
    return [Evaluation(run, suite) for some in comparisons for run in some.runs(seeds) for suite in some.suites]


if __name__ == "__main__":
    leave(call("peers", program="python -m experiments.peers"))
