"""What a run costs on more devices: bytes, memory and time, predicted from shapes and a few constants; one JSON object.

python -m benchmarks.scale_model [--envs letter walk zone] [--recipe hrlspec] [--no-measure] [--out FILE]

What devices exchange is read off the traced program, and memory off the shapes: neither needs a measurement. Constants
are measured on two cores of this machine: an iteration of the preset's environments, and of half of them, on one core
while the other does the same; and sums over two devices, of rows of several lengths. From these an iteration on two
devices is predicted, and is measured too, by turns with the others. Run it on an otherwise idle machine with two cores
or more.

Axes: **D** devices, one block of environments on each.
"""

from __future__ import annotations

import dataclasses
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import learner, programs
from hrlspec.config import evolve
from hrlspec.learning.shards import SPREAD, Shards
from hrlspec.learning.train import Trainer
from hrlspec.presets import Recipe, preset
from hrlspec.run.circumstances import circumstances
from hrlspec.run.errors import UserError, main_guard
from hrlspec.run.places import Place
from hrlspec.run.platform import prepare

WARMUP = 30
"""Iterations before any is timed: episodes of an untrained agent are longer."""
ROWS = (1, 1_000, 10_000, 50_000, 200_000)
"""Lengths of the rows that are summed, float32."""
GATHERS = 20
"""Sums in one program, so that its start counts for little."""


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to predict."""

    envs: tuple[str, ...] = ("letter", "walk", "zone")
    recipe: Recipe = "hrlspec"
    devices: tuple[int, ...] = (1, 8, 64, 512)
    bandwidths: tuple[float, ...] = (1.25, 12.5, 100.0)
    """Of one device, GB/s: what 10 and 100 Gbit/s of Ethernet are, and of the order of links between accelerators."""
    latency: float = 30e-6
    """Seconds of an exchange however short, for these bandwidths; an assumption."""
    seconds: float = 10.0
    """At least this long for each figure, each time."""
    turns: int = 3
    """How often iterations are timed, one core and two devices by turns."""
    measure: bool = True
    """Measure constants, and an iteration on two devices."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""
    only_iteration: str = ""
    """ENV:DEVICES:NUM_ENVS: just time iterations and print the seconds; for the processes that measure."""


class Sum(NamedTuple):
    """A sum over all blocks (`Shards.total`) as a program has it.

    Attributes:
        row_bytes: of one block, which goes to all devices but its own.
        times: in one iteration.
    """

    row_bytes: int
    times: int


