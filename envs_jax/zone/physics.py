"""The Point robot of Safety Gym: one environment step of 20 ms, on MuJoCo MJX or in closed form.

The robot slides and turns in the plane. A body is ``[x, y, heading, vx, vy, yaw rate]`` in the world's frame (m, rad,
m/s, rad/s); a control is ``[forward, turn]`` within ±1; its twelve sensor readings are accelerometer, velocimeter, gyro
and magnetometer, three each, in the robot's own frame.

Its turn servo is chaotic under the semi-implicit Euler rule: another integrator, time step or number of substeps makes
another robot. So both backends integrate exactly as MuJoCo's ``Euler`` does, damping implicit.
"""

from __future__ import annotations

import contextlib
import functools
import io
import warnings
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from envs_jax.zone.scalarize import CannotScalarizeError, scalarize

Backend = Literal["mjx", "closed-form"]
BACKENDS: tuple[Backend, ...] = ("mjx", "closed-form")
Step = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
Program = Callable[[jax.Array, jax.Array], jax.Array]

TIMESTEP = 0.002
"""Seconds of a physics substep."""
SUBSTEPS = 10
"""Physics substeps of an environment step, the control held."""
NUM_SENSORS = 12
GRAVITY = 9.81
MAGNETIC_FIELD = -0.5
"""The magnetic field's component along y; it has no other."""

SLIDE_DAMPING, TURN_DAMPING = 0.01, 0.005
GEAR, FORCE_LIMIT = 0.3, 0.05
SPHERE, BOX, BOX_AT = 0.1, 0.05, 0.1
"""Radius of the robot's sphere, half-size of its arrow and where that sits along the heading (m); density 1."""

_SPHERE_MASS = 4 / 3 * np.pi * SPHERE**3
_BOX_MASS = (2 * BOX) ** 3
MASS = _SPHERE_MASS + _BOX_MASS
MOMENT = _BOX_MASS * BOX_AT
"""Mass times the distance of the centre of mass from the origin, along the heading (kg m)."""
INERTIA = 0.4 * _SPHERE_MASS * SPHERE**2 + _BOX_MASS * ((2 * BOX) ** 2 / 6 + BOX_AT**2)
"""Yaw inertia about the origin (kg m²)."""

WALL = 2.4
"""Where the inner faces of solid walls stand (m)."""

_XML = """
<mujoco>
  <option timestep="{timestep}" integrator="Euler" jacobian="sparse" iterations="{iterations}" ls_iterations="10">
    <flag contact="{contact}" constraint="{contact}"/>
  </option>
  <default>
    <geom density="1" condim="6"/>
  </default>
  <worldbody>
    {walls}
    <body name="robot" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0" damping="{slide}"/>
      <joint name="y" type="slide" axis="0 1 0" damping="{slide}"/>
      <joint name="heading" type="hinge" axis="0 0 1" damping="{turn}"/>
      <geom name="body" type="sphere" size="{sphere}" friction="1 0.01 0.01"/>
      <geom name="arrow" type="box" pos="{box_at} 0 0" size="{box} {box} {box}"/>
      <site name="origin"/>
    </body>
  </worldbody>
  <actuator>
    <motor site="origin" gear="{gear} 0 0 0 0 0" ctrllimited="true" ctrlrange="-1 1" forcelimited="true"
      forcerange="-{force} {force}"/>
    <velocity joint="heading" kv="1" gear="{gear}" ctrllimited="true" ctrlrange="-1 1" forcelimited="true"
      forcerange="-{force} {force}"/>
  </actuator>
  <sensor>
    <accelerometer site="origin"/>
    <velocimeter site="origin"/>
    <gyro site="origin"/>
    <magnetometer site="origin"/>
  </sensor>
</mujoco>
"""


