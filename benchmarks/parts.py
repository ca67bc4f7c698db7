"""Where an iteration's time goes, on one device: collection and what it consists of, relabelling, learning; JSON.

python -m benchmarks.parts [--envs letter walk zone] [--recipes paper hrlspec] [--num-envs 2048] [--out FILE]

Each part is a program of its own, given what it is given in an iteration of a partly trained agent; that the sum
differs from a whole iteration is what XLA makes of the parts together.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks.common import learner, programs
from hrlspec.agent.interaction import act, decide, transition
from hrlspec.learning.batch import high_batch, low_batch
from hrlspec.learning.experience import gather
from hrlspec.learning.optimiser import annealed, fit
from hrlspec.learning.ppo import low_level_loss
from hrlspec.learning.reach import reach_batch, reach_loss
from hrlspec.learning.rollout import Setting, collect, fill_pool
from hrlspec.presets import Recipe, preset
from hrlspec.run.errors import main_guard
from hrlspec.run.platform import compiler_options, prepare


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to measure."""

    envs: tuple[str, ...] = ("letter", "walk", "zone")
    recipes: tuple[Recipe, ...] = ("paper", "hrlspec")
    num_envs: int | None = None
    """Environments side by side; the preset's if not given."""
    iterations: int = 60
    """Of training before the parts are timed."""
    seconds: float = 5.0
    """At least this long for each part, compile time apart."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""


def parts(name: str, recipe: Recipe, iterations: int, seconds: float, num_envs: int | None) -> dict[str, float]:
    """Milliseconds of an iteration by part, medians; of one step of collection, where the name says so."""
    trainer, bank, machine = learner(name, recipe, 1, num_envs)
    agent, config, ppo = trainer.agent, trainer.agent.config, trainer.agent.high.ppo
    options = compiler_options(preset(name).effort(recipe))
    reserved, key = jnp.zeros(1, jnp.uint32), jax.random.key(1)
    envs = jnp.arange(config.num_envs, dtype=jnp.int32)
    init, iterate = programs(name, recipe, trainer)
    state = init(jax.random.key(0), bank, machine)
    for _ in range(iterations):
        state, _ = iterate(state, bank, machine, reserved)
    progress = state.iteration / config.num_iterations
    report: dict[str, float] = {}

    def timed(part: str, function: Callable[..., Any], *args: Any) -> Any:
        program = jax.jit(function).lower(*args).compile(options)
        result = jax.block_until_ready(program(*args))
        times: list[float] = []
        while sum(times) < seconds or len(times) < 3:
            before = time.perf_counter()
            jax.block_until_ready(program(*args))
            times.append(1000 * (time.perf_counter() - before))
        report[part] = round(statistics.median(times), 3)
        return result

    def setting(state: Any) -> Setting:
        tasks = jax.tree.map(lambda *x: jnp.concatenate(x), state.tasks, bank)
        book = agent.low.prepare(state.params, tasks)
        pool = fill_pool(key, agent, book, state.curriculum.level, envs, size=config.episode_slots - 1)
        return Setting(agent, state.params, machine, book, pool, envs)

    def rollout(state: Any) -> Any:
        own = setting(state)
        correlation = annealed(config.noise_correlation, config.final_noise_correlation, progress)
        worker = dataclasses.replace(state.collector.worker, task=envs)
        return *collect(key, own, dataclasses.replace(state.collector, worker=worker), correlation), own.book

    def relabelled(params: Any, book: Any, steps: Any) -> Any:
        return gather(key, agent, params, machine, book, steps, reserved, envs)

    def learn(batch_of: Callable[[Any], Any], loss: Callable[..., Any], settings: Any, part: str) -> Any:
        def whole(params: Any, optimiser: Any, given: Any) -> Any:
            batch = batch_of(given)
            return fit(key, loss, params, optimiser, batch, settings, progress, trainer.shards.mean)

        return lambda given: timed(f"learn: {part}", whole, state.params[part], state.optimisers[part], given)

    collector, steps, book = timed("collect", rollout, state)
    experience = timed("build", relabelled, state.params, book, steps)
    each = trainer.shards.each_block
    learn(
        functools.partial(each, functools.partial(low_batch, agent, state.params)),
        lambda p, sample: low_level_loss(agent.low, p, sample, config.low, progress),
        config.low.optimiser,
        "low",
    )(experience)
    if ppo is not None:
        learn(
            functools.partial(each, lambda block: high_batch(key, agent, block, ppo)),
            lambda p, sample: agent.high.loss(agent.low, p, sample, progress),
            ppo.optimiser,
            "high",
        )(experience)
    if config.shield.enabled:
        learn(
            lambda steps: jax.tree.map(trainer.shards.in_blocks, reach_batch(agent.low, steps)),
            lambda p, sample: reach_loss(agent.low, p, sample),
            config.shield.optimiser,
            "reach_critic",
        )(steps)

    worker = collector.worker
    noise = jnp.zeros((config.num_envs, *agent.low.actions.noise_shape), jnp.float32)
    keys = jax.random.split(key, config.num_envs)
    silence = jnp.zeros((config.num_envs, book.tree.num_nodes), jnp.float32)
    decision = timed(
        "step: act", lambda params, book, worker: act(agent, params, book, worker, noise, None),
        state.params, book, worker,
    )  # fmt: skip
    if config.shield.enabled:
        timed("step: reach critic", jax.vmap(agent.low.reach_values, (None, 0)), state.params, worker.view)
    timed(
        "step: world and task",
        lambda book, worker, action: transition(keys, agent.env, machine, book, worker, action),
        book, worker, decision.action,
    )  # fmt: skip
    mean_due = float(np.asarray(steps.high.made).sum(1).mean())
    for part, due, valued in (("due", envs < round(mean_due), envs < 0), ("valued, all", envs < 0, envs >= 0)):
        timed(
            f"step: decide, {part}",
            lambda params, book, worker, *which: decide(agent, params, book, worker, which[0], silence, which[1]),
            state.params, book, worker, due, valued,
        )  # fmt: skip
    report["decisions a step"] = round(mean_due, 1)
    report["level"] = int(state.curriculum.level) + 1

    before = time.perf_counter()
    for _ in range(10):
        state, _ = jax.block_until_ready(iterate(state, bank, machine, reserved))
    report["whole iteration"] = round(100 * (time.perf_counter() - before), 1)
    report["steps"] = config.steps_per_iteration
    return report


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    prepare()
    report = {
        f"{name}, {recipe}": parts(name, recipe, flags.iterations, flags.seconds, flags.num_envs)
        for name in flags.envs
        for recipe in flags.recipes
    }
    device = jax.devices()[0].device_kind
    text = json.dumps({"jax": jax.__version__, "device": device, "milliseconds": report}, indent=2)
    print(text)
    if flags.out:
        flags.out.write_text(text + "\n")


if __name__ == "__main__":
    sys.exit(main_guard(main))
