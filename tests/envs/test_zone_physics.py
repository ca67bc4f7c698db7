"""Zone's robot against recorded trajectories, native MuJoCo, and its own closed form."""

from __future__ import annotations

import functools
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.zone import physics as zone_physics
from envs_jax.zone.layouts import ZoneLayout
from envs_jax.zone.world import PRESETS, ZoneState, lidar_readings

mujoco, _ = zone_physics.import_mjx()

DATA = pathlib.Path(__file__).parents[1] / "data" / "zone"
FILES = ("deepltl_bang", "deepltl_random", "deepltl_wall", "ltl2action_random")
PRECISIONS = pytest.mark.parametrize("x64", [True, False], ids=["float64", "float32"])
BACKENDS = pytest.mark.parametrize("backend", zone_physics.BACKENDS)

# Position, yaw, velocity, yaw rate after one step from a recorded row.
ONE_STEP = {True: (1e-13, 1e-12, 5e-12, 2e-10), False: (2e-6, 1e-5, 1e-4, 5e-3)}


@functools.cache
def recorded(file: str) -> dict[str, np.ndarray]:
    """A recording with its bodies ``[rows, 6]`` in the world's frame."""
    with np.load(DATA / f"{file}.npz") as archive:
        record = dict(archive)
    angle = float(record["agent_rot0"])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    qpos, qvel = record["qpos"], record["qvel"]
    record["body"] = np.column_stack([record["xy"], angle + qpos[:, 2], qvel[:, :2] @ turn.T, qvel[:, 2]])
    return record