def model_xml(*, walls: bool = False) -> str:
    """The robot as MJCF, for native MuJoCo too; ``walls`` puts four planes around it."""
    faces = [(WALL, 0, -1, 0), (-WALL, 0, 1, 0), (0, WALL, 0, -1), (0, -WALL, 0, 1)]
    planes = [f'<geom type="plane" size="5 5 1" pos="{x} {y} 0" zaxis="{u} {v} 0"/>' for x, y, u, v in faces]
    return _XML.format(
        timestep=TIMESTEP,
        iterations=4 if walls else 100,
        contact="enable" if walls else "disable",
        walls="\n    ".join(planes if walls else []),
        slide=SLIDE_DAMPING,
        turn=TURN_DAMPING,
        sphere=SPHERE,
        box=BOX,
        box_at=BOX_AT,
        gear=GEAR,
        force=FORCE_LIMIT,
    )


def check_backend(backend: str, *, walls: bool) -> None:
    """Raises ``ValueError`` unless there is such a backend and it has walls where they are wanted."""
    if backend not in BACKENDS:
        raise ValueError(f"unknown physics {backend!r}, expected one of: {', '.join(BACKENDS)}")
    if walls and backend == "closed-form":
        raise ValueError('physics="closed-form" knows no solid walls; use physics="mjx"')


def step_function(backend: str, *, walls: bool = False, scalarized: bool = True) -> Step:
    """One environment step, ``(body [6], control [2]) -> (body [6], sensors [12])``, in the body's dtype.

    Args:
        backend: ``"mjx"`` or ``"closed-form"``.
        walls: solid walls at ±2.4 m; on MJX only.
        scalarized: run MJX's own operations on this robot's scalars (`envs_jax.zone.scalarize`), twenty times as fast
            as its batched arrays. With walls, whose contacts are solved by a loop, MJX runs as it is.

    Raises:
        ValueError: if there is no such backend, or it has no walls.
        ImportError: when the step is taken, if MJX is asked for and not installed.
    """
    check_backend(backend, walls=walls)
    if backend == "closed-form":
        return _closed_form_step
    return functools.partial(_mjx_step, walls, scalarized and not walls)


def at_rest(heading: jax.Array) -> jax.Array:
    """What the sensors read when the robot stands still without control, ``[12]``."""
    zero = jnp.zeros_like(heading)
    return _readings(heading, jnp.stack([zero, zero]), jnp.stack([zero, zero]), zero)


def import_mjx() -> tuple[Any, Any]:
    """The modules ``mujoco`` and ``mujoco.mjx``, imported when first needed.

    Raises:
        ImportError: naming the extra that brings them.
    """
    try:
        # It prints on standard output that its optional warp backend is not there.
        with contextlib.redirect_stdout(io.StringIO()):
            import mujoco
            from mujoco import mjx
    except ImportError as error:
        raise ImportError("Zone's physics needs MuJoCo and MJX: pip install 'hrlspec[zone]'") from error
    return mujoco, mjx


@functools.cache
def _mjx_model(walls: bool, x64: bool) -> tuple[Any, Any]:
    """The MJX model and its initial data, in single or double precision."""
    mujoco, mjx = import_mjx()
    with jax.enable_x64(x64), jax.ensure_compile_time_eval():
        native = mujoco.MjModel.from_xml_string(model_xml(walls=walls))
        # MJX's own choice is the first device of all processes, which may be another one's.
        mine = jax.local_devices()[0]
        model = mjx.put_model(native, impl="jax", device=mine)
        return model, mjx.make_data(model, impl="jax", device=mine)


@functools.cache
def _mjx_programs(walls: bool, scalarized: bool, x64: bool) -> tuple[Program, Program]:
    """MJX's substep and sensors: ``(body [6], control [2]) -> body [6]`` and ``-> sensors [12]``."""
    _, mjx = import_mjx()
    model, blank = _mjx_model(walls, x64)

    # Positions and velocities are all that is carried: the rest of the data follows from them.
    def fill(body: jax.Array, control: jax.Array) -> Any:
        return blank.replace(qpos=body[:3], qvel=body[3:], ctrl=control)

    def substep(body: jax.Array, control: jax.Array) -> jax.Array:
        data = mjx.step(model, fill(body, control))
        return jnp.concatenate([data.qpos, data.qvel])

    def sensors(body: jax.Array, control: jax.Array) -> jax.Array:
        data = mjx.forward(model, fill(body, control))
        if not walls:  # without constraints `forward` stops short of the accelerometer
            data = mjx.sensor_acc(model, data)
        return data.sensordata

    dtype = jnp.float64 if x64 else jnp.float32
    examples = (jax.ShapeDtypeStruct((6,), dtype), jax.ShapeDtypeStruct((2,), dtype))
    # MJX makes arrays of the default type, so it is traced here and not where its caller may have chosen another one.
    with jax.enable_x64(x64):
        if scalarized:
            try:
                return scalarize(substep, *examples), scalarize(sensors, *examples)
            except CannotScalarizeError as error:
                warnings.warn(
                    f"Zone runs MJX as it is, which is slower: it now holds what is not known ({error})", stacklevel=2
                )
        return _traced(substep, *examples), _traced(sensors, *examples)


