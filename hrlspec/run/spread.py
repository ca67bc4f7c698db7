"""Over which devices runs are spread: one after another, each over all, or seeds side by side, each on one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax

from hrlspec import checkpoint
from hrlspec.learning.shards import most_devices, num_devices
from hrlspec.run import platform
from hrlspec.run.errors import UserError
from hrlspec.run.hosts import Hosts
from hrlspec.run.run_flags import RunFlags


@dataclasses.dataclass(frozen=True)
class Spread:
    """How runs lie on devices.

    Attributes:
        side_by_side: whether the seeds train as one program.
        devices: those of one run, or of all seeds side by side.
        step: of the checkpoints from which seeds side by side go on, if they do.
    """

    side_by_side: bool
    devices: int
    step: int | None = None


def spread(flags: RunFlags, blocks: int, folders: Sequence[Path], hosts: Hosts) -> Spread:
    """Prepares JAX, and says how the runs in some folders are spread.

    What was not asked for is done where it costs less (``benchmarks/seeds.py``): on a CPU seeds train side by side if
    they share its cores evenly, and no fewer of them than one run alone would use. An accelerator has room for all of
    them at once; nothing was measured on one.

    Args:
        flags: of the command.
        blocks: of environments.
        folders: of the runs that are to be made or to go on.
        hosts: which process this is of how many that train together, each with as many devices.

    Raises:
        UserError: the devices share neither blocks nor processes evenly, or there are not as many, or the seeds cannot
            go on side by side.
    """
    count, seeds = hosts.count, len(folders)
    if blocks % count:
        raise UserError(f"--config.blocks is {blocks}, expected a multiple of {count}, the number of processes")
    automatic, cores = flags.devices == "auto", len(platform.cores())
    alone = hosts.lead(lambda: most_devices(blocks // count, cores) * count)
    if not automatic:
        alone = cores = int(flags.devices)
    if alone % count:
        raise UserError(f"--devices is {alone}, expected a multiple of {count}, the number of processes")
    possible, step = (False, None) if seeds < 2 or count > 1 else _goes_on(flags, folders)
    shared = most_devices(seeds, cores) if possible else 1
    side_by_side = possible and (flags.parallel_seeds or 1 < shared >= alone)
    platform.prepare(host_devices=shared if side_by_side and automatic else alone // count)
    available = num_devices()
    if not automatic and alone > available:
        raise UserError(f"--devices is {alone}, but JAX has {available} ({jax.default_backend()})")
    most = available if automatic else alone
    if side_by_side or (possible and jax.default_backend() != "cpu"):
        return Spread(True, most_devices(seeds, most), step)
    return Spread(False, most_devices(blocks // count, most // count) * count)


def _goes_on(flags: RunFlags, folders: Sequence[Path]) -> tuple[bool, int | None]:
    """Whether seeds can train side by side, and the newest step of which all have a checkpoint, if any has one.

    Raises:
        UserError: it was asked for, and only some have one, or none of the same step.
    """
    known = [{*checkpoint.steps(folder / "checkpoints")} for folder in folders]
    common = set.intersection(*known)
    if common or not any(known):
        return not flags.no_parallel_seeds, max(common, default=None)
    if flags.parallel_seeds:
        stand = ", ".join(
            f"{folder} at step {max(some, default=0)}" for folder, some in zip(folders, known, strict=True)
        )
        raise UserError(f"no step has a checkpoint of each seed ({stand}): --no-parallel-seeds goes on with each alone")
    return False, None