@functools.cache
def stepped(backend: zone_physics.Backend, x64: bool) -> Any:
    """The batched step, compiled once for the tests; rows are padded to one length, so that it is one program."""
    step = jax.jit(jax.vmap(zone_physics.step_function(backend)))

    def run(bodies: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, dtype = len(bodies), np.float64 if x64 else np.float32
        padding = ((0, 256 - rows), (0, 0))
        with jax.enable_x64(x64):
            results = step(jnp.asarray(np.pad(bodies, padding), dtype), jnp.asarray(np.pad(controls, padding), dtype))
            assert all(result.dtype == dtype for result in results)
            return tuple(np.asarray(result, np.float64)[:rows] for result in results)

    return run


@functools.cache
def native_model(walls: bool = False) -> Any:
    return mujoco.MjModel.from_xml_string(zone_physics.model_xml(walls=walls))


def native_step(model: Any, body: np.ndarray, control: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same step by the C library."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = body[:3], body[3:], control
    mujoco.mj_step(model, data, zone_physics.SUBSTEPS)
    mujoco.mj_forward(model, data)
    return np.concatenate([data.qpos, data.qvel]), data.sensordata.copy()


def assert_bodies_close(got: np.ndarray, expected: np.ndarray, tolerances: tuple[float, ...]) -> None:
    errors = np.abs(got - expected)
    for columns, tolerance in zip((slice(0, 2), slice(2, 3), slice(3, 5), slice(5, 6)), tolerances, strict=True):
        assert errors[:, columns].max() <= tolerance


@PRECISIONS
@BACKENDS
@pytest.mark.parametrize("file", FILES)
def test_one_step_from_every_recorded_row(file: str, backend: zone_physics.Backend, x64: bool) -> None:
    record = recorded(file)
    body, sensors = stepped(backend, x64)(record["body"][:-1], record["action"][1:])
    assert_bodies_close(body, record["body"][1:], ONE_STEP[x64])
    # An acceleration follows the yaw rate a thousand times over, so its error does too.
    errors = np.abs(sensors - record["sensordata"][1:, :12])
    assert errors[:, :3].max() <= (2e-9 if x64 else 0.5)
    assert errors[:, 3:].max() <= (2e-10 if x64 else 5e-3)
    if not x64:
        assert np.quantile(np.abs(body[:, 5] - record["body"][1:, 5]), 0.99) <= 1e-3


@PRECISIONS
@BACKENDS
def test_open_loop(backend: zone_physics.Backend, x64: bool) -> None:
    """With full or no turn the servo is not chaotic, so that the whole recording can be followed."""
    record = recorded("deepltl_bang")
    run, body, errors = stepped(backend, x64), record["body"][:1], []
    for action, expected in zip(record["action"][1:], record["body"][1:], strict=True):
        body, _ = run(body, action[None])
        errors.append(np.abs(body[0, :3] - expected[:3]))
    assert np.max(errors) <= (2e-13 if x64 else 2e-5)


def random_rows(rows: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """Bodies and controls of all sorts, controls out of range and saturated ones among them."""
    rng = np.random.default_rng(0)
    scale = np.array([2.0, 2.0, 6.0, 1.0, 1.0, 3.0])
    return rng.uniform(-1, 1, (rows, 6)) * scale, rng.uniform(-1.3, 1.3, (rows, 2)) * rng.choice([0.05, 1], (rows, 1))


@PRECISIONS
def test_mjx_is_native_mujoco(x64: bool) -> None:
    bodies, controls = random_rows()
    got_bodies, got_sensors = stepped("mjx", x64)(bodies, controls)
    expected = [native_step(native_model(), *row) for row in zip(bodies, controls, strict=True)]
    assert_bodies_close(got_bodies, np.stack([body for body, _ in expected]), ONE_STEP[x64])
    errors = np.abs(got_sensors - np.stack([sensors for _, sensors in expected]))
    assert errors.max() <= (1e-8 if x64 else 0.5)


def test_mjx_is_the_closed_form() -> None:
    rows = random_rows()
    mjx, closed = stepped("mjx", True)(*rows), stepped("closed-form", True)(*rows)
    assert_bodies_close(mjx[0], closed[0], ONE_STEP[True])
    np.testing.assert_allclose(mjx[1], closed[1], atol=1e-8)


@pytest.mark.slow
def test_scalars_are_mjx_as_it_is() -> None:
    """One substep of the program taken apart, against MJX's own arrays; above it is compared with MuJoCo."""
    with jax.enable_x64(True):
        bodies, controls = (jnp.asarray(array) for array in random_rows(16))
        plain, simple = (zone_physics._mjx_programs(False, scalarized, True) for scalarized in (False, True))
        for one, other in zip(plain, simple, strict=True):
            np.testing.assert_allclose(
                jax.jit(jax.vmap(one))(bodies, controls), jax.jit(jax.vmap(other))(bodies, controls), atol=1e-11
            )


def test_at_rest_is_what_mujoco_reads() -> None:
    for heading in (0.0, 1.0, 4.0):
        data = mujoco.MjData(native_model())
        data.qpos[2] = heading
        mujoco.mj_forward(native_model(), data)
        np.testing.assert_allclose(zone_physics.at_rest(jnp.float32(heading)), data.sensordata, atol=1e-6)


def test_native_masses() -> None:
    model = native_model()
    assert model.body_mass.sum() == pytest.approx(zone_physics.MASS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    full = np.zeros((3, 3))
    for column, unit in zip(full, np.eye(3), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    moment = zone_physics.MOMENT
    mass = zone_physics.MASS
    np.testing.assert_allclose(full, [[mass, 0, 0], [0, mass, moment], [0, moment, zone_physics.INERTIA]], atol=1e-12)


def plain_lidar(body: np.ndarray, zones: np.ndarray, gain: float) -> np.ndarray:
    """A plain reading of the lidar's definition."""
    seen = np.zeros((4, 16))
    for colour, instances in enumerate(zones):
        for zone in instances:
            offset = zone - body[:2]
            cos, sin = np.cos(body[2]), np.sin(body[2])
            own = np.array([cos * offset[0] + sin * offset[1], -sin * offset[0] + cos * offset[1]])
            place = 16 * (np.arctan2(own[1], own[0]) % (2 * np.pi)) / (2 * np.pi)
            index = min(int(place), 15)
            value = np.exp(-gain * np.hypot(*offset))
            for bin_index, part in ((index, 1), (index + 1, place - index), (index - 1, 1 - (place - index))):
                seen[colour, bin_index % 16] = max(seen[colour, bin_index % 16], part * value)
    return seen


def recorded_lidar(file: str) -> np.ndarray:
    observation = recorded(file)["obs"]
    starts = (3, 19, 38, 60) if file.startswith("deepltl") else (12, 28, 44, 60)
    return np.stack([observation[:, start : start + 16] for start in starts], 1)


@pytest.mark.parametrize("file", FILES)
def test_lidar_and_membership(file: str) -> None:
    record = recorded(file)
    deepltl = file.startswith("deepltl")
    env = PRESETS["zone" if deepltl else "zone-ltl2action"]()
    bodies, zones = jnp.asarray(record["body"]), jnp.asarray(record["zones"])
    layout = ZoneLayout(robot=bodies[0, :3], zones=zones)
    _, state = env.reset_to(layout, jax.random.key(0), env.default_params)
    states = jax.vmap(lambda body: state.replace(body=body))(bodies)
    labels = jax.jit(jax.vmap(env.labels, (0, None)))(states, env.default_params)
    observations = jax.jit(jax.vmap(env.observation, (0, None)))(states, env.default_params)
    lidar, shared = jax.vmap(env.proposition_view)(observations)
    np.testing.assert_array_equal(labels[1:], record["props" if deepltl else "events"][1:])
    np.testing.assert_allclose(lidar, recorded_lidar(file), atol=1e-5)
    if deepltl:
        np.testing.assert_allclose(shared[1:, 12:], record["wall_sensor"][1:], atol=1e-5)


def test_lidar_is_a_plain_reading_of_its_definition() -> None:
    rng = np.random.default_rng(1)
    bodies = np.column_stack([rng.uniform(-3, 3, (200, 2)), rng.uniform(-20, 20, 200)])
    zones = rng.uniform(-2.5, 2.5, (200, 4, 2, 2))
    # Straight ahead, and just beside it on either side.
    bodies[:6, 2] = [0, 0, 0, np.pi, 1e-9, -1e-9]
    zones[:6, :, :, 1] = bodies[:6, None, None, 1]
    with jax.enable_x64(True):
        got = jax.jit(jax.vmap(lidar_readings, (0, 0, None)))(jnp.asarray(bodies), jnp.asarray(zones), 0.7)
    for seen, body, place in zip(got, bodies, zones, strict=True):
        np.testing.assert_allclose(seen, plain_lidar(body, place, 0.7), atol=1e-12)
    ahead = lidar_readings(jnp.zeros(3), jnp.full((4, 2, 2), jnp.array([1.0, -1e-9])), 0.5)
    assert float(ahead[0, 15]) == pytest.approx(np.exp(-0.5), rel=1e-6)
    assert float(ahead[0, 0]) == pytest.approx(np.exp(-0.5), rel=1e-6)


def run_into_a_wall(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Controls that push against a wall, slide along it and back off, and where that starts."""
    forward = np.where(np.arange(steps) < 0.8 * steps, 1.0, -1.0)
    turn = np.where((np.arange(steps) > 0.5 * steps) & (np.arange(steps) < 0.6 * steps), 1.0, 0.0)
    return np.array([2.1, 0.3, 0.4, 0.5, 0.0, 0.0]), np.column_stack([forward, turn])


@pytest.mark.slow
def test_walls_on_mjx_are_native_mujoco() -> None:
    """Into a wall, along it and off it again: MJX's four Newton iterations against the C library's full solver."""
    body, controls = run_into_a_wall(120)
    native = native_model(walls=True)
    native.opt.iterations, native.opt.ls_iterations = 100, 50
    expected, bodies = body, [body]
    for control in controls:
        expected, _ = native_step(native, expected, control)
        bodies.append(expected)
    touched = np.array(bodies)[:, 0].max()
    assert zone_physics.WALL - zone_physics.SPHERE - 0.1 < touched < zone_physics.WALL
    with jax.enable_x64(True):
        step = jax.jit(jax.vmap(zone_physics.step_function("mjx", walls=True)))
        got, _ = step(jnp.asarray(np.array(bodies[:-1])), jnp.asarray(controls))
    np.testing.assert_allclose(got[:, :2], np.array(bodies)[1:, :2], atol=1e-5)


def test_closed_form_has_no_walls() -> None:
    with pytest.raises(ValueError, match="knows no solid walls"):
        zone_physics.step_function("closed-form", walls=True)
    with pytest.raises(ValueError, match="unknown physics 'warp'"):
        zone_physics.step_function("warp")


def test_state_is_small() -> None:
    """What a rollout carries: few leaves, none of them MuJoCo's."""
    env = PRESETS["zone"]()
    shapes = jax.eval_shape(env.reset, jax.random.key(0), env.default_params)[1]
    assert isinstance(shapes, ZoneState)
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes)) == 6 + 12 + 4 + 3 + 16 + 1
