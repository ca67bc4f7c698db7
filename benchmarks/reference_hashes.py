"""Whether training is still the same to the bit: hashes of the parameters after 30 iterations, against those on record.

python -m benchmarks.reference_hashes [--only letter/hrlspec ...] [--record]

One line a run; exit status 1 if one differs. The record was made at the commits it names, one a recipe, with the
versions and compiler options it names: without fused multiply-adds, so that the way in which XLA groups operations does
not show. Where a commit had other names for the parts of the parameters, ``names`` in the record maps them. A change of
arithmetic that is meant is followed by ``--record``, in a commit of its own.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

FLAGS = " ".join(
    (
        "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536",
        "--xla_cpu_max_isa=AVX",
        "--xla_backend_optimization_level=1",
        "--xla_cpu_use_fusion_emitters=false",  # known to the versions that the record is of
    )
)
os.environ.update(XLA_FLAGS=FLAGS, JAX_PLATFORMS="cpu", JAX_ENABLE_COMPILATION_CACHE="false")

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from hrlspec.agent.agent import Agent
from hrlspec.checkpoint.leaves import flatten
from hrlspec.config import evolve
from hrlspec.learning.train import Trainer
from hrlspec.methods import METHODS, ImplicitPlanner
from hrlspec.presets import RECIPES, Preset, Recipe, RewardSet, preset
from hrlspec.run.errors import main_guard
from hrlspec.tasks.curriculum import draw_bank

RECORD = Path(__file__).with_suffix(".json")
ITERATIONS = 30
ITERATIONS_PER_BANK = 16
WORLDS = ("letter", "walk", "zone")


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to compare."""

    only: tuple[str, ...] = ()
    """Beginnings of runs' names, such as letter/hrlspec or zone/paper/option; all runs if not given."""
    record: bool = False
    """Put the hashes on record instead of comparing them."""


def names() -> list[str]:
    """All runs: three worlds, both recipes, both reward sets, five methods."""
    return [
        f"{world}/{recipe}/{method}/set{reward_set}"
        for world in WORLDS
        for recipe in RECIPES
        for reward_set in (1, 2)
        for method in METHODS
    ]


def trained(name: str) -> Any:
    """The parameters of a run after some iterations, seed 0."""
    world, recipe, method, reward_set = name.split("/")
    some = preset(world)
    return _trained(some, recipe, method, int(reward_set.removeprefix("set")))  # type: ignore[arg-type]


def _trained(some: Preset, recipe: Recipe, method: str, reward_set: RewardSet) -> Any:
    env, machine = some.make(), some.rewards(reward_set)
    config, chosen = some.settings(method, recipe, reward_set)
    trainer = Trainer(Agent(env, config, chosen))
    reserved = some.reserved

    def bank(number: int) -> Any:
        rng = np.random.default_rng([0, number])
        return jax.tree.map(jnp.asarray, draw_bank(rng, config.curriculum, env.num_propositions, reserved))

    state = trainer.init(jax.random.key(0), bank(0), machine)
    if not isinstance(chosen.high, ImplicitPlanner):
        # The baselines have no planner. On record one was drawn all the same, before the reach critic and so with it.
        planner = evolve(some.settings("ours", recipe, reward_set)[1].high, {"network.advice": 0.0})
        with_planner = Trainer(Agent(env, config, dataclasses.replace(chosen, high=planner)))
        drawn = with_planner.init(jax.random.key(0), bank(0), machine).params["reach_critic"]
        state = dataclasses.replace(state, params=state.params | {"reach_critic": drawn})
    iterate = Trainer.iterate.lower(trainer, state, bank(0), machine, jnp.asarray(reserved)).compile()
    for i in range(ITERATIONS):
        state, _ = iterate(state, bank(i // ITERATIONS_PER_BANK), machine, jnp.asarray(reserved))
    return state.params


def leaf_digests(params: Any) -> dict[str, str]:
    """SHA-256 of every leaf, its first 16 digits, by path."""
    return {path: leaf.digest()[:16] for path, leaf in flatten(params).items()}


def main() -> None:
    """Compares, or records."""
    flags = tyro.cli(Flags, description=__doc__)
    known: dict[str, Any] = json.loads(RECORD.read_text()) if RECORD.exists() else {"hashes": {}}
    differ = 0
    for name in names():
        if flags.only and not name.startswith(flags.only):
            continue
        before = time.perf_counter()
        digests = leaf_digests(trained(name))
        found = hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest()
        same = known["hashes"].get(name) == found
        differ += not same
        print(f"{name} {'equal' if same else 'DIFFERS'} {time.perf_counter() - before:.0f} s {found[:12]}", flush=True)
        if flags.record:
            known["hashes"][name] = found
    if flags.record:
        known |= {"jax": jax.__version__, "python": sys.version.split()[0], "flags": FLAGS}
        RECORD.write_text(json.dumps(known, indent=1) + "\n")
    elif differ:
        sys.exit(1)


if __name__ == "__main__":
    sys.exit(main_guard(main))
