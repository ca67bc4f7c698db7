"""Walk and FlatWorld against plain numpy readings of their rules."""

from __future__ import annotations

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax import Walk, WalkLayout, load_layouts, save_layouts
from envs_jax.walk.world import FLATWORLD_DISCS, NO_DISC, PAPER_DISCS


def _layout(env: Walk, seed: int = 0) -> WalkLayout:
    return jax.tree.map(np.asarray, env.sample_layout(jax.random.key(seed), env.default_params))


def _held(discs: Any, position: Any) -> set[str]:
    return {name for name, x, y, radius in discs if (position[0] - x) ** 2 + (position[1] - y) ** 2 <= radius**2}


def test_the_papers_world() -> None:
    env = envs_jax.make("walk")
    assert env.propositions == ("a", "b", "c", "d", "e")
    assert (env.low, env.high, env.horizon) == (-1.0, 10.0, 300)
    layout = _layout(env)
    assert layout.start.tolist() == [0, 0]
    expected = {"d": (1.5, 8.8), "e": (0.4, 4.4), "a": (5.1, 3.1), "b": (8.5, 4.0), "c": (8.6, -0.3)}
    for i, name in enumerate(env.propositions):
        np.testing.assert_allclose(layout.discs[:, i, 0], (*expected[name], 1.0), rtol=1e-6)


def test_flatworld_is_deepltls() -> None:
    env = envs_jax.make("flatworld")
    assert env.propositions == ("aqua", "blue", "green", "magenta", "orange", "red", "yellow")
    assert (env.low, env.high, env.step_size, env.horizon) == (-2.0, 2.0, 0.08, 500)
    discs = _layout(env).discs
    assert (discs[2] > 0).sum(-1).tolist() == [1, 1, 2, 1, 1, 2, 1]
    np.testing.assert_allclose(discs[:, 1, 0], (0.1, 0.0, 0.8), rtol=1e-6)
    np.testing.assert_allclose(discs[:, 5].T, [(-1.4, 0.55, 0.4), (0.5, -1.3, 0.35)], rtol=1e-6)
    # The conjunctions that the peer lists as possible, and no others.
    places = np.stack(np.meshgrid(*[np.linspace(-2, 2, 161)] * 2), -1).reshape(-1, 2)
    together = {frozenset(_held(FLATWORLD_DISCS, place)) for place in places}
    assert {held for held in together if len(held) > 1} == {
        frozenset(names.split())
        for names in ("red magenta", "blue green", "green aqua", "blue aqua", "blue green aqua")
    }


@pytest.mark.parametrize(("name", "discs"), [("walk", PAPER_DISCS), ("flatworld", FLATWORLD_DISCS)])
def test_labels_everywhere(name: str, discs: Any) -> None:
    env = envs_jax.make(name)
    params = env.default_params
    rng = np.random.default_rng(0)
    places = rng.uniform(env.low, env.high, (4000, 2)).astype(np.float32)
    _, state = env.reset_to(_layout(env), jax.random.key(0), params)

    def at(position: jax.Array) -> jax.Array:
        return env.labels(state.replace(position=position), params)

    held = np.asarray(jax.jit(jax.vmap(at))(places))
    expected = [[p in _held(discs, place) for p in env.propositions] for place in places]
    distances = np.array([[abs(np.hypot(x - d[1], y - d[2]) - d[3]) for d in discs] for x, y in places])
    clear = distances.min(-1) > 1e-5
    np.testing.assert_array_equal(held[clear], np.array(expected)[clear])
    assert held.any(0).all()
    assert (held.sum(-1) > 1).any() == (name == "flatworld")


def test_several_propositions_hold_at_once() -> None:
    env = envs_jax.make("walk", discs=(("x", 1.0, 0.0, 0.5), ("y", 1.5, 0.0, 0.6), ("x", 3.0, 0.0, 0.4)))
    params = env.default_params
    _, state = env.reset_to(_layout(env), jax.random.key(0), params)
    held = []
    for _ in range(36):
        _, state, *_ = env.step_env(jax.random.key(0), state, jnp.array([1.0, 0.0]), params)
        held.append("".join(np.array(["x", "y"])[np.asarray(env.labels(state, params))]))
    assert [text for i, text in enumerate(held) if i == 0 or text != held[i - 1]] == ["", "x", "xy", "y", "", "x", ""]


def test_steps_are_clipped_and_end_at_the_sides() -> None:
    env = envs_jax.make("walk")
    params = env.default_params
    step = jax.jit(env.step_env)
    for action, moved in {(1.0, -0.5): (0.1, -0.05), (3.0, -40.0): (0.1, -0.1), (0.0, 0.0): (0.0, 0.0)}.items():
        observation, state = env.reset_to(_layout(env), jax.random.key(0), params)
        observation, state, *_ = step(jax.random.key(0), state, jnp.array(action), params)
        np.testing.assert_allclose(observation, moved, rtol=1e-6)
        np.testing.assert_array_equal(observation, state.position)
    for _ in range(120):
        observation, state, _, terminated, _, _ = step(jax.random.key(0), state, jnp.array([-1.0, 1.0]), params)
        assert not terminated
        assert env.observation_space.contains(observation)
    assert observation.tolist() == [-1.0, 10.0]


