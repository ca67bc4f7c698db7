"""What the throughput scripts share: rates of the environment, of rollouts and of training, and compile times."""

from __future__ import annotations

import dataclasses
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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax
from hrlspec.agent.agent import Agent
from hrlspec.config import ConfigError, evolve
from hrlspec.learning.rollout import Setting, collect, fill_pool
from hrlspec.learning.train import Trainer
from hrlspec.presets import Recipe, preset
from hrlspec.run.circumstances import circumstances
from hrlspec.run.errors import UserError
from hrlspec.run.platform import prepare
from hrlspec.run.programs import Program
from hrlspec.tasks.bank import TaskBanks


@dataclasses.dataclass(frozen=True)
class CommonFlags:
    """What to measure; each script adds its environments."""

    recipes: tuple[Recipe, ...] = ("paper", "hrlspec")
    seconds: float = 10.0
    """At least this long for each figure, compile time apart."""
    devices: int = 1
    """Over how many devices training is spread, in as many blocks of environments; on a CPU, threads."""
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


def spread(values: Sequence[float], digits: int) -> Mapping[str, float]:
    """Median, least and most."""
    return {of.__name__: round(of(values), digits) for of in (statistics.median, min, max)}


def environment(
    name: str,
    seconds: float,
    *,
    num_envs: int = 1024,
    num_steps: int = 128,
    resets: bool = False,
    redraw: bool = True,
) -> dict[str, float]:
    """The bare environment under random actions.

    Args:
        name: of the preset.
        seconds: at least this long.
        num_envs: side by side.
        num_steps: in one call.
        resets: whether episodes that end begin anew; otherwise they go on.
        redraw: whether drawing the actions is part of it; otherwise all calls take the same ones. To draw numbers
            costs more than a step of the cheapest environments.
    """
    env = envs_jax.make(name)
    params = env.default_params
    keys = jax.random.split(jax.random.key(0), num_envs)
    observation, state = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)
    act = jax.vmap(env.step if resets else env.step_env, in_axes=(0, 0, 0, None))
    shape = (num_steps, num_envs, *env.action_space.shape)

    def draw(key: jax.Array) -> jax.Array:
        if isinstance(env.action_space, envs_jax.Discrete):
            return jax.random.randint(key, shape, 0, env.action_space.n)
        return jax.random.uniform(key, shape, jnp.float32, env.action_space.low, env.action_space.high)

    fixed = None if redraw else draw(jax.random.key(2))

    @jax.jit
    def roll(carry: Any) -> Any:
        key, state, seen = carry
        key, action_key = jax.random.split(key)
        actions = draw(action_key) if fixed is None else fixed
        reset_keys = jax.vmap(jax.random.split, (0, None), 1)(keys, num_steps) if resets else None

        def step(carry: Any, inputs: tuple[jax.Array, Any]) -> tuple[Any, None]:
            state, seen = carry
            action, step_keys = inputs
            result = act(keys if step_keys is None else step_keys, state, action, params)
            # Everything a learner would read is read, or the compiler would leave it out.
            return (result[1], seen + result[0] + jax.vmap(env.labels, (0, None))(result[1], params).sum()), None

        (state, seen), _ = jax.lax.scan(step, (state, seen), (actions, reset_keys))
        return key, state, seen

    return rate(roll, (jax.random.key(1), state, observation), num_envs * num_steps, seconds)


def trainer_of(name: str, recipe: Recipe, devices: int, num_envs: int | None = None) -> Trainer:
    """The paper's method with a recipe's settings, on so many devices in as many blocks.

    Args:
        name: of the preset.
        recipe: whose settings.
        devices: as many as blocks.
        num_envs: side by side; the preset's if not given.

    Raises:
        UserError: the devices or minibatches do not share the environments evenly, or there are not as many devices.
    """
    some = preset(name)
    config, method = some.settings("ours", recipe)
    changes = {"blocks": devices} | ({} if num_envs is None else {"num_envs": num_envs})
    try:
        return Trainer(Agent(some.make(), evolve(config, changes), method), devices)
    except ConfigError as error:
        asked = f"--devices {devices}" + ("" if num_envs is None else f", {num_envs} environments")
        raise UserError(f"{asked}: {error}") from error


def learner(name: str, recipe: Recipe, devices: int, num_envs: int | None = None) -> tuple[Trainer, Any, Any]:
    """The paper's method, a bank of training tasks, and the rewards of set 1; arguments as of `trainer_of`."""
    trainer = trainer_of(name, recipe, devices, num_envs)
    nothing = np.zeros(0, np.uint32)
    banks = TaskBanks(0, trainer.agent.config.curriculum, trainer.agent.env.num_propositions, nothing)
    return trainer, banks.at(0), preset(name).rewards()


