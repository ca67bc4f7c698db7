"""Training speed over the number of environments, on one device, with compile times apart; one JSON object.

python -m benchmarks.batches [--envs letter walk zone] [--num-envs 128 1024 8192] [--recipes hrlspec] [--out FILE]

The other settings are the preset's: a batch that is twice as large is cut into as many minibatches, each twice as
large. What an agent learns from so many environments is another question.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro

from benchmarks.common import environment, learner, programs, rate, trainer_of, write_report
from hrlspec.presets import Recipe
from hrlspec.run.errors import main_guard
from hrlspec.run.platform import prepare


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to measure."""

    envs: tuple[str, ...] = ("letter", "walk", "zone")
    recipes: tuple[Recipe, ...] = ("hrlspec",)
    num_envs: tuple[int, ...] = (128, 256, 1024, 4096, 16384)
    """Environments side by side."""
    iterations: int = 10
    """Of training before the speed is taken: episodes of an untrained agent are longer."""
    seconds: float = 5.0
    """At least this long for each figure, compile time apart."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""


class Case:
    """A training state of so many environments, compiled and partly trained."""

    def __init__(self, name: str, recipe: Recipe, num_envs: int, iterations: int) -> None:
        trainer, bank, machine = learner(name, recipe, 1, num_envs)
        init, iterate = programs(name, recipe, trainer)
        reserved = jnp.zeros(1, jnp.uint32)
        self._steps = trainer.agent.config.steps_per_iteration
        self._step = lambda state: iterate(state, bank, machine, reserved)[0]
        before = time.perf_counter()
        self._state = jax.block_until_ready(self._step(init(jax.random.key(0), bank, machine)))
        self._start_s = time.perf_counter() - before
        for _ in range(iterations):
            self._state = self._step(self._state)

    def measured(self, seconds: float) -> dict[str, Any]:
        """Rates of whole iterations, and what the start took."""
        rates = rate(self._step, self._state, self._steps, seconds)
        return {
            "training_steps_per_s": {name: round(value) for name, value in rates.items()},
            "iteration_ms": round(1000 * self._steps / rates["median"], 1),
            "start_s": round(self._start_s, 1),
        }


def measure(flags: Flags) -> dict[str, Any]:
    """By environment, recipe and number of environments."""
    report: dict[str, Any] = {}
    for name in flags.envs:
        bare = {
            str(number): round(environment(name, flags.seconds, num_envs=number)["median"]) for number in flags.num_envs
        }
        report[name] = {"environment_steps_per_s": bare}
        for recipe in flags.recipes:
            report[name][recipe] = {
                str(number): Case(name, recipe, number, flags.iterations).measured(flags.seconds)
                for number in flags.num_envs
            }
    return report


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    prepare()
    for name in flags.envs:  # what cannot be is refused before anything is measured
        for recipe in flags.recipes:
            for number in flags.num_envs:
                trainer_of(name, recipe, 1, number)
    device = jax.devices()[0].device_kind
    write_report(flags, {"device": device, "measured": measure(flags)})


if __name__ == "__main__":
    sys.exit(main_guard(main))
