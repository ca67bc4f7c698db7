"""Throughput of Letter: environment, rollout, and end-to-end training, with compile times apart; one JSON object.

python -m benchmarks.letter [--env letter12] [--recipes paper hrlspec] [--seconds 10] [--out FILE]
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Literal

import tyro

from benchmarks import common
from hrlspec.run.errors import main_guard


@dataclasses.dataclass(frozen=True)
class Flags(common.CommonFlags):
    """What to measure."""

    env: Literal["letter", "letter12"] = "letter"


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    common.main(
        "letter",
        flags.env,
        flags,
        lambda: {"environment_steps_per_s": common.environment(flags.env, flags.seconds)},
    )


if __name__ == "__main__":
    sys.exit(main_guard(main))
