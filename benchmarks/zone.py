"""Throughput of Zone: MJX, closed form and native MuJoCo side by side, then rollout and training; one JSON object.

python -m benchmarks.zone [--env zone-nm] [--batches 1 64 512 2048] [--recipes hrlspec] [--seconds 5] [--out FILE]
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import envs_jax
from benchmarks import common
from envs_jax.zone import physics as zone_physics
from hrlspec.run.errors import main_guard

STEPS_A_CALL = 51_200
"""Environment steps in one call, over all environments, within the limits of `_num_steps`."""


@dataclasses.dataclass(frozen=True)
class Flags(common.CommonFlags):
    """What to measure."""

    env: Literal["zone", "zone-nm"] = "zone"
    batches: tuple[int, ...] = (1, 64, 512, 2048)
    """Numbers of environments side by side."""
    seconds: float = 5.0
    """At least this long for each figure, compile time apart."""
    as_it_is: bool = True
    """Also measure MJX's arrays as they are, not taken apart into scalars."""
    learner: bool = True
    """Also measure rollout and training, for each recipe."""


def _num_steps(batch: int) -> int:
    return min(2000, max(25, STEPS_A_CALL // batch))


def _bodies(batch: int) -> np.ndarray:
    """Robots at rest here and there, float64 ``[B, 6]``."""
    bodies = np.random.default_rng(0).uniform(-2, 2, (batch, 6))
    bodies[:, 3:] = 0
    return bodies


def _controls(batch: int) -> np.ndarray:
    """Random controls, float64 ``[B, T, 2]``."""
    return np.random.default_rng(1).uniform(-1, 1, (batch, _num_steps(batch), 2))


def _timed(roll: Callable[[Any], Any], carry: Any, steps: int, seconds: float) -> dict[str, float]:
    """Compile time of a jitted ``carry = roll(carry)`` (tracing apart) and its rate."""
    jitted = jax.jit(roll)
    before = time.perf_counter()
    lowered = jitted.lower(carry)
    between = time.perf_counter()
    compiled = lowered.compile()
    times = {"trace_s": between - before, "compile_s": time.perf_counter() - between}
    return times | common.rate(compiled, carry, steps, seconds)


def physics(step: zone_physics.Step, batch: int, seconds: float) -> dict[str, float]:
    """Physics with sensors: 10 substeps and a forward pass, sensors read at every step."""
    controls = jnp.asarray(_controls(batch).swapaxes(0, 1), jnp.float32)

    def roll(carry: Any) -> Any:
        def body(carry: Any, control: jax.Array) -> tuple[Any, None]:
            bodies, seen = carry
            bodies, sensors = jax.vmap(step)(bodies, control)
            return (bodies, seen + sensors), None

        return jax.lax.scan(body, carry, controls)[0]

    carry = (jnp.asarray(_bodies(batch), jnp.float32), jnp.zeros((batch, zone_physics.NUM_SENSORS)))
    return _timed(roll, carry, controls.shape[0] * batch, seconds)


def native(threads: int, batch: int, seconds: float) -> dict[str, float]:
    """The same model stepped by MuJoCo's C library (its own rollout, double precision), sensors at every substep."""
    mujoco, _ = zone_physics.import_mjx()
    from mujoco import rollout

    model = mujoco.MjModel.from_xml_string(zone_physics.model_xml())
    bodies, controls = _bodies(batch), _controls(batch)
    # The C library's physics state: time, positions, velocities.
    state = np.column_stack([np.zeros(batch), bodies])
    held = np.repeat(controls, zone_physics.SUBSTEPS, axis=1)
    rates: list[float] = []
    with rollout.Rollout(nthread=threads) as pool:
        data = [mujoco.MjData(model) for _ in range(threads)]
        run = functools.partial(pool.rollout, model, data, state, held)
        run()
        start = time.perf_counter()
        while time.perf_counter() - start < seconds or len(rates) < 3:
            before = time.perf_counter()
            run()
            rates.append(controls.shape[0] * controls.shape[1] / (time.perf_counter() - before))
    return {"median": statistics.median(rates), "min": min(rates), "max": max(rates), "calls": len(rates)}


def whole_environment(name: str, backend: zone_physics.Backend, batch: int, seconds: float) -> dict[str, float]:
    """Substeps, sensors, lidar, labels, and auto-reset from layouts drawn beforehand (four for each environment)."""
    env: Any = envs_jax.make(name, physics=backend)
    params, slots = env.default_params, 4
    draw = jax.jit(jax.vmap(jax.vmap(env.sample_layout, (0, None)), (0, None)))
    pool = draw(jax.random.split(jax.random.key(0), (batch, slots)), params)
    keys = jax.random.split(jax.random.key(1), batch)
    reset = jax.vmap(env.reset_to, (0, 0, None))
    observation, state = jax.jit(reset)(jax.tree.map(lambda x: x[:, 0], pool), keys, params)
    # Episodes do not all end together.
    state = state.replace(time=jax.random.randint(jax.random.key(2), (batch,), 0, env.horizon))
    actions = jnp.asarray(_controls(batch).swapaxes(0, 1), jnp.float32)
    index = jnp.arange(batch)

    def roll(carry: Any) -> Any:
        def body(carry: Any, action: jax.Array) -> tuple[Any, None]:
            state, started, seen = carry
            observation, state, _, terminated, truncated, _ = jax.vmap(env.step_env, (0, 0, 0, None))(
                keys, state, action, params
            )
            labels = jax.vmap(env.labels, (0, None))(state, params)
            ended = terminated | truncated
            started = started + ended
            first, fresh = reset(jax.tree.map(lambda x: x[index, started % slots], pool), keys, params)

            def pick(new: jax.Array, old: jax.Array) -> jax.Array:
                return jnp.where(ended.reshape(-1, *[1] * (old.ndim - 1)), new, old)

            # Everything a learner would read is read, or the compiler would leave it out.
            seen = seen + pick(first, observation) + labels.sum()
            return (jax.tree.map(pick, fresh, state), started, seen), None

        return jax.lax.scan(body, carry, actions)[0]

    return _timed(roll, (state, jnp.zeros(batch, jnp.int32), observation), actions.shape[0] * batch, seconds)


def layouts(name: str, seconds: float, number: int = 2048) -> dict[str, float]:
    """Layouts drawn a second, plain and contested."""
    env: Any = envs_jax.make(name, physics="closed-form")
    colours = jnp.eye(env.num_propositions, dtype=bool)
    kinds = {
        "plain": lambda key: env.sample_layout(key, env.default_params),
        "contested": lambda key: env.contested_layout(key, colours[0], colours[1], env.default_params),
    }
    rates = {}
    for kind, draw in kinds.items():

        def fill(key: jax.Array, draw: Callable[[jax.Array], Any] = draw) -> jax.Array:
            drawn = jax.vmap(draw)(jax.random.split(key, number))
            # The next key depends on what was drawn, so that nothing is left out.
            return jax.random.fold_in(key, (drawn.zones.sum() * 1e3).astype(jnp.int32))

        rates[kind] = common.rate(jax.jit(fill), jax.random.key(0), number, seconds)["median"]
    return rates


def measure(flags: Flags) -> dict[str, Any]:
    """What needs no learner."""
    steps: dict[str, zone_physics.Step] = {
        "mjx": zone_physics.step_function("mjx"),
        "closed-form": zone_physics.step_function("closed-form"),
    }
    if flags.as_it_is:
        steps["mjx as it is"] = zone_physics.step_function("mjx", scalarized=False)
    seconds = flags.seconds
    report: dict[str, Any] = {
        "mujoco_versions": {name: importlib.metadata.version(name) for name in ("mujoco", "mujoco-mjx")},
        "physics_with_sensors_steps_per_s": {
            str(batch): {
                **{name: physics(step, batch, seconds) for name, step in steps.items()},
                "native, 1 thread": native(1, batch, seconds),
                "native, 2 threads": native(2, batch, seconds),
            }
            for batch in flags.batches
        },
        "whole_environment_steps_per_s": {
            str(batch): {
                backend: whole_environment(flags.env, backend, batch, seconds) for backend in zone_physics.BACKENDS
            }
            for batch in flags.batches
        },
        "layouts_per_s": layouts(flags.env, seconds),
    }
    report["mjx_over_native_2_threads"] = {
        batch: rates["mjx"]["median"] / rates["native, 2 threads"]["median"]
        for batch, rates in report["physics_with_sensors_steps_per_s"].items()
    }
    return report


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    if not flags.learner:
        flags = dataclasses.replace(flags, recipes=())
    common.main("zone", flags.env, flags, lambda: measure(flags))


if __name__ == "__main__":
    sys.exit(main_guard(main))
