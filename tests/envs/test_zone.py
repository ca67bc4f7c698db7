"""Zone's world: placement, episodes, vanishing colours, contested layouts."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import envs_jax
from envs_jax.zone.contested import contested_layout, ways
from envs_jax.zone.layouts import ZoneLayout
from envs_jax.zone.world import BOUNDARY, PRESETS, Zone
from hrlspec.exact.contested import contested_suite

# These need no MuJoCo: the two kinds of physics are compared in test_zone_physics.
ENV = PRESETS["zone"](physics="closed-form")
NM = PRESETS["zone-nm"](physics="closed-form")
PARAMS = ENV.default_params
BLUE, GREEN, RED, YELLOW = range(4)
NOWHERE = 3.0 * np.ones((4, 2, 2), np.float32)


@functools.cache
def layouts(number: int = 4096) -> ZoneLayout:
    sample = jax.jit(jax.vmap(ENV.sample_layout, (0, None)))
    return jax.tree.map(np.asarray, sample(jax.random.split(jax.random.key(0), number), PARAMS))


def plain_layouts(number: int) -> list[np.ndarray]:
    """The rules of placement read plainly: robot, then zones, each at the first of 100 draws that fits, ``[9, 2]``."""
    rng, found = np.random.default_rng(0), []
    while len(found) < number:
        placed: list[np.ndarray] = []
        for index in range(9):
            reach, keepout = (2.1, 0.4) if index == 0 else (1.95, 0.55)
            draws = rng.uniform(-reach, reach, (100, 2))
            free = np.ones(100, bool)
            for other, place in enumerate(placed):
                free &= np.hypot(*(draws - place).T) >= keepout + (0.4 if other == 0 else 0.55)
            if not free.any():
                break
            placed.append(draws[np.argmax(free)])
        else:
            found.append(np.array(placed))
    return found


def places(drawn: ZoneLayout) -> np.ndarray:
    return np.concatenate([drawn.robot[:, None, :2], drawn.zones.reshape(-1, 8, 2)], 1)


def test_layouts_keep_their_distances() -> None:
    objects = places(layouts())
    assert np.abs(objects[:, 0]).max() <= 2.1
    assert np.abs(objects[:, 1:]).max() <= 1.95
    apart = np.linalg.norm(objects[:, :, None] - objects[:, None], axis=-1) + 9 * np.eye(9)
    assert apart[:, 0].min() >= 0.95 - 1e-6
    assert apart[:, 1:, 1:].min() >= 1.1 - 1e-6
    # They go to the edges of what is allowed.
    assert np.abs(objects[:, 0]).max() > 2.09
    assert apart[:, 1:, 1:].min() < 1.101


def test_layouts_are_distributed_as_by_the_plain_rules() -> None:
    objects, plain = places(layouts()), np.array(plain_layouts(1500))
    for index in (0, 1, 4, 8):
        for measure in (lambda x: x[:, 0], lambda x: x[:, 1], lambda x: np.hypot(*x.T)):
            assert stats.ks_2samp(measure(objects[:, index]), measure(plain[:, index])).pvalue > 1e-4
    nearest = [np.linalg.norm(x[:, 1:] - x[:, :1], axis=-1).min(-1) for x in (objects, plain)]
    assert stats.ks_2samp(*nearest).pvalue > 1e-4
    headings = layouts().robot[:, 2]
    assert stats.kstest(headings, stats.uniform(0, 2 * np.pi).cdf).pvalue > 1e-4


def test_no_layout_comes_twice() -> None:
    assert len(np.unique(places(layouts()).reshape(4096, -1), axis=0)) == 4096


def _state(env: Zone, position: tuple[float, float], zones: np.ndarray = NOWHERE, heading: float = 0.0) -> Any:
    layout = ZoneLayout(robot=jnp.array([*position, heading]), zones=jnp.asarray(zones))
    return env.reset_to(layout, jax.random.key(0), env.default_params)[1]


@functools.cache
def _step(env: Zone) -> Any:
    return jax.jit(env.step_env)


def _go(env: Zone, state: Any, steps: int, action: tuple[float, float] = (1.0, 0.0)) -> list[Any]:
    results = []
    for _ in range(steps):
        results.append(_step(env)(jax.random.key(0), state, jnp.array(action), env.default_params))
        state = results[-1][1]
    return results


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_leaving_the_square_ends_the_episode(heading: float) -> None:
    env = PRESETS["zone"](physics="closed-form", boundary_reward=-1.0)
    start = 3.25 * np.array([np.cos(heading), np.sin(heading)])
    results = _go(env, _state(env, tuple(start), heading=heading), 30)
    outside = [bool((jnp.abs(result[1].body[:2]) >= BOUNDARY).any()) for result in results]
    assert outside[-1]
    assert not outside[0]
    assert [bool(result[3]) for result in results] == outside
    assert [float(result[2]) for result in results] == [-1.0 * out for out in outside]
    assert not any(bool(result[4]) for result in results)
    # Without the peers' reward, leaving pays nothing.
    assert all(float(result[2]) == 0 for result in _go(ENV, _state(ENV, tuple(start), heading=heading), 30))


def test_actions_are_clipped() -> None:
    state = _state(ENV, (0.0, 0.0))
    for far, near in (((7.0, -9.0), (1.0, -1.0)), ((-2.0, 3.0), (-1.0, 1.0))):
        np.testing.assert_array_equal(_go(ENV, state, 1, far)[0][0], _go(ENV, state, 1, near)[0][0])


def test_observation_has_its_parts_in_place() -> None:
    zones = NOWHERE.copy()
    zones[RED, 0] = [1.5, 0.5]
    state = _state(ENV, (0.5, 0.5), zones)
    observation = np.asarray(ENV.observation(state, PARAMS))
    np.testing.assert_allclose(observation[:12], [0, 0, 9.81, 0, 0, 0, 0, 0, 0, 0, -0.5, 0], atol=1e-6)
    np.testing.assert_allclose(observation[76:], np.exp([-2.8, -3.8, -3.8, -2.8]), rtol=1e-6)
    lidar, shared = ENV.proposition_view(observation)
    assert lidar[RED, 0] == pytest.approx(np.exp(-0.5))
    at_rest = [0, 0, 0.981, 0, 0, 0, 0, 0, 0, 0, -1, 0]
    np.testing.assert_allclose(shared, np.r_[at_rest, observation[76:]], atol=1e-6)
    solid = PRESETS["zone-ltl2action"]()
    assert solid.observation(state, PARAMS).shape == solid.observation_shape == (76,)
    assert solid.proposition_view(solid.observation(state, PARAMS))[1].shape == (12,)


def test_labels_hold_within_the_radius() -> None:
    zones = NOWHERE.copy()
    zones[GREEN, 1] = zones[YELLOW, 0] = [0.0, 0.0]
    for distance, inside in ((0.39, True), (0.41, False)):
        labels = ENV.labels(_state(ENV, (distance, 0.0), zones), PARAMS)
        assert labels.tolist() == [False, inside, False, inside]


def test_touching_blue_makes_green_vanish() -> None:
    zones = NOWHERE.copy()
    zones[BLUE, 1], zones[GREEN, 0], zones[RED, 0] = [0.3, 0.0], [1.8, 0.0], [1.8, 0.1]
    for env, green_stays in ((NM, False), (ENV, True)):
        results = _go(env, _state(env, (-0.3, 0.0), zones), 110)
        labelled, seen = jax.jit(env.labels), jax.jit(env.proposition_view)
        labels = np.array([labelled(result[1], PARAMS) for result in results])
        lidar = np.array([seen(result[0])[0] for result in results])
        touched = int(np.argmax(labels[:, BLUE]))
        assert labels[touched, BLUE]
        assert 0 < touched < 60
        assert labels[:, RED].any()
        assert labels[:, GREEN].any() == green_stays
        assert (lidar[:touched, GREEN].max(-1) > 0).all()
        assert (lidar[touched:, GREEN].max(-1) > 0).all() == green_stays
        assert (lidar[:, [BLUE, RED, YELLOW]].max(-1) > 0).all()
        if not green_stays:
            assert not lidar[touched:, GREEN].any()
    # The next episode has green again, and green first is no loss.
    assert not NM.reset_to(results[-1][1].layout, jax.random.key(0), PARAMS)[1].vanished.any()
    zones[[BLUE, GREEN]] = zones[[GREEN, BLUE]]
    zones[GREEN, 0], zones[BLUE, 0] = [0.3, 0.0], [1.8, 0.0]
    labelled = jax.jit(NM.labels)
    labels = np.array([labelled(result[1], PARAMS) for result in _go(NM, _state(NM, (-0.3, 0.0), zones), 110)])
    assert labels[:, GREEN].any()
    assert labels[:, BLUE].any()


@functools.cache
def contested_layouts(number: int = 256) -> tuple[np.ndarray, np.ndarray, ZoneLayout]:
    """First and second colours ``[number]``, and the layouts."""
    rng = np.random.default_rng(0)
    first = rng.integers(4, size=number)
    second = (first + rng.integers(1, 4, size=number)) % 4
    draw = jax.jit(jax.vmap(contested_layout))
    layouts = draw(jax.random.split(jax.random.key(0), number), jnp.asarray(first), jnp.asarray(second))
    return first, second, jax.tree.map(np.asarray, layouts)


def test_contested_layouts() -> None:
    first, second, drawn = contested_layouts()
    number = len(first)
    robot, index = drawn.robot[:, :2], np.arange(number)
    better, other = drawn.zones[index, first, 0], drawn.zones[index, first, 1]
    goals = drawn.zones[index, second]
    goal = goals[:, 0]

    def distance(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        return np.linalg.norm(left - right, axis=-1)

    assert np.abs(robot).max() <= 0.3
    assert ((distance(robot, goal) > 1.8 - 1e-5) & (distance(robot, goal) < 2.4 + 1e-5)).all()
    assert (distance(robot, other) + 0.0999 <= distance(robot, better)).all()
    assert ((distance(robot, other) > 0.8 - 1e-5) & (distance(robot, other) < 1.2 + 1e-5)).all()
    share = distance(robot, better) / distance(robot, goal)
    assert ((share > 0.5 - 1e-5) & (share < 0.7 + 1e-5)).all()
    # One on the goal's side, one opposite.
    sides = [((zone - robot) * (goal - robot)).sum(-1) > 0 for zone in (better, other)]
    assert sides[0].all()
    assert not sides[1].any()
    way = [distance(robot, zone) + distance(zone[:, None], goals).min(-1) for zone in (better, other)]
    assert (way[0] + 0.4999 <= way[1]).all()
    zones = drawn.zones.reshape(number, 8, 2)
    assert (np.linalg.norm(zones[:, :, None] - zones[:, None], axis=-1) + 9 * np.eye(8)).min() >= 1.0 - 1e-5
    assert np.abs(zones).max() <= 1.95
    # Nothing else lies on the straight ways: points along them are in zones of the two colours at most.
    for zone in (better, other):
        for start, end in ((robot, zone), (zone, goal)):
            for part in np.linspace(0, 1, 21):
                point = start + part * (end - start)
                inside = distance(point[:, None, None], drawn.zones).min(-1) <= 0.4
                inside[index, first] = inside[index, second] = False
                assert not inside.any()
    assert len(np.unique(zones.reshape(number, -1), axis=0)) == number
    assert stats.kstest(drawn.robot[:, 2], stats.uniform(0, 2 * np.pi).cdf).pvalue > 1e-4


def test_ways_in_contested_layouts_and_in_all_others() -> None:
    """Straight lines; a contested layout's better zone is its first. One behind another cannot be gone to first."""
    first, second, drawn = contested_layouts()
    near, whole = map(np.asarray, jax.jit(jax.vmap(ways))(drawn, jnp.asarray(first), jnp.asarray(second)))
    assert (near[:, 1] < near[:, 0]).all()
    assert (whole[:, 0] + 0.4999 <= whole[:, 1]).all()
    zones = np.full((4, 2, 2), 9.0)
    zones[BLUE], zones[GREEN] = [[1, 0], [-2, 0]], [[-3, 0], [0, 4]]
    near, whole = ways(ZoneLayout(robot=np.zeros(3), zones=jnp.asarray(zones)), BLUE, GREEN)
    np.testing.assert_allclose(near, [1, 2])
    np.testing.assert_allclose(whole, [1 + 4, 2 + 1])
    zones[BLUE] = [[1, 0], [2, 0.1]]
    assert ways(ZoneLayout(robot=np.zeros(3), zones=jnp.asarray(zones)), BLUE, GREEN)[1][1] == np.inf