def test_flatworld_ends_at_its_sides() -> None:
    env = envs_jax.make("flatworld")
    params = env.default_params
    layout = WalkLayout(start=np.float32([1.9, -1.5]), discs=_layout(env).discs)
    _, state = env.reset_to(layout, jax.random.key(0), params)
    step = jax.jit(env.step_env)
    _, state, reward, terminated, truncated, _ = step(jax.random.key(0), state, jnp.array([1.0, 0.0]), params)
    assert not terminated
    assert not truncated
    observation, state, reward, terminated, truncated, _ = step(jax.random.key(0), state, jnp.array([1.0, 0]), params)
    assert terminated
    assert not truncated
    assert float(reward) == 0.0
    assert env.observation_space.contains(observation)
    assert not env.labels(state, params).any()


def test_starts_of_flatworld_are_random_and_free() -> None:
    env = envs_jax.make("flatworld")
    sample = jax.jit(jax.vmap(lambda key: env.sample_layout(key, env.default_params)))
    layouts = sample(jax.random.split(jax.random.key(0), 2000))
    assert not any(_held(FLATWORLD_DISCS, start) for start in np.asarray(layouts.start))
    assert len(np.unique(layouts.start, axis=0)) == 2000
    places = np.random.default_rng(0).uniform(-2, 2, (8000, 2))
    free = places[[not _held(FLATWORLD_DISCS, place) for place in places]]
    expected = np.bincount(2 * (free[:, 0] > 0) + (free[:, 1] > 0)) / len(free)
    found = np.bincount(2 * (layouts.start[:, 0] > 0) + (layouts.start[:, 1] > 0)) / 2000
    np.testing.assert_allclose(found, expected, atol=0.05)
    assert np.array_equal(layouts.discs, np.broadcast_to(layouts.discs[0], layouts.discs.shape))


def test_auto_reset_begins_anew_at_the_start() -> None:
    env = envs_jax.make("walk")
    params = env.default_params.replace(horizon=jnp.int32(3))
    _, state = env.reset(jax.random.key(0), params)
    step = jax.jit(env.step)
    for t in range(1, 8):
        observation, state, _, _, truncated, info = step(jax.random.key(t), state, jnp.array([1.0, 0.5]), params)
        assert bool(truncated) == (t % 3 == 0)
        np.testing.assert_allclose(info["final_observation"][0], 0.1 * ((t - 1) % 3 + 1), rtol=1e-5)
        np.testing.assert_allclose(observation[0], 0.1 * (t % 3), rtol=1e-5, atol=1e-7)
        assert int(state.time) == t % 3


def test_only_the_position_is_seen() -> None:
    for name in ("walk", "flatworld"):
        env = envs_jax.make(name)
        corners = jnp.array([[env.low, env.high], [env.high, env.low], [(env.low + env.high) / 2] * 2])
        per_proposition, shared = jax.vmap(env.proposition_view)(corners)
        assert per_proposition.shape == (3, env.num_propositions, 0)
        np.testing.assert_allclose(shared, [[-1, 1], [1, -1], [0, 0]], atol=1e-6)


@pytest.mark.parametrize("name", ["walk", "flatworld"])
def test_random_layouts(name: str) -> None:
    envs = [envs_jax.make(name, layout_seed=seed) for seed in range(12)]
    again = envs_jax.make(name, layout_seed=4)
    assert again == envs[4]
    assert again != envs[5]
    np.testing.assert_array_equal(_layout(again).discs, _layout(envs[4]).discs)
    layouts = [_layout(env) for env in envs]
    assert len({layout.discs.tobytes() for layout in layouts}) == len(envs)
    overlap = 0
    own = _layout(envs_jax.make(name))
    for env, layout in zip(envs, layouts, strict=True):
        env.check_layout(layout)
        x, y, radius = layout.discs
        np.testing.assert_array_equal(radius, own.discs[2])
        real = radius > 0
        for centre in (x, y):
            assert ((centre - radius >= env.low - 1e-5) & (centre + radius <= env.high + 1e-5))[real].all()
        labels, inside, _ = env.grid(layout)
        assert inside.any()
        alone = labels & (labels.sum(-1, keepdims=True) == 1)
        assert alone.any((0, 1)).all()
        overlap += int((labels.sum(-1) > 1).any())
    assert overlap > 0


def test_regions_are_the_same_in_every_episode() -> None:
    env = envs_jax.make("walk", layout_seed=7)
    params = env.default_params.replace(horizon=jnp.int32(2))
    _, state = env.reset(jax.random.key(0), params)
    first = np.asarray(state.layout.discs)
    for t in range(5):
        _, state, *_ = env.step(jax.random.key(t), state, jnp.array([0.3, 0.2]), params)
        np.testing.assert_array_equal(state.layout.discs, first)
    np.testing.assert_array_equal(_layout(env, 99).discs, first)


