"""Training speed of several seeds: one after another, at once on one device, and spread over devices; JSON.

python -m benchmarks.seeds [--env letter] [--recipe hrlspec] [--numbers 2 4 8] [--devices 2] [--out FILE]

All take turns in one process, each with seeds that one run alone has trained for a while. Rates are environment steps/s
of all seeds together, ratios to those of one after another, each of which is spread over all devices. What cores spend
on an iteration of a seed depends less on who else uses the machine.
"""

from __future__ import annotations

import dataclasses
import resource
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import tyro

from benchmarks.common import spread, write_report
from hrlspec.agent.agent import Agent
from hrlspec.learning.seeds import Seeds
from hrlspec.learning.shards import most_devices
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.presets import Recipe, preset
from hrlspec.run.errors import main_guard
from hrlspec.run.platform import prepare
from hrlspec.run.programs import Program
from hrlspec.tasks.bank import TaskBanks


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to compare."""

    env: str = "letter"
    recipe: Recipe = "hrlspec"
    numbers: tuple[int, ...] = (2, 4, 8)
    """How many seeds train side by side."""
    devices: int = 2
    """Devices of the processor; runs one after another are spread over all that divide the number of blocks."""
    warmup: int = 40
    """Iterations of each seed before the first turn: episodes of an untrained agent are longer."""
    turns: int = 7
    iterations: int = 2
    """In a turn."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""


class World:
    """The paper's method under a preset's default settings, and what all ways of training it share."""

    def __init__(self, flags: Flags) -> None:
        some = preset(flags.env)
        config, method = some.settings("ours", flags.recipe)
        self.agent = Agent(some.make(), config, method)
        self.effort = some.effort(flags.recipe)
        self.machine, self.reserved = some.rewards(), jnp.asarray(some.reserved)
        number = self.agent.env.num_propositions
        self.banks = [
            TaskBanks(seed, config.curriculum, number, some.reserved).at(0) for seed in range(max(flags.numbers))
        ]

    def program(self, name: str, function: Any, of: Any) -> Program:
        """Compiled as runs do, and never found compiled."""
        return Program(name, function, of, effort=self.effort, kept=False, devices=of.devices)


class Contestant:
    """Some seeds that train when they are told to."""

    def __init__(self, name: str, seeds: int, state: TrainState, iterate: Callable[[TrainState], TrainState]) -> None:
        self.name, self.seeds, self.state, self._iterate = name, seeds, state, iterate
        self.first_iteration_s = self.train(1)[0]

    def train(self, iterations: int) -> tuple[float, float]:
        """Seconds that so many iterations take, and what all cores together spend on them."""
        before = time.perf_counter(), time.process_time()
        for _ in range(iterations):
            self.state = self._iterate(self.state)
        jax.block_until_ready(self.state)
        return time.perf_counter() - before[0], time.process_time() - before[1]


def alone(world: World, devices: int) -> list[Contestant]:
    """Each seed by itself, on so many devices."""
    trainer = Trainer(world.agent, devices)
    init = world.program("init", Trainer.init, trainer)
    iterate = world.program("iterate", Trainer.iterate, trainer)

    def one(seed: int, bank: Any) -> Contestant:
        def step(state: TrainState) -> TrainState:
            new: TrainState = iterate(state, bank, world.machine, world.reserved)[0]
            return new

        return Contestant("one after another", 1, init(jax.random.key(seed), bank, world.machine), step)

    return [one(seed, bank) for seed, bank in enumerate(world.banks)]


def side_by_side(world: World, states: Sequence[TrainState], devices: int, at_once: bool) -> Contestant:
    """Seeds on so many devices."""
    seeds = Seeds(Trainer(world.agent), len(states), devices, at_once)
    program = world.program("iterate", Seeds.iterate, seeds)
    banks = jax.tree.map(lambda *x: jnp.stack(x), *world.banks[: len(states)])
    reserved = jnp.stack([world.reserved] * len(states))

    def step(state: TrainState) -> TrainState:
        new: TrainState = program(state, banks, world.machine, reserved)[0]
        return new

    how = "at once" if at_once else "one after another"
    return Contestant(f"{len(states)} on {devices} devices, {how} on each", len(states), seeds.join(states), step)


def compare(flags: Flags) -> Mapping[str, Any]:
    """Medians over the turns, and of their ratios to one after another."""
    world = World(flags)
    seeds = alone(world, most_devices(world.agent.config.blocks, flags.devices))
    for one in seeds:
        one.train(flags.warmup)
    states = [one.state for one in seeds]
    contestants = seeds[:1]
    for number in flags.numbers:
        some = states[:number]
        contestants.append(side_by_side(world, some, 1, at_once=True))
        contestants.append(side_by_side(world, some, most_devices(number, flags.devices), at_once=False))
    steps = flags.iterations * world.agent.config.steps_per_iteration
    turns = [[one.train(flags.iterations) for one in contestants] for _ in range(flags.turns)]
    report: dict[str, Any] = {}
    for i, one in enumerate(contestants):
        rates = [one.seeds * steps / turn[i][0] for turn in turns]
        ratios = [one.seeds * turn[0][0] / turn[i][0] for turn in turns]
        spent = [turn[i][1] / (one.seeds * flags.iterations) for turn in turns]
        report[one.name] = {
            "seeds": one.seeds,
            "first_iteration_s": round(one.first_iteration_s, 1),
            "steps_per_s": spread(rates, 0),
            "ratio": spread(ratios, 3),
            "core_s_per_iteration_of_a_seed": spread(spent, 3),
        }
    return report


def main() -> None:
    """Compares and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    prepare(host_devices=flags.devices)
    jax.config.update("jax_enable_compilation_cache", False)
    contestants = compare(flags)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    write_report(flags, {"contestants": contestants, "peak_memory_mib": peak})


if __name__ == "__main__":
    sys.exit(main_guard(main))
