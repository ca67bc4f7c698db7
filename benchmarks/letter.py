"""Throughput of Letter: environment, rollout, and end-to-end training, with compile times apart; one JSON object.

python -m benchmarks.letter [--env letter12] [--recipes paper hrlspec] [--seconds 10] [--out FILE]
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from experiments.platform import prepare

prepare()

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import envs_jax
from experiments.presets import preset, rewards_of
from hrlspec.agent import Agent
from hrlspec.curriculum import draw_bank
from hrlspec.rollout import collect, fill_pool
from hrlspec.training import Trainer


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to measure."""

    env: Literal["letter", "letter12"] = "letter"
    recipes: tuple[Literal["paper", "hrlspec"], ...] = ("paper", "hrlspec")
    seconds: float = 10.0
    """At least this long for each figure, compile time apart."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""
    only_start: bool = False
    """Just build one iteration of the first recipe and print the seconds: what the compile times are made of."""


def rate(step: Callable[[Any], Any], carry: Any, steps: int, seconds: float) -> dict[str, float]:
    """Environment steps/s of ``carry = step(carry)``: median, least and most over its calls, after one warm-up."""
    carry = jax.block_until_ready(step(carry))
    rates: list[float] = []
    start = time.perf_counter()
    while time.perf_counter() - start < seconds or len(rates) < 3:
        before = time.perf_counter()
        carry = jax.block_until_ready(step(carry))
        rates.append(steps / (time.perf_counter() - before))
    return {"median": statistics.median(rates), "min": min(rates), "max": max(rates), "calls": len(rates)}


def environment(name: str, seconds: float, num_envs: int = 1024, num_steps: int = 128) -> dict[str, float]:
    """The bare environment under random actions, without resets."""
    env = envs_jax.make(name)
    params = env.default_params
    keys = jax.random.split(jax.random.key(0), num_envs)
    observation, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)

    @jax.jit
    def roll(carry: Any) -> Any:
        key, state, seen = carry
        key, action_key = jax.random.split(key)
        actions = jax.random.randint(action_key, (num_steps, num_envs), 0, 4)

        def step(carry: Any, action: jax.Array) -> tuple[Any, None]:
            state, seen = carry
            result = jax.vmap(env.step_env, in_axes=(0, 0, 0, None))(keys, state, action, params)
            # Everything a learner would read is read, or the compiler would leave it out.
            return (result[1], seen + result[0] + jax.vmap(env.labels, (0, None))(result[1], params).sum()), None

        (state, seen), _ = jax.lax.scan(step, (state, seen), actions)
        return key, state, seen

    return rate(roll, (jax.random.key(1), state, observation), num_envs * num_steps, seconds)


def training(name: str, recipe: str, seconds: float) -> dict[str, Any]:
    """Rollout alone, and whole iterations with every technique of the recipe, at the last curriculum level."""
    env, config, machine = envs_jax.make(name), preset(name, recipe, 1, "ours"), rewards_of(name, 1)
    agent = Agent(env, config)
    trainer = Trainer(agent)
    nothing = np.zeros(0, np.uint32)
    bank = jax.tree.map(
        jnp.asarray, draw_bank(np.random.default_rng(0), config.curriculum, env.num_propositions, nothing)
    )
    reserved = jnp.zeros(1, jnp.uint32)
    state = trainer.init(jax.random.key(0), bank, machine)
    # Some learning first: episodes of an untrained agent are longer, and have fewer decisions.
    for _ in range(30):
        state, _ = trainer.iterate(state, bank, machine, reserved)
    result: dict[str, Any] = {}

    @jax.jit
    def roll(collector: Any) -> Any:
        tasks = jax.tree.map(lambda *x: jnp.concatenate(x), state.tasks, bank)
        book = agent.open_book(state.params, tasks)
        pool = fill_pool(jax.random.key(1), agent, book, state.curriculum.level, config.episode_slots)
        return collect(jax.random.key(2), agent, state.params, machine, book, collector, pool)[0]

    result["rollout_steps_per_s"] = rate(roll, state.collector, config.steps_per_iteration, seconds)
    iterate = functools.partial(_iterate, trainer, bank, machine, reserved)
    result["training_steps_per_s"] = rate(iterate, state, config.steps_per_iteration, seconds)
    result["config"] = dataclasses.asdict(config)
    return result


def _iterate(trainer: Trainer, bank: Any, machine: Any, reserved: Any, state: Any) -> Any:
    return trainer.iterate(state, bank, machine, reserved)[0]


def start(name: str, recipe: str) -> dict[str, float]:
    """Seconds until the training state and the first iteration are there, in this process."""
    env, config, machine = envs_jax.make(name), preset(name, recipe, 1, "ours"), rewards_of(name, 1)
    trainer = Trainer(Agent(env, config))
    bank = draw_bank(np.random.default_rng(0), config.curriculum, env.num_propositions, np.zeros(0, np.uint32))
    bank = jax.tree.map(jnp.asarray, bank)
    before = time.perf_counter()
    state = jax.block_until_ready(trainer.init(jax.random.key(0), bank, machine))
    between = time.perf_counter()
    reserved = jnp.zeros(1, jnp.uint32)
    jax.block_until_ready(trainer.iterate(state, bank, machine, reserved))
    return {"init_s": between - before, "iteration_s": time.perf_counter() - between}


def compile_times(name: str, recipe: str) -> dict[str, dict[str, float]]:
    """The same start in two fresh processes: with an empty compilation cache, then with the one it left."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-m", "benchmarks.letter", "--env", name, "--recipes", recipe, "--only-start"]
        environ = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache}
        runs = [subprocess.run(command, env=environ, check=True, capture_output=True, text=True) for _ in range(2)]
    cold, warm = (json.loads(run.stdout) for run in runs)
    return {"cold": cold, "warm": warm}


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    if flags.only_start:
        print(json.dumps(start(flags.env, flags.recipes[0])))
        return
    report: dict[str, Any] = {
        "benchmark": "letter",
        "env": flags.env,
        "versions": {
            "python": platform.python_version(),
            "jax": jax.__version__,
            "jaxlib": importlib.metadata.version("jaxlib"),
        },
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "environment_steps_per_s": environment(flags.env, flags.seconds),
    }
    for recipe in flags.recipes:
        report[recipe] = {"compile": compile_times(flags.env, recipe), **training(flags.env, recipe, flags.seconds)}
    report["peak_memory_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    text = json.dumps(report, indent=2)
    print(text)
    if flags.out:
        flags.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