def test_given_layouts_count() -> None:
    env = envs_jax.make("walk")
    params = env.default_params.replace(horizon=jnp.int32(2))
    own = _layout(env)
    discs = own.discs.copy()
    discs[:, 0, 0] = (2.0, 2.0, 0.5)
    given = WalkLayout(start=np.float32([2.0, 1.45]), discs=discs)
    env.check_layout(given)
    _, state = env.reset_to(given, jax.random.key(0), params)
    for _ in range(3):  # Beyond the first episode's end too: nothing else is known to be right.
        _, state, *_ = env.step(jax.random.key(0), state, jnp.array([0.0, 1.0]), params)
        np.testing.assert_array_equal(state.layout.discs, discs)
    assert env.labels(state, params).tolist() == [True, False, False, False, False]


def test_layouts_in_files(tmp_path: pathlib.Path) -> None:
    env = envs_jax.make("flatworld")
    layouts = jax.tree.map(lambda *x: np.stack(x), *[_layout(env, seed) for seed in range(3)])
    save_layouts(tmp_path / "layouts.npz", env, layouts)
    loaded = load_layouts(tmp_path / "layouts.npz", env)
    assert isinstance(loaded, WalkLayout)
    jax.tree.map(np.testing.assert_array_equal, loaded, layouts)
    with pytest.raises(ValueError, match="flatworld"):
        load_layouts(tmp_path / "layouts.npz", envs_jax.make("walk"))


def _changed(layout: WalkLayout, index: Any, value: float) -> WalkLayout:
    discs = layout.discs.copy()
    discs[index] = value
    return WalkLayout(start=layout.start, discs=discs)


def test_layouts_that_cannot_be_used() -> None:
    env = envs_jax.make("walk")
    own = _layout(env)
    env.check_layout(own)
    bad = {
        r"radii .*expected finite numbers above 0": _changed(own, (2, 1, 0), 0.0),
        r"radii .*or -1 for no disc": _changed(own, (0, 1, 0), np.nan),
        "there is no disc for c": _changed(own, (2, 2, 0), NO_DISC),
        r"start \[11.0, 0.0\] is outside": WalkLayout(start=np.float32([11, 0]), discs=own.discs),
        r"in the region of a": WalkLayout(start=np.float32([5, 3]), discs=own.discs),
    }
    for message, layout in bad.items():
        with pytest.raises(ValueError, match=message):
            env.check_layout(layout)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"low": 3.0, "high": 3.0}, "from 3.0 to 3.0"),
        ({"step_size": 0.0}, "step_size is 0.0"),
        ({"horizon": 0}, "horizon is 0"),
        ({"layout_seed": -1}, "layout_seed is -1"),
        ({"discs": ()}, "no regions"),
        ({"discs": (("a", 1.0, 1.0),)}, "expected x, y and a radius"),
        ({"discs": (("a", 1.0, 1.0, -2.0),)}, "radius above 0"),
        ({"start": (5.0, 3.0)}, "in the region of a"),
        ({"start": (50.0, 3.0)}, "outside of the square"),
        ({"start": None, "discs": (("a", 4.0, 4.0, 9.0),)}, "free of regions"),
        ({"discs": (("a", 4.0, 4.0, 5.6),), "layout_seed": 0, "start": (-1.0, -1.0)}, "does not fit"),
        ({"discs": (("a", 4.0, 4.0, 5.4), ("b", 4.0, 4.0, 5.4)), "layout_seed": 0}, "no random layout"),
        ({"size": 3}, "size"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(sizes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        envs_jax.make("walk", **sizes)


@pytest.mark.parametrize("name", ["walk", "flatworld"])
def test_the_grid_is_where_steps_lead(name: str) -> None:
    env = envs_jax.make(name)
    params = env.default_params
    layout = _layout(env, 5)
    labels, inside, place = env.grid(layout)
    assert labels.shape == (*inside.shape, env.num_propositions)
    assert inside[tuple(place)]
    _, state = env.reset_to(layout, jax.random.key(0), params)
    step, label = jax.jit(env.step_env), jax.jit(env.labels)
    rng = np.random.default_rng(0)
    drift = np.array([1, -1])
    compared = 0
    for t in range(200):
        if t % 25 == 0:
            drift = rng.choice([-1, 1], 2)
        move = np.where(rng.random(2) < 0.4, rng.integers(-1, 2, 2), drift)
        to = place + move
        if not ((to >= 0) & (to < inside.shape)).all() or not inside[tuple(to)]:
            continue
        _, state, _, terminated, _, _ = step(jax.random.key(0), state, jnp.asarray(move, jnp.float32), params)
        assert not terminated
        place = to
        edge = np.hypot(*(layout.discs[:2] - np.asarray(state.position)[:, None, None])) - layout.discs[2]
        if np.abs(edge[layout.discs[2] > 0]).min() > 1e-4:
            assert label(state, params).tolist() == labels[tuple(place)].tolist()
            compared += 1
    assert compared > 100
    # The last place along a side is the last that a step leads to.
    assert np.ptp(inside.any(1).nonzero()[0]) + 1 == inside.any(1).sum() >= (env.high - env.low) / env.step_size - 1
