"""What Ray costs: seconds of the same runs by the local engine and on a Ray cluster of this machine; one JSON object.

python -m benchmarks.sweeps [--env letter] [--total-steps 200000] [--seeds 4] [--turns 3] [--out FILE]

The two take turns, for machines that are shared change their speed; each turn is a sweep of the same runs into a new
folder, from the start of its process to its end. Programs are compiled before.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import tyro

from hrlspec.run.circumstances import circumstances
from hrlspec.run.errors import UserError, main_guard

ENGINES: dict[str, tuple[str, ...]] = {"local": (), "ray": ("--ray", "local")}


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to measure."""

    env: str = "letter"
    total_steps: int = 200_000
    """Of each run."""
    seeds: int = 4
    """Runs of a sweep."""
    turns: int = 3
    """Sweeps by each engine."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""


def sweep_seconds(engine: str, flags: Flags) -> float:
    """Seconds of a sweep, its process included.

    Raises:
        UserError: it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        own = ["--out", folder, "--seeds", f"0-{flags.seeds - 1}", *ENGINES[engine]]
        shared = ["--env", flags.env, "--total-steps", str(flags.total_steps)]
        command = [sys.executable, "-m", "hrlspec.run.cli", "sweep", *own, "--", *shared]
        before = time.perf_counter()
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - before
    if ended.returncode:
        raise UserError(f"the sweep by {engine} failed: {ended.stderr}")
    return seconds


def measure(flags: Flags) -> dict[str, Any]:
    """Seconds by engine, turn by turn, and what Ray adds to the local engine's."""
    sweep_seconds("local", dataclasses.replace(flags, seeds=1, total_steps=1))  # compiles, in one iteration
    turns = [{engine: sweep_seconds(engine, flags) for engine in ENGINES} for _ in range(flags.turns)]
    added = [turn["ray"] / turn["local"] - 1 for turn in turns]
    return {
        "seconds": {engine: [round(turn[engine], 2) for turn in turns] for engine in ENGINES},
        "added": {of.__name__: round(of(added), 4) for of in (statistics.median, min, max)},
    }


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    settings = {**dataclasses.asdict(flags), "out": None}
    text = json.dumps({"benchmark": "sweeps", **settings, **measure(flags), **circumstances()}, indent=2)
    print(text)
    if flags.out is not None:
        flags.out.write_text(text + "\n")


if __name__ == "__main__":
    sys.exit(main_guard(main))
