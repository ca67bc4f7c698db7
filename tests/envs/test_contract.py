"""What every registered environment must do, whatever its world."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax.rooms.world import Rooms

NUM = 8
ONE_LAYOUT = {"walk", "conveyor", "conveyor-simple"}
"""Environments that show only a position: what there is stays where it is, and so does the start."""
MAY_FAIL = {"flatworld", "zone", "zone-nm", "zone-jaxolotl", "zone-nm-jaxolotl"}
"""Environments whose episodes end where the square does."""


# Between solid walls MJX takes a minute to compile for each test; of either robot one other world is enough.
SLOW = {"zone-ltl2action", "zone-nm", "zone-nm-jaxolotl"}
PRESETS = [
    pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in (*envs_jax.registered(), "rooms")
]


@pytest.fixture(scope="module", params=PRESETS)
def env(request: pytest.FixtureRequest) -> envs_jax.Environment:
    return _make(request.param)


def _make(name: str) -> envs_jax.Environment:
    return Rooms() if name == "rooms" else envs_jax.make(name)


def _still(env: envs_jax.Environment) -> jax.Array:
    """An action that leads nowhere far."""
    return jnp.zeros(env.action_space.shape, env.action_space.dtype)


@functools.cache
def _jitted(env: envs_jax.Environment, method: str) -> Callable[..., Any]:
    """The method, compiled once for all tests."""
    return jax.jit(getattr(env, method))


def _same(left: object, right: object) -> bool:
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, left, right)))


def _alike(left: object, right: object) -> bool:
    """The same up to what a compiler may round differently in another program."""
    close = functools.partial(np.allclose, rtol=1e-3, atol=5e-3)  # The accelerometer amplifies what rounding does.
    return all(jax.tree.leaves(jax.tree.map(close, left, right)))


def _rollout(env: envs_jax.Environment, params: envs_jax.EnvParams, num_steps: int, seed: int = 0):
    """States before, actions, and results of ``num_steps`` random auto-reset steps of NUM environments (axes T, E)."""

    def one(key: jax.Array):
        key, reset_key = jax.random.split(key)
        _, state = env.reset(reset_key, params)

        def body(state, key):
            action_key, step_key = jax.random.split(key)
            action = env.action_space.sample(action_key)
            result = env.step(step_key, state, action, params)
            return result[1], (state, action, result)

        return jax.lax.scan(body, state, jax.random.split(key, num_steps))[1]

    return jax.jit(jax.vmap(one, out_axes=1))(jax.random.split(jax.random.key(seed), NUM))


def test_registry_refuses_what_it_does_not_know() -> None:
    with pytest.raises(ValueError, match=r"unknown environment 'lettre'.*letter12"):
        envs_jax.make("lettre")
    with pytest.raises(ValueError, match=r"'letter'.*sizes"):
        envs_jax.make("letter", sizes=3)


def test_environments_are_static_values(env: envs_jax.Environment) -> None:
    assert env == _make(env.name)
    assert hash(env) == hash(_make(env.name))
    assert len(set(env.propositions)) == env.num_propositions > 0


def test_shapes_dtypes_and_spaces(env: envs_jax.Environment) -> None:
    params = env.default_params
    observation, state = _jitted(env, "reset")(jax.random.key(0), params)
    result = _jitted(env, "step")(jax.random.key(1), state, env.action_space.sample(jax.random.key(2)), params)
    for seen in (observation, result[0], result[5]["final_observation"]):
        chex.assert_shape(seen, env.observation_shape)
        chex.assert_type(seen, jnp.float32)
        assert env.observation_space.contains(seen)
    chex.assert_trees_all_equal_shapes_and_dtypes(state, result[1])
    chex.assert_shape(result[2:5], ())
    chex.assert_type(result[2:5], [jnp.float32, bool, bool])
    labels = _jitted(env, "labels")(state, params)
    chex.assert_shape(labels, (env.num_propositions,))
    chex.assert_type(labels, bool)
    per_proposition, shared = _jitted(env, "proposition_view")(observation)
    assert per_proposition.shape[0] == env.num_propositions
    assert shared.ndim == 1


def test_spaces_contain_what_they_sample_and_nothing_else(env: envs_jax.Environment) -> None:
    for space in (env.observation_space, env.action_space):
        sample = space.sample(jax.random.key(0))
        assert space.contains(sample)
        assert sample.shape == space.shape
        assert sample.dtype == space.dtype
        assert not space.contains(np.full((*space.shape, 1), 0))
        assert not space.contains(np.asarray(sample) + 1000)


def test_truncation_is_not_termination(env: envs_jax.Environment) -> None:
    params = env.default_params.replace(horizon=jnp.int32(5))
    _, state = _jitted(env, "reset")(jax.random.key(0), params)
    step_env = _jitted(env, "step_env")
    for t in range(1, 6):
        _, state, reward, terminated, truncated, _ = step_env(jax.random.key(t), state, _still(env), params)
        assert bool(truncated) == (t == 5)
        assert not bool(terminated)
        assert float(reward) == 0.0


def test_auto_reset_keeps_the_final_observation_and_never_repeats_a_layout(env: envs_jax.Environment) -> None:
    params = env.default_params.replace(horizon=jnp.int32(4))
    step_env, reset_to = _jitted(env, "step_env"), _jitted(env, "reset_to")
    states, actions, results = jax.device_get(_rollout(env, params, 14))
    observations, after, _, terminated, truncated, info = results
    assert env.name in MAY_FAIL or not terminated.any()
    assert np.array_equal(truncated, states.time + 1 == 4)
    assert truncated.sum(0).min() >= 1
    done = terminated | truncated
    for t, e in np.ndindex(14, NUM):
        before, action, now = jax.tree.map(lambda x, t=t, e=e: x[t, e], (states, actions, after))
        seen, final = observations[t, e], info["final_observation"][t, e]
        if not done[t, e]:
            assert np.array_equal(seen, final)
            assert _same(before.layout, now.layout)
            continue
        assert _same(before.layout, now.layout) == (env.name in ONE_LAYOUT)
        fresh = reset_to(now.layout, jax.random.key(0), params)
        assert _alike((seen, now), fresh)
        assert _alike(final, step_env(jax.random.key(0), before, action, params)[0])


def test_reset_to_a_given_layout(env: envs_jax.Environment) -> None:
    params = env.default_params
    layout = _jitted(env, "sample_layout")(jax.random.key(3), params)
    observation, state = _jitted(env, "reset_to")(layout, jax.random.key(4), params)
    assert _same(state.layout, layout)
    assert np.array_equal(observation, _jitted(env, "observation")(state, params))


def test_a_batch_equals_its_items(env: envs_jax.Environment) -> None:
    params = env.default_params
    keys = jax.random.split(jax.random.key(5), NUM)
    reset = _jitted(env, "reset")
    batch = jax.jit(jax.vmap(env.reset, (0, None)))(keys, params)
    for e in range(NUM):
        assert _alike(jax.tree.map(lambda x, e=e: x[e], batch), reset(keys[e], params))


def test_nothing_recompiles(env: envs_jax.Environment) -> None:
    """Whether a state is the first one or a later one, and whatever the horizon."""
    reset, step = _jitted(env, "reset"), _jitted(env, "step")
    sizes = set()
    for horizon in (3, 7):
        params = env.default_params.replace(horizon=jnp.int32(horizon))
        _, state = reset(jax.random.key(horizon), params)
        for t in range(8):
            action = env.action_space.sample(jax.random.key(t))
            _, state, *_ = step(jax.random.key(t), state, action, params)
            sizes.add((reset._cache_size(), step._cache_size()))
    assert len(sizes) == 1


def test_a_resampled_layout_differs_only_where_needed(env: envs_jax.Environment) -> None:
    params = env.default_params
    layout = _jitted(env, "sample_layout")(jax.random.key(6), params)
    resample = _jitted(env, "resample_layout")
    for seed in range(5):
        assert _same(resample(jax.random.key(seed), layout, jnp.bool_(False), params), layout)
        again = resample(jax.random.key(seed), layout, jnp.bool_(True), params)
        assert _same(again, layout) == (env.name in ONE_LAYOUT)
    # The very draw that gave this layout must be passed over.
    again = resample(jax.random.key(6), layout, jnp.bool_(True), params)
    assert _same(again, layout) == (env.name in ONE_LAYOUT)


def test_labels_that_occur_are_said_to_be_possible(env: envs_jax.Environment) -> None:
    """Everywhere where there is a graph or a grid; elsewhere on random ways."""
    layout = jax.device_get(_jitted(env, "sample_layout")(jax.random.key(3), env.default_params))
    if isinstance(env, envs_jax.FiniteGraph):
        labels = np.asarray(env.transition_table(layout, env.default_params)[1])
    elif isinstance(env, envs_jax.GridMap):
        labels = env.grid(layout)[0].reshape(-1, env.num_propositions)
    else:
        _, state = _jitted(env, "reset_to")(layout, jax.random.key(0), env.default_params)
        found = []
        for key in jax.random.split(jax.random.key(1), 40):
            state = _jitted(env, "step_env")(key, state, env.action_space.sample(key), env.default_params)[1]
            found.append(np.asarray(_jitted(env, "labels")(state, env.default_params)))
        labels = np.array(found)
    names = np.array(env.propositions)
    assert {frozenset(names[row].tolist()) for row in np.unique(labels, axis=0)} <= set(env.possible_labels)
    assert len(set(env.possible_labels)) == len(env.possible_labels)
    assert frozenset() in env.possible_labels


def test_how_many_labels_are_possible() -> None:
    """The peers' FlatWorld has these thirteen; the paper's Walk has no two regions that overlap."""
    numbers = {"letter": 6, "letter12": 13, "walk": 6, "flatworld": 13, "zone": 5}
    assert {name: len(envs_jax.make(name).possible_labels) for name in numbers} == numbers