def test_a_contested_suite_is_of_layouts_whose_straight_ways_are_so() -> None:
    """Half a metre longer over the nearest zone, or shorter; no other zone of the colour on the way there."""
    suite = contested_suite(jax.random.key(5), ENV, num_cases=40)
    assert suite.contested.tolist() == [True] * 20 + [False] * 20
    for case in range(40):
        robot, zones = suite.layouts.robot[case, :2], suite.layouts.zones[case]
        first, second = (int(suite.tasks.reach[case, node].argmax()) for node in (1, 2))
        near = np.linalg.norm(zones[first] - robot, axis=-1)
        whole = near + np.linalg.norm(zones[first][:, None] - zones[second], axis=-1).min(-1)
        nearest = int(near.argmin())
        longer = whole[nearest] - whole[1 - nearest]
        assert (longer >= 0.4999) if suite.contested[case] else (longer <= -0.4999)
        assert suite.nearest[case] == nearest
        assert suite.right[case].tolist() == [zone == (nearest ^ int(suite.contested[case])) for zone in (0, 1)]
        along = zones[first][1 - nearest] - robot
        share = np.clip((zones[first][nearest] - robot) @ along / (along @ along), 0, 1)
        assert np.linalg.norm(zones[first][nearest] - robot - share * along) >= 0.5499