def programs(name: str, recipe: Recipe, trainer: Trainer) -> tuple[Program, Program]:
    """The training state and an iteration, compiled as runs do."""
    effort = preset(name).effort(recipe)
    init = Program("init", Trainer.init, trainer, effort=effort, devices=trainer.devices)
    return init, Program("iterate", Trainer.iterate, trainer, effort=effort, devices=trainer.devices)


def training(name: str, recipe: Recipe, seconds: float, devices: int) -> dict[str, Any]:
    """Rollout alone, on one device, and whole iterations with every technique of the recipe."""
    trainer, bank, machine = learner(name, recipe, devices)
    agent, config = trainer.agent, trainer.agent.config
    reserved = jnp.zeros(1, jnp.uint32)
    init, iterate = programs(name, recipe, trainer)
    state = init(jax.random.key(0), bank, machine)
    # Some learning first: episodes of an untrained agent are longer, and have fewer decisions.
    for _ in range(30):
        state, _ = iterate(state, bank, machine, reserved)
    result: dict[str, Any] = {}

    @jax.jit
    def roll(collector: Any) -> Any:
        tasks = jax.tree.map(lambda *x: jnp.concatenate(x), state.tasks, bank)
        book = agent.low.prepare(state.params, tasks)
        envs = jnp.arange(config.num_envs, dtype=jnp.int32)
        pool = fill_pool(jax.random.key(1), agent, book, state.curriculum.level, envs, size=config.episode_slots - 1)
        setting = Setting(agent, state.params, machine, book, pool, envs)
        return collect(jax.random.key(2), setting, collector, config.noise_correlation)[0]

    if devices == 1:
        result["rollout_steps_per_s"] = rate(roll, state.collector, config.steps_per_iteration, seconds)
    result["training_steps_per_s"] = rate(
        lambda state: iterate(state, bank, machine, reserved)[0], state, config.steps_per_iteration, seconds
    )
    result["config"] = dataclasses.asdict(config)
    result["method"] = dataclasses.asdict(agent.method)
    return result


def start(name: str, recipe: Recipe, devices: int) -> dict[str, float]:
    """Seconds that the training state took, and those that the first iteration took, in this process."""
    trainer, bank, machine = learner(name, recipe, devices)
    init, iterate = programs(name, recipe, trainer)
    before = time.perf_counter()
    state = jax.block_until_ready(init(jax.random.key(0), bank, machine))
    between = time.perf_counter()
    reserved = jnp.zeros(1, jnp.uint32)
    jax.block_until_ready(iterate(state, bank, machine, reserved))
    return {"init_s": between - before, "iteration_s": time.perf_counter() - between}


def compile_times(script: str, name: str, recipe: str, devices: int) -> dict[str, dict[str, float]]:
    """The same start in two fresh processes: with an empty compilation cache, then with the one it left."""
    result = {}
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, "-m", f"benchmarks.{script}", "--env", name, "--recipes", recipe, "--only-start"]
        command += ["--devices", str(devices)]
        environ = os.environ | {"JAX_COMPILATION_CACHE_DIR": cache}
        for which in ("cold", "warm"):
            before = time.perf_counter()
            run = subprocess.run(command, env=environ, check=True, capture_output=True, text=True)
            result[which] = {**json.loads(run.stdout), "process_s": time.perf_counter() - before}
    return result


def write_report(flags: Any, measured: Mapping[str, Any]) -> None:
    """Prints one JSON object, of the flags, what was measured and on what; and writes it to ``flags.out``, if any."""
    asked = {name: value for name, value in dataclasses.asdict(flags).items() if name != "out"}
    text = json.dumps({**asked, **measured, **circumstances(command=False)}, indent=2)
    print(text)
    if flags.out:
        flags.out.write_text(text + "\n")


def main(script: str, env: str, flags: CommonFlags, measure: Callable[[], Mapping[str, Any]]) -> None:
    """Measures and prints one JSON object.

    Args:
        script: the module's name within this package.
        env: the preset.
        flags: what to measure.
        measure: the entries about the environment alone.
    """
    prepare(host_devices=flags.devices)
    for recipe in flags.recipes:
        trainer_of(env, recipe, flags.devices)  # what cannot be is refused before anything is measured
    if flags.only_start:
        print(json.dumps(start(env, flags.recipes[0], flags.devices)))
        return
    report: dict[str, Any] = {
        "benchmark": script,
        "env": env,
        "versions": {
            "python": platform.python_version(),
            "jax": jax.__version__,
            "jaxlib": importlib.metadata.version("jaxlib"),
        },
        "device": jax.devices()[0].device_kind,
        "devices": flags.devices,
        "cores": os.cpu_count(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        **measure(),
    }
    for recipe in flags.recipes:
        compiled = compile_times(script, env, recipe, flags.devices)
        report[recipe] = {"compile": compiled, **training(env, recipe, flags.seconds, flags.devices)}
    report["peak_memory_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    text = json.dumps(report, indent=2)
    print(text)
    if flags.out:
        flags.out.write_text(text + "\n")
