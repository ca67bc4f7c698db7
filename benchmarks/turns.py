"""Training speed of several checkouts, by processes that live side by side and take turns; JSON.

python -m benchmarks.turns before=../before:1 before=../before:2 now=.:2 [--env letter] [--recipe hrlspec] [--out FILE]

Each contestant is ``NAME=CHECKOUT:DEVICES``, with ``@CORES`` behind it on so many cores alone; ratios are to the first.
``2x1@1`` are two processes that train together, with a device and a core each. Machines that are shared change their
speed by a third within minutes, so what ran one after the other cannot be compared; what takes turns every few seconds
can.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tyro

from benchmarks.common import spread
from hrlspec.presets import Recipe
from hrlspec.run.errors import UserError, main_guard
from hrlspec.run.hosts import local_address

# Run with each checkout's own modules; so it may use only what all of them have.
_CONTESTANT = """
import contextlib, json, os, sys, time
name, recipe, devices, changes = sys.argv[1], sys.argv[2], int(sys.argv[3]), json.loads(sys.argv[4])
count, index, address = int(sys.argv[6]), int(sys.argv[7]), sys.argv[8]
if sys.argv[5]:
    each = int(sys.argv[5])
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[each * index : each * (index + 1)])
together = contextlib.nullcontext()
if count > 1:
    from hrlspec.run.hosts import joined
    together = joined(address, count, index)
with together as hosts:
    from hrlspec.run.platform import prepare
    prepare(host_devices=devices)
    import jax, jax.numpy as jnp
    from benchmarks.common import learner, programs
    from hrlspec.config import evolve
    trainer, bank, machine = learner(name, recipe, devices * count)
    tuples = {key: tuple(value) if isinstance(value, list) else value for key, value in changes.items()}
    trainer = evolve(trainer, {"agent." + key: value for key, value in tuples.items()})
    if hosts is not None:
        hosts.meet(trainer.shards.mesh)
    init, iterate = programs(name, recipe, trainer)
    state, nothing = init(jax.random.key(0), bank, machine), jnp.zeros(1, jnp.uint32)
    before = time.perf_counter()
    state, _ = jax.block_until_ready(iterate(state, bank, machine, nothing))
    print(trainer.agent.config.steps_per_iteration, time.perf_counter() - before, jax.__version__, flush=True)
    for line in sys.stdin:
        before = time.perf_counter()
        for _ in range(int(line)):
            state, _ = iterate(state, bank, machine, nothing)
        jax.block_until_ready(state)
        print(time.perf_counter() - before, flush=True)
"""


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to compare."""

    contestants: tyro.conf.Positional[tuple[str, ...]]
    """NAME=CHECKOUT:[PROCESSESx]DEVICES[@CORES], the first is what the others are compared to; with
    ',{"config.blocks": 4}' at its end (JSON) some settings of this one are others."""
    env: str = "letter"
    recipe: Recipe = "hrlspec"
    warmup: int = 60
    """Iterations before the first turn: episodes of an untrained agent are longer."""
    turns: int = 9
    iterations: int = 2
    """In a turn."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""


class Contestant:
    """A process, or several together, that trains when it is told to."""

    def __init__(self, text: str, env: str, recipe: str) -> None:
        text, _, changes = text.partition(",")
        self.name, _, where = text.partition("=")
        checkout, _, where = where.rpartition(":")
        root, found = Path(checkout).resolve(), re.fullmatch(r"(?:(\d+)x)?(\d+)(?:@(\d+))?", where)
        if not found or not (root / "benchmarks" / "common.py").is_file():
            raise UserError(
                f"contestant {text!r}: expected NAME=CHECKOUT:[PROCESSESx]DEVICES[@CORES], a checkout of this project"
            )
        processes, devices, cores = found[1] or "1", found[2], found[3] or ""
        self.what = {"commit": _commit(root), "devices": int(devices)}
        self.what |= {"processes": int(processes)} if found[1] else {}
        self.what |= ({"cores": int(cores)} if cores else {}) | ({"changes": changes} if changes else {})
        command = [sys.executable, "-c", _CONTESTANT, env, recipe, devices, changes or "{}", cores, processes]
        address = local_address()
        self._processes = [
            subprocess.Popen(
                [*command, str(index), address],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=root,
                env=os.environ | {"PYTHONPATH": str(root)},
            )
            for index in range(int(processes))
        ]  # fmt: skip
        steps, first, self.jax = self._answer().split()
        self.steps, self.first_iteration_s = int(steps), float(first)

    def train(self, iterations: int) -> float:
        """Steps/s of so many iterations."""
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write(f"{iterations}\n")
            process.stdin.flush()
        return iterations * self.steps / float(self._answer())

    def _answer(self) -> str:
        first = self._processes[0]
        assert first.stdout is not None
        answer = first.stdout.readline()
        if not answer:
            raise UserError(f"contestant {self.name} ended with status {first.wait()}, see above")
        return answer


def _commit(root: Path) -> str:
    """The commit of a checkout, and whether it was changed."""
    git = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    answer = subprocess.run(git, check=False, capture_output=True, text=True)
    if answer.returncode:
        raise UserError(f"{root} is no checkout: {answer.stderr}")
    return answer.stdout.strip()


def compare(flags: Flags) -> Mapping[str, Any]:
    """Medians over the turns, and of their ratios to the first contestant's."""
    contestants = [Contestant(text, flags.env, flags.recipe) for text in flags.contestants]
    for one in contestants:
        one.train(flags.warmup)
    turns = [[one.train(flags.iterations) for one in contestants] for _ in range(flags.turns)]
    report: dict[str, Any] = {"env": flags.env, "recipe": flags.recipe, "jax": contestants[0].jax}
    for i, one in enumerate(contestants):
        rates, ratios = [turn[i] for turn in turns], [turn[i] / turn[0] for turn in turns]
        report[f"{one.name}, {one.what['devices']} devices"] = {
            **one.what,
            "first_iteration_s": round(one.first_iteration_s, 1),
            "steps_per_s": spread(rates, 0),
            "ratio": spread(ratios, 3),
        }
    return report


def main() -> None:
    """Compares and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    text = json.dumps(compare(flags), indent=2)
    print(text)
    if flags.out:
        flags.out.write_text(text + "\n")


if __name__ == "__main__":
    sys.exit(main_guard(main))