def test_contested_where_two_colours_are_given() -> None:
    draw = jax.jit(ENV.contested_layout)
    key, eye, none = jax.random.key(3), np.eye(4, dtype=bool), np.zeros(4, bool)
    plain = jax.jit(ENV.sample_layout)(key, PARAMS)
    for first, second in ((eye[0], none), (none, eye[1]), (eye[2], eye[2]), (eye[0] | eye[1], eye[2])):
        drawn = draw(key, first, second, PARAMS)
        assert all(jax.tree.leaves(jax.tree.map(np.array_equal, drawn, plain)))
    drawn = draw(key, eye[2], eye[0], PARAMS)
    robot, pair = drawn.robot[:2], drawn.zones[2]
    assert np.linalg.norm(pair[1] - robot) < np.linalg.norm(pair[0] - robot)
    assert ((pair[0] - robot) * (drawn.zones[0, 0] - robot)).sum() > 0 > ((pair[1] - robot) * (pair[0] - robot)).sum()


@pytest.mark.parametrize("reflection", [0, 1, 2, 3])
def test_what_happens_in_a_mirror(reflection: int) -> None:
    """A step of the reflected robot, reflected back, is the robot's own; front for back but for 2 cm of its mass."""
    symmetries, to_back, to_side = ENV.symmetries, *divmod(reflection, 2)
    order, shared, signs, action_signs = (
        np.array(getattr(symmetries, name)[reflection]) for name in ("features", "shared", "signs", "actions")
    )
    rng = np.random.default_rng(reflection)
    step = jax.jit(ENV.step_env)
    for key in jax.random.split(jax.random.key(reflection), 5):
        _, state = ENV.reset(key, PARAMS)
        for action in rng.uniform(-1, 1, (20, 2)):
            state = step(key, state, action, PARAMS)[1]
        mirror = np.array([1.0, 1 - 2 * to_side])
        body = state.body * np.array([1, mirror[1], mirror[1]] * 2) + np.array([0, 0, to_back * np.pi, 0, 0, 0])
        other = state.replace(body=body, layout=state.layout.replace(zones=state.layout.zones * mirror))
        action = rng.uniform(-1, 1, 2)
        lidar, rest = ENV.proposition_view(step(key, state, action, PARAMS)[0])
        lidar_there, rest_there = ENV.proposition_view(step(key, other, action * action_signs, PARAMS)[0])
        np.testing.assert_allclose(lidar_there[:, order], lidar, atol=0.01 if to_back else 1e-4)
        off = np.abs(rest_there[shared] * signs - rest)
        assert off[3:].max() < (0.2 if to_back else 1e-3)
        if not to_back:
            assert off[:3].max() < 1e-3  # the accelerometer feels where the mass is


