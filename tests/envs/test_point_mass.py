"""Zone with a point mass, against trajectories and readings computed by hand."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax.zone import point_mass
from envs_jax.zone.layouts import ZoneLayout
from envs_jax.zone.point_mass import COLOURS, PointMass, PointMassState

ENV, NM = PointMass(), envs_jax.make("zone-nm-jaxolotl")
PARAMS = ENV.default_params
KEY = jax.random.key(0)
RED, GREEN, PURPLE, YELLOW = range(4)
FAR = np.tile(np.array([[3.2, 3.2], [-3.2, 3.2]]), (4, 1, 1))
STEP = {env: jax.jit(env.step_env) for env in (ENV, NM)}


def start(robot: tuple[float, float, float], zones: np.ndarray = FAR, env: PointMass = ENV) -> PointMassState:
    layout = ZoneLayout(robot=np.array(robot, np.float32), zones=zones.astype(np.float32))
    return env.reset_to(layout, KEY, PARAMS)[1]


def go(state: PointMassState, *actions: tuple[float, float], env: PointMass = ENV) -> list[tuple]:
    results = []
    for action in actions:
        results.append(STEP[env](KEY, state, jnp.array(action), PARAMS))
        state = results[-1][1]
    return results


def test_straight_ahead_in_closed_form() -> None:
    """v after n steps is 1.15 (1 - 0.92^n): a tenth of a m/s is gained a step, and 8 % of all are lost."""
    state = go(start((0.0, 0.0, 0.0)), *[(1.0, 0.0)] * 30)[-1][1]
    speed = [1.15 * (1 - 0.92**n) for n in range(1, 31)]
    np.testing.assert_allclose(state.velocity, [speed[-1], 0], rtol=1e-5)
    np.testing.assert_allclose(state.position, [0.05 * sum(speed), 0], rtol=1e-5)
    np.testing.assert_allclose(state.acceleration, [2, 0])
    backwards = go(start((0.0, 0.0, math.pi / 2)), (-9.0, 0.0))[-1][1]  # clipped
    np.testing.assert_allclose(backwards.velocity, [0, -0.092], atol=1e-7)


def test_the_force_acts_along_the_old_heading() -> None:
    state = go(start((0.0, 0.0, 0.0)), (1.0, 1.0), (1.0, 0.5))[-1][1]
    turned = 3.0 * 0.05
    first = np.array([0.092, 0.0])
    second = (first + 0.1 * np.array([math.cos(turned), math.sin(turned)])) * 0.92
    np.testing.assert_allclose(state.velocity, second, rtol=1e-5)
    np.testing.assert_allclose(state.position, 0.05 * (first + second), rtol=1e-5)
    np.testing.assert_allclose(state.heading, 1.5 * turned, rtol=1e-5)
    assert float(state.turn_rate) == 1.5
    round_about = go(start((0.0, 0.0, 3.1)), (0.0, 1.0))[-1][1]
    np.testing.assert_allclose(round_about.heading, 3.1 + turned - 2 * math.pi, rtol=1e-4)


def test_what_is_seen() -> None:
    """A red zone 1 m ahead, 0.4 of a bin to the left, the other behind; velocities along the axes of the square."""
    zones, bearing = FAR.copy(), 0.4 * 2 * math.pi / 16
    heading = 1.0
    ahead = np.array([math.cos(heading), math.sin(heading)])
    zones[RED] = [[math.cos(heading + bearing), math.sin(heading + bearing)], -2 * ahead]
    state = start((0.0, 0.0, heading), zones)
    seen = np.asarray(ENV.observation(state, PARAMS))
    assert seen.shape == ENV.observation_shape == (69,)
    np.testing.assert_allclose(seen[:5], 0)
    red = seen[5:21]
    expected = np.zeros(16)
    near, behind = math.exp(-0.5), math.exp(-1.0)
    expected[[0, 1, 15]] = near, 0.4 * near, 0.6 * near
    expected[[7, 8]] = behind, behind  # straight behind lies between two bins
    np.testing.assert_allclose(red[[0, 1, 15]], expected[[0, 1, 15]], rtol=1e-4)
    assert red[8] == pytest.approx(behind, rel=1e-4) or red[7] == pytest.approx(behind, rel=1e-4)
    moved = STEP[ENV](KEY, state, jnp.array([1.0, 0.2]), PARAMS)[0]
    np.testing.assert_allclose(moved[:2], 2 * ahead, rtol=1e-5)
    np.testing.assert_allclose(moved[2:4], 0.092 * ahead, rtol=1e-5)
    assert float(moved[4]) == pytest.approx(0.6)
    lidar, shared = ENV.proposition_view(jnp.asarray(seen))
    assert (lidar.shape, shared.shape) == ((4, 16), (5,))
    np.testing.assert_allclose(lidar[RED], red)


def test_zones_and_the_boundary() -> None:
    zones = FAR.copy()
    zones[YELLOW, 0] = [0.41, 0.0]
    state = start((0.0, 0.0, 0.0), zones)
    assert not ENV.labels(state, PARAMS).any()
    results = go(state, *[(1.0, 0.0)] * 4)
    places = np.array([float(result[1].position[0]) for result in results])
    held = np.array([bool(ENV.labels(result[1], PARAMS)[YELLOW]) for result in results])
    assert held.tolist() == (np.abs(places - 0.41) < 0.4).tolist()
    assert held.any()
    out = go(start((3.29, 0.0, 0.0)), *[(1.0, 0.0)] * 3)
    assert [bool(result[3]) for result in out] == [float(result[1].position[0]) > 3.3 for result in out]
    assert bool(out[-1][3])
    assert all(float(result[2]) == 0 for result in out)


def test_purple_makes_green_vanish_from_that_step_on() -> None:
    zones = FAR.copy()
    zones[PURPLE, 0], zones[GREEN, 0] = [0.5, 0.0], [1.6, 0.0]
    for env, vanishes in ((ENV, False), (NM, True)):
        seen_in_purple, in_green = False, False
        for observation, state, *_ in go(start((0.0, 0.0, 0.0), zones, env), *[(1.0, 0.0)] * 60, env=env):
            labels = env.labels(state, PARAMS)
            seen_in_purple |= bool(labels[PURPLE])
            in_green |= bool(labels[GREEN])
            green = observation[5 + 16 * GREEN : 5 + 16 * (GREEN + 1)]
            assert bool(green.any()) == (not vanishes or not seen_in_purple)
        assert seen_in_purple
        assert in_green == (not vanishes)


def test_layouts() -> None:
    """Zones and robot keep 1.1 m from each other, within 1.95 m; a robot without a place takes any."""
    drawn = jax.jit(jax.vmap(ENV.sample_layout, (0, None)))(jax.random.split(KEY, 400), PARAMS)
    zones = np.asarray(drawn.zones).reshape(400, 8, 2)
    robot = np.asarray(drawn.robot)
    objects = np.concatenate([zones, robot[:, None, :2]], 1)
    assert np.abs(objects).max() <= 1.95
    apart = np.linalg.norm(objects[:, :, None] - objects[:, None], axis=-1) + 9 * np.eye(9)
    assert (apart.min((1, 2)) >= 1.1 - 1e-5).mean() > 0.95
    assert (np.abs(robot[:, 2]) <= math.pi).all()
    assert len(np.unique(zones.reshape(400, -1), axis=0)) > 380
    kept = ENV.resample_layout(KEY, jax.tree.map(lambda x: x[0], drawn), jnp.bool_(False), PARAMS)
    np.testing.assert_array_equal(kept.zones, drawn.zones[0])


def test_where_zones_find_no_place_they_lie_as_the_peers_have_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_mass, "APART", 5.0)
    layout = PointMass().sample_layout(KEY, PARAMS)
    np.testing.assert_allclose(layout.zones, point_mass.FALLBACK, rtol=1e-6)
    assert np.abs(layout.robot[:2]).max() <= 1.95


@pytest.mark.parametrize(
    ("overrides", "message"),
    [({"horizon": 0}, "horizon is 0"), ({"vanishing": (("red", "blue"),)}, "expected pairs of red, green")],
)
def test_values_that_cannot_be_meant(overrides: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PointMass(**overrides)
    with pytest.raises(ValueError, match="not finite"):
        ENV.check_layout(ZoneLayout(robot=np.full(3, np.nan), zones=FAR))
    assert ENV.propositions == COLOURS
