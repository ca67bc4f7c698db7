"""Throughput of Walk and FlatWorld: environment, the planner that knows the map, rollout, training; one JSON object.

python -m benchmarks.walk [--env flatworld] [--recipes hrlspec] [--seconds 10] [--out FILE]
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from typing import Any, Literal

import jax
import numpy as np
import tyro

import envs_jax
from benchmarks import common
from hrlspec.exact.shortest_path import planned_steps
from hrlspec.run.errors import main_guard
from hrlspec.tasks.sampling import sample_trees


@dataclasses.dataclass(frozen=True)
class Flags(common.CommonFlags):
    """What to measure."""

    env: Literal["walk", "flatworld"] = "walk"


def planner(name: str, num_tasks: int = 20) -> dict[str, float]:
    """Seconds to solve a random task of depth 2 to 4 in one layout: least steps and the nearest-first agent's."""
    env = envs_jax.make(name)
    assert isinstance(env, envs_jax.GridMap)
    layouts = jax.tree.map(lambda x: np.asarray(x)[None], env.sample_layout(jax.random.key(0), env.default_params))
    trees = sample_trees(
        np.random.default_rng(0),
        num_tasks=num_tasks + 1,
        num_propositions=env.num_propositions,
        max_nodes=16,
        min_depth=2,
        max_depth=4,
        max_branching=3,
        reserved=None,
    )
    seconds = []
    for i in range(num_tasks + 1):
        before = time.perf_counter()
        planned_steps(env, layouts, jax.tree.map(lambda x, i=i: x[i], trees))
        seconds.append(time.perf_counter() - before)
    kept = seconds[1:]  # The first one compiles something.
    return {"median": statistics.median(kept), "min": min(kept), "max": max(kept), "tasks": num_tasks}


def measure(flags: Flags) -> dict[str, Any]:
    """What needs no learner."""
    sizes: dict[str, Any] = {"num_envs": 256, "num_steps": 1024, "redraw": False}
    return {
        "environment_steps_per_s": common.environment(flags.env, flags.seconds, **sizes),
        "environment_with_resets_steps_per_s": common.environment(flags.env, flags.seconds, resets=True, **sizes),
        "planner_s_per_task": planner(flags.env),
    }


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    common.main("walk", flags.env, flags, lambda: measure(flags))


if __name__ == "__main__":
    sys.exit(main_guard(main))