def test_contests_are_about_colours_that_stay() -> None:
    assert set(ENV.contested_pairs) == {(i, j) for i in range(4) for j in range(4) if i != j}
    blue, green = (ENV.propositions.index(colour) for colour in ("blue", "green"))
    assert set(ENV.contested_pairs) - set(NM.contested_pairs) == {(blue, green)}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"radius": 0.0}, "radius is 0.0"),
        ({"gain": float("nan")}, "gain is nan"),
        ({"horizon": 0}, "horizon is 0"),
        ({"vanishing": (("blue", "purple"),)}, "purple.*expected pairs of colours of blue, green"),
        ({"physics": "warp"}, "unknown physics 'warp'"),
        ({"physics": "closed-form", "walls": True}, "knows no solid walls"),
    ],
)
def test_values_that_do_not_fit_are_refused(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        envs_jax.make("zone", **overrides)


def test_layouts_that_cannot_be_used_are_refused() -> None:
    good = jax.tree.map(lambda x: x[0], layouts())
    ENV.check_layout(good)
    with pytest.raises(ValueError, match="not finite"):
        ENV.check_layout(good.replace(zones=good.zones * np.nan))
    with pytest.raises(ValueError, match=r"robot starts at .*expected within ±3.3"):
        ENV.check_layout(good.replace(robot=np.array([0.0, -3.3, 0.0])))
    with pytest.raises(ValueError, match=r"expected within ±2.3"):
        PRESETS["zone-ltl2action"]().check_layout(good.replace(robot=np.array([2.35, 0.0, 0.0])))
    with pytest.raises(ValueError, match="zone lies outside"):
        ENV.check_layout(good.replace(zones=good.zones + 4))
