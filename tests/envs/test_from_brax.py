"""Environments of brax in this library: a small one with brax's interface, and brax's own."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import warnings
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from envs_jax import Box
from envs_jax.adapters import from_brax
from tests.envs import test_contract as contract

HORIZON = 7
EDGE = 2.0


@struct.dataclass
class CartState:
    obs: jax.Array
    done: jax.Array
    info: dict[str, Any]
    metrics: dict[str, Any]


class Cart:
    """A cart on a track with brax's interface: an action is its velocity, and beyond EDGE the episode is over.

    As brax's own environments do, it writes into its state's dictionaries.
    """

    action_size = 1

    def reset(self, rng: jax.Array) -> CartState:
        place = jax.random.uniform(rng, (1,))
        return CartState(obs=place, done=jnp.zeros(()), info={}, metrics={"speed": jnp.zeros(())})

    def step(self, state: CartState, action: jax.Array) -> CartState:
        state.metrics.update(speed=jnp.abs(action).sum())
        obs = state.obs + action
        done = (jnp.abs(obs) > EDGE).any().astype(jnp.float32)
        return CartState(obs=obs, done=done, info=state.info, metrics=state.metrics)


def ends(state: Any) -> dict[str, jax.Array]:
    return {"left": state.obs[0] < -1, "right": state.obs[0] > 1, "fast": state.metrics["speed"] > 0.9}


CART = from_brax(Cart(), ends, horizon=HORIZON)
STAYS = dataclasses.replace(CART, terminates=False)


@pytest.mark.parametrize(
    "check",
    [
        contract.test_shapes_dtypes_and_spaces,
        contract.test_truncation_is_not_termination,
        contract.test_auto_reset_keeps_the_final_observation_and_never_repeats_a_layout,
        contract.test_reset_to_a_given_layout,
        contract.test_a_batch_equals_its_items,
        contract.test_nothing_recompiles,
        contract.test_a_resampled_layout_differs_only_where_needed,
    ],
)
def test_the_contract_is_kept(check: Any) -> None:
    check(STAYS)


def test_what_it_says_of_itself() -> None:
    assert CART.name == "Cart"
    assert CART.propositions == ("fast", "left", "right")
    assert CART.horizon == HORIZON
    assert CART.action_space == Box(low=-1.0, high=1.0, shape=(1,))
    assert CART.observation_space == Box(low=-np.inf, high=np.inf, shape=(1,))
    per_proposition, shared = CART.proposition_view(jnp.array([-3.0]))
    assert per_proposition.shape == (3, 0)
    assert shared.tolist() == [-3.0]


def test_an_episode_is_the_foreign_one_with_labels() -> None:
    params = CART.default_params
    _, state = CART.reset(jax.random.key(0), params)
    start = place = float(state.observation[0])
    for action, clipped in ((0.5, 0.5), (-3.0, -1.0), (1.0, 1.0), (1.0, 1.0)):
        before = state
        observation, state, reward, terminated, truncated, _ = CART.step_env(
            jax.random.key(1), state, jnp.array([action]), params
        )
        place += clipped
        np.testing.assert_allclose(observation, [place], atol=1e-5)
        assert CART.labels(state, params).tolist() == [abs(clipped) > 0.9, place < -1, place > 1]
        assert (float(reward), bool(terminated), bool(truncated)) == (0.0, place > EDGE, False)
        assert not STAYS.step_env(jax.random.key(1), before, jnp.array([action]), params)[3]
        if place > EDGE:
            break
    assert place > EDGE
    # What the environment wrote into its dictionaries is not in states from before.
    assert float(state.layout.inner.metrics["speed"]) == 0.0
    assert float(state.layout.inner.obs[0]) == start


def test_wrappers_that_would_hide_the_last_state_are_refused() -> None:
    class Resets(Cart):
        def reset(self, rng: jax.Array) -> CartState:
            state = super().reset(rng)
            return state.replace(info={"first_obs": state.obs})

    class Batched(Cart):
        def reset(self, rng: jax.Array) -> CartState:
            return jax.vmap(super().reset)(jax.random.split(rng, 3))

        def step(self, state: CartState, action: jax.Array) -> CartState:
            return jax.vmap(super().step, (0, None))(state, action)

    with pytest.raises(ValueError, match=r"from_brax\(Resets\): it resets itself"):
        from_brax(Resets(), ends, horizon=HORIZON)
    with pytest.raises(ValueError, match=r"from_brax\(Batched\): done has shape \[3\]"):
        from_brax(Batched(), ends, horizon=HORIZON)


def test_what_cannot_be_meant_is_refused() -> None:
    with pytest.raises(ValueError, match=r"from_brax\(object\): expected an environment with reset, step"):
        from_brax(object(), ends, horizon=HORIZON)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"from_brax\(Cart\): horizon is -1"):
        from_brax(Cart(), ends, horizon=-1)
    with pytest.raises(ValueError, match=r"from_brax\(Cart\): .* float32 \[1\] for labels, expected bool \[1\]"):
        from_brax(Cart(), lambda state: state.obs, horizon=HORIZON, propositions=("a",))


def _brax() -> Any:
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # under the newest JAX
        return pytest.importorskip("brax.envs", reason="brax is not installed")


def test_braxs_wrappers() -> None:
    brax = _brax()
    labels = lambda state: {"on": state.pipeline_state.x.pos[0] > 1e-3}  # noqa: E731
    with pytest.raises(ValueError, match=r"from_brax\(AutoResetWrapper\): it resets itself"):
        from_brax(brax.create("fast"), labels, horizon=4)
    # A time limit within is none of the world's ends.
    env = from_brax(brax.create("fast", episode_length=4, action_repeat=2, auto_reset=False), labels, horizon=9)
    params = env.default_params
    _, state = env.reset(jax.random.key(0), params)
    for t in (1, 2):
        _, state, _, terminated, truncated, _ = env.step_env(jax.random.key(0), state, jnp.ones(1), params)
        assert (bool(terminated), bool(truncated)) == (False, t == 2)
    assert env.labels(state, params).tolist() == [True]
    with pytest.raises(ValueError, match=r"from_brax\(VmapWrapper\): done has shape \[2\]"):
        from_brax(brax.create("fast", batch_size=2, auto_reset=False), labels, horizon=4)


@pytest.mark.slow  # brax compiles for long
@pytest.mark.filterwarnings("ignore:Brax System", "ignore:Accessing `.*` directly from `Data`:DeprecationWarning")
def test_reacher_goes_where_brax_has_it_go() -> None:
    brax = _brax()
    inner = brax.get_environment("reacher", backend="spring")
    env = from_brax(inner, lambda state: {"bent": state.pipeline_state.q[1] > 0.5}, horizon=50)
    params = env.default_params
    _, state = jax.jit(env.reset)(jax.random.key(0), params)
    theirs, action = state.layout.inner, jnp.array([0.0, 1.0])
    step, their_step = jax.jit(env.step_env), jax.jit(inner.step)
    for t in range(10):
        observation, state, *_ = step(jax.random.key(t), state, action, params)
        theirs = their_step(theirs, action)
        chex.assert_trees_all_close(state.inner.pipeline_state, theirs.pipeline_state, atol=1e-4)
        np.testing.assert_allclose(observation, theirs.obs, atol=1e-4)
        assert env.labels(state, params).tolist() == [bool(theirs.pipeline_state.q[1] > 0.5)]