def _traced(function: Program, *examples: Any) -> Program:
    program = core.jaxpr_as_fun(jax.make_jaxpr(function)(*examples))
    return lambda *arguments: program(*arguments)[0]


def _mjx_step(walls: bool, scalarized: bool, body: jax.Array, control: jax.Array) -> tuple[jax.Array, jax.Array]:
    substep, sensors = _mjx_programs(walls, scalarized, body.dtype == jnp.float64)
    body, _ = jax.lax.scan(lambda body, _: (substep(body, control), None), body, None, length=SUBSTEPS)
    return body, sensors(body, control)


def _closed_form_step(body: jax.Array, control: jax.Array) -> tuple[jax.Array, jax.Array]:
    control = jnp.clip(control, -1.0, 1.0)

    def substep(body: jax.Array, _: None) -> tuple[jax.Array, None]:
        velocity = body[3:] + TIMESTEP * _acceleration(body, control, implicit=TIMESTEP)
        return jnp.concatenate([body[:3] + TIMESTEP * velocity, velocity]), None

    body, _ = jax.lax.scan(substep, body, None, length=SUBSTEPS)
    acceleration = _acceleration(body, control, implicit=0.0)
    return body, _readings(body[2], body[3:5], acceleration[:2], body[5])


def _acceleration(body: jax.Array, control: jax.Array, *, implicit: float) -> jax.Array:
    """Solves the equations of motion, ``[3]``; damping counts at the end of ``implicit`` seconds."""
    cos, sin, rate = jnp.cos(body[2]), jnp.sin(body[2]), body[5]
    push = GEAR * jnp.clip(control[0], -FORCE_LIMIT, FORCE_LIMIT)
    torque = GEAR * jnp.clip(control[1] - GEAR * rate, -FORCE_LIMIT, FORCE_LIMIT)
    forward = push + MOMENT * rate**2
    force_x = forward * cos - SLIDE_DAMPING * body[3]
    force_y = forward * sin - SLIDE_DAMPING * body[4]
    torque = torque - TURN_DAMPING * rate
    # The mass matrix is [[m, 0, -C sin], [0, m, C cos], [-C sin, C cos, j]]: eliminate the two slides.
    mass, inertia = MASS + SLIDE_DAMPING * implicit, INERTIA + TURN_DAMPING * implicit
    turn = (torque - MOMENT / mass * (cos * force_y - sin * force_x)) / (inertia - MOMENT**2 / mass)
    return jnp.stack([(force_x + MOMENT * sin * turn) / mass, (force_y - MOMENT * cos * turn) / mass, turn])


def _readings(heading: jax.Array, velocity: jax.Array, acceleration: jax.Array, rate: jax.Array) -> jax.Array:
    """Sensor readings ``[12]`` of a body whose origin moves with these velocities and accelerations of the world."""
    cos, sin, zero = jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)

    def own(vector: jax.Array) -> list[jax.Array]:
        return [cos * vector[0] + sin * vector[1], cos * vector[1] - sin * vector[0]]

    field = [MAGNETIC_FIELD * sin, MAGNETIC_FIELD * cos, zero]
    gravity = jnp.full_like(heading, GRAVITY)
    return jnp.stack([*own(acceleration), gravity, *own(velocity), zero, zero, zero, rate, *field])