def sums_of(jaxpr: Any, times: int = 1) -> Iterator[Sum]:
    """The sums of a traced program for two or more devices with one block each, those in loops as often as they run."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "all_gather":
            yield from (Sum(x.aval.size * x.aval.dtype.itemsize, times) for x in equation.invars)
        inner = times * equation.params.get("length", 1) if equation.primitive.name == "scan" else times
        branches = [part for value in equation.params.values() for part in _jaxprs(value)]
        yield from max(([*sums_of(branch, inner)] for branch in branches), key=len, default=[])


def _jaxprs(value: Any) -> list[Any]:
    """The programs in a parameter of an operation."""
    if isinstance(value, tuple | list):
        return [part for entry in value for part in _jaxprs(entry)]
    inner = getattr(value, "jaxpr", value)
    return [inner] if hasattr(inner, "eqns") else []


def exchanged(sums: Sequence[Sum], devices: int) -> int:
    """Bytes that each of D devices receives in an iteration, and those that it sends if each has a link to each."""
    return (devices - 1) * sum(one.row_bytes * one.times for one in sums)


def exchange_seconds(sums: Sequence[Sum], devices: int, latency: float, bandwidth: float) -> float:
    """Seconds of an iteration's exchange.

    Args:
        sums: of the iteration.
        devices: D.
        latency: seconds of an exchange however short.
        bandwidth: bytes/s that a device receives.
    """
    if devices == 1:
        return 0.0
    return latency * sum(one.times for one in sums) + exchanged(sums, devices) / bandwidth


def size(tree: Any) -> int:
    """Bytes of arrays or of their shapes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def shapes(name: str, recipe: Recipe) -> dict[str, Any]:
    """What an iteration exchanges, and what a seed keeps in memory; nothing is computed."""
    seen: dict[str, int] = {}

    class Watched(Trainer):
        """Looks at what is learned from."""

        def _learn(self, key: Any, pick_key: Any, state: Any, experience: Any, steps: Any, progress: Any) -> Any:
            seen.update(rollout=size(steps), experience=size(experience))
            return super()._learn(key, pick_key, state, experience, steps, progress)

    trainer, bank, machine = learner(name, recipe, devices=2)
    nothing = jax.ShapeDtypeStruct((1,), jnp.uint32)
    state = jax.eval_shape(trainer.init, jax.random.key(0), bank, machine)
    jaxpr = jax.make_jaxpr(Trainer.iterate, static_argnums=0)(trainer, state, bank, machine, nothing)
    sums = [*sums_of(jaxpr.jaxpr)]
    config = trainer.agent.config
    alone = Watched(evolve(trainer.agent, {"config.blocks": 1}))
    jax.eval_shape(alone.iterate, state, bank, machine, nothing)
    memory = {
        "parameters": size(state.params),
        "optimisers": size(state.optimisers),
        "running_episodes": size((state.collector, state.tasks)),
        **seen,
    }
    return {
        "num_envs": config.num_envs,
        "steps_per_iteration": config.steps_per_iteration,
        "parameters": {part: size(some) // 4 for part, some in state.params.items()},
        "sums": [one._asdict() for one in sums],
        "memory_bytes": {**memory, "total": sum(memory.values())},
    }


def sum_seconds(seconds: float) -> dict[str, Any]:
    """Latency and bandwidth of sums over two devices of this machine, by least squares of relative errors."""
    shards = Shards(num_envs=2, blocks=2, devices=2)

    def many(x: Any) -> Any:
        def step(x: Any, _: None) -> tuple[Any, None]:
            return x + 1e-9 * shards.total(x), None

        return jax.lax.scan(step, x, None, GATHERS)[0]

    program = jax.jit(shards.on_each(many, (SPREAD,), SPREAD))
    found = {}
    for length in ROWS:
        rows = jax.block_until_ready(program(jnp.zeros((2, length), jnp.float32)))
        found[length] = statistics.median(_timed(program, rows, seconds / len(ROWS))) / GATHERS
    received, took = 4.0 * np.array(ROWS), np.array([*found.values()])
    terms = np.stack([np.ones(len(ROWS)), received], axis=1) / took[:, None]
    (latency, per_byte), *_ = np.linalg.lstsq(terms, np.ones(len(ROWS)), rcond=None)
    return {"latency_s": float(latency), "bytes_per_s": float(1 / per_byte), "seconds": found}


def _timed(step: Any, carry: Any, seconds: float) -> list[float]:
    """Seconds of each call of ``carry = step(carry)``, five at least."""
    times: list[float] = []
    while sum(times) < seconds or len(times) < 5:
        before = time.perf_counter()
        carry = jax.block_until_ready(step(carry))
        times.append(time.perf_counter() - before)
    return times


def time_iterations(what: str, recipe: Recipe, seconds: float) -> float:
    """Median seconds of an iteration in this process.

    Args:
        what: ``ENV:DEVICES:NUM_ENVS``.
        recipe: whose settings.
        seconds: at least this long.
    """
    name, devices, num_envs = what.split(":")
    trainer, bank, machine = learner(name, recipe, int(devices))
    trainer = evolve(trainer, {"agent.config.num_envs": int(num_envs)})
    init, iterate = programs(name, recipe, trainer)
    nothing = jnp.zeros(1, jnp.uint32)
    state = init(jax.random.key(0), bank, machine)
    for _ in range(WARMUP):
        state, _ = iterate(state, bank, machine, nothing)
    return statistics.median(_timed(lambda state: iterate(state, bank, machine, nothing)[0], state, seconds))


def iterations_of(places: Sequence[Place], what: str, flags: Flags) -> float:
    """Mean over processes, at work at the same time, of their median seconds of an iteration."""
    own = ["--only-iteration", what, "--recipe", flags.recipe, "--seconds", str(flags.seconds)]
    command = [sys.executable, "-m", "benchmarks.scale_model", *own]
    processes = [place.start(command, stdout=subprocess.PIPE) for place in places]
    said = [process.communicate()[0] for process in processes]
    if any(process.returncode for process in processes):
        raise UserError(f"timing {what} failed, see above")
    return statistics.mean(json.loads(text) for text in said)


def measured(
    name: str, known: Mapping[str, Any], sums: Mapping[str, Any], flags: Flags, variables: Mapping[str, str]
) -> dict[str, Any]:
    """Seconds of an iteration by number of environments on one core, and predicted and measured on two devices."""
    cores = sorted(os.sched_getaffinity(0))[:2]
    apart, together = [Place(variables, [core]) for core in cores], [Place(variables, cores)]
    num_envs = known["num_envs"]
    cases = [(apart, f"{name}:1:{num_envs // 2}"), (apart, f"{name}:1:{num_envs}"), (together, f"{name}:2:{num_envs}")]
    turns = [[iterations_of(where, what, flags) for where, what in cases] for _ in range(flags.turns)]
    half, whole, found = (statistics.median(times) for times in zip(*turns, strict=True))
    exchange = exchange_seconds([Sum(**one) for one in known["sums"]], 2, sums["latency_s"], sums["bytes_per_s"])
    return {
        "one_core_s": {num_envs // 2: half, num_envs: whole},
        "fixed_s": 2 * half - whole,  # of a line through both
        "per_env_s": (whole - half) / (num_envs - num_envs // 2),
        "exchange_s": exchange,
        "two_devices_s": {
            "predicted": half + exchange,
            "measured": found,
            "error": (half + exchange) / found - 1,
            "errors": [(turn[0] + exchange) / turn[2] - 1 for turn in turns],
        },
    }


def predictions(known: Mapping[str, Any], constants: Mapping[str, Any] | None, flags: Flags) -> list[dict[str, Any]]:
    """By D and bandwidth: what is exchanged where each device has the preset's environments, and what that takes.

    With constants also its share of an iteration that takes as long on a device as on a core of this machine, and how
    many times as fast D devices go through the preset's environments if they share them, as far as there are enough.
    """
    sums, num_envs = [Sum(**one) for one in known["sums"]], known["num_envs"]
    rows = []
    for devices in flags.devices:
        for bandwidth in flags.bandwidths:
            seconds = exchange_seconds(sums, devices, flags.latency, 1e9 * bandwidth)
            row: dict[str, Any] = {
                "devices": devices,
                "gb_per_s": bandwidth,
                "bytes": exchanged(sums, devices),
                "seconds": seconds,
            }
            if constants is not None:
                alone = constants["fixed_s"] + constants["per_env_s"] * num_envs
                shared = constants["fixed_s"] + constants["per_env_s"] * num_envs / devices
                row["share"] = seconds / (alone + seconds)
                row["speed_up"] = alone / (shared + seconds) if devices <= num_envs else None
            rows.append(row)
    return rows


def main() -> None:
    """Predicts, measures and prints."""
    flags = tyro.cli(Flags, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,))
    if flags.only_iteration:
        prepare(host_devices=int(flags.only_iteration.split(":")[1]))
        print(json.dumps(time_iterations(flags.only_iteration, flags.recipe, flags.seconds)))
        return
    if flags.measure and (sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2):
        raise UserError("measuring needs Linux and two cores; --no-measure predicts from shapes alone")
    own = {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "")}  # of processes that have devices of their own
    prepare(host_devices=2)
    sums = sum_seconds(flags.seconds) if flags.measure else None
    report: dict[str, Any] = {"benchmark": "scale_model", "recipe": flags.recipe, "sums": sums, "worlds": {}}
    for name in flags.envs:
        preset(name)  # there is one
        known = shapes(name, flags.recipe)
        constants = None if sums is None else measured(name, known, sums, flags, own)
        report["worlds"][name] = {**known, "constants": constants, "predictions": predictions(known, constants, flags)}
    text = json.dumps({**report, **circumstances()}, indent=2)
    print(text)
    if flags.out is not None:
        flags.out.write_text(text + "\n")


if __name__ == "__main__":
    sys.exit(main_guard(main))
