"""Trains with several processes of this machine, and keeps them going: ``hrlspec launch``."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from typing import Annotated

from tyro.conf import arg

from hrlspec import checkpoint
from hrlspec.config import Checked, setting
from hrlspec.run.console import PlainConsole
from hrlspec.run.errors import UserError
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import holds_run
from hrlspec.run.hosts import local_address
from hrlspec.run.run_flags import experiments_of, parse_run
from hrlspec.run.supervisor import supervise


@dataclasses.dataclass(frozen=True)
class LaunchFlags(Checked):
    """Trains with several processes of this machine, which share its cores, and keeps them going.

    When one dies or hangs, all begin again from the last checkpoint. What stands behind -- are the flags of hrlspec
    run, as in: hrlspec launch -n 2 -- --env letter --seed 1
    """

    processes: Annotated[int, arg(aliases=("-n",))] = setting(2, least=1)
    """How many; a divisor of --config.blocks."""
    restarts: int = setting(5, least=0)
    """How often in a row to begin again, without a new checkpoint in between."""
    patience_minutes: float = setting(30.0, least=0.1, most=1e6)
    """How long a process may compile, evaluate or save until it counts as hanging. An iteration may take ten times as
    long as the longest did."""


def main(argv: Sequence[str], *, program: str = "hrlspec launch") -> None:
    """The command line.

    Raises:
        UserError: bad usage or input; nothing was started.
        SystemExit: with the status of the run, if it is not 0.
    """
    split = list(argv).index("--") if "--" in argv else len(argv)
    flags = parse_flags(LaunchFlags, argv[:split], program=program)
    given = list(argv[split + 1 :])
    run = parse_run(given, program=program.replace("launch", "run"))
    if run.distributed is not None:
        raise UserError(f"--distributed is what {program} gives; on a cluster start hrlspec run with it")
    folders = [folder for _, folder in experiments_of(run)]

    def commands(again: bool) -> list[list[str]]:
        begun = again and not run.resume and any(map(holds_run, folders))
        command = [sys.executable, "-m", "hrlspec.run.cli", "run", *given, *(["--resume"] if begun else [])]
        if flags.processes == 1:
            return [command]
        together = ["--distributed", local_address(), "--num-processes", str(flags.processes)]
        return [[*command, *together, "--process-id", str(index)] for index in range(flags.processes)]

    status = supervise(
        commands,
        reached=lambda: [checkpoint.steps(folder / "checkpoints") for folder in folders],
        restarts=flags.restarts,
        patience=60 * flags.patience_minutes,
        say=PlainConsole(stderr=True).say,
    )
    if status:
        raise SystemExit(status)
