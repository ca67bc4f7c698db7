"""Environments of gymnax in this library: a small one with gymnax's interface, and gymnax's own where installed."""

from __future__ import annotations

import dataclasses
import types
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from envs_jax import Box, Discrete, Environment, load_layouts, save_layouts
from envs_jax.adapters import from_gymnax
from envs_jax.adapters.foreign import RESERVED
from hrlspec.spec.syntax import KEYWORDS
from tests.envs import test_contract as contract

WIDTH, HEIGHT, LIMIT = 6, 4, 9
MOVES = np.array([[0, 1], [1, 0], [0, -1], [-1, 0]])


@struct.dataclass
class YardState:
    place: jax.Array  # int32 [2]
    pushes: int
    time: int


@struct.dataclass
class YardParams:
    slip: float = 0.0
    max_steps_in_episode: int = LIMIT


class Yard:
    """A yard of HEIGHT by WIDTH cells with gymnax's interface; the last cell ends an episode and pays.

    As in gymnax, first states have Python numbers for arrays, and observations are not yet float32.
    """

    start_anywhere = True
    default_params = YardParams()

    def action_space(self, params: Any) -> Any:
        return types.SimpleNamespace(n=len(MOVES))

    def observation_space(self, params: Any) -> Any:
        return types.SimpleNamespace(low=np.zeros(2), high=np.array([HEIGHT - 1, WIDTH - 1]), shape=(2,))

    def reset_env(self, key: Any, params: Any) -> Any:
        cell = jax.random.randint(key, (), 0, HEIGHT * WIDTH - 1) if self.start_anywhere else 0
        state = YardState(place=jnp.stack(jnp.divmod(jnp.int32(cell), WIDTH)), pushes=0, time=0)
        return state.place, state

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
        slips = jax.random.uniform(key) < params.slip
        place = jnp.where(slips, state.place, state.place + jnp.asarray(MOVES)[action])
        place = jnp.clip(place, 0, jnp.array([HEIGHT - 1, WIDTH - 1]))
        pushed = (place == state.place).all()
        state = YardState(place=place, pushes=state.pushes + pushed, time=state.time + 1)
        done = (place == jnp.array([HEIGHT - 1, WIDTH - 1])).all()
        return place, state, done.astype(jnp.float32), done, {}

    def is_truncated(self, state: Any, params: Any) -> Any:
        return state.time >= params.max_steps_in_episode


def sides(state: Any) -> dict[str, jax.Array]:
    return {"west": state.place[1] == 0, "east": state.place[1] == WIDTH - 1, "pushed": state.pushes > 0}


YARD = from_gymnax(Yard(), sides)


class Floor(Yard):
    """Two-by-one arrays of actions, each number with bounds of its own; several observed arrays."""

    low, high = np.array([[-1.0], [0.0]]), np.array([[3.0], [0.5]])

    def action_space(self, params: Any) -> Any:
        return types.SimpleNamespace(low=self.low, high=self.high, shape=(2, 1))

    def observation_space(self, params: Any) -> Any:
        return types.SimpleNamespace(spaces={})

    def reset_env(self, key: Any, params: Any) -> Any:
        place = jax.random.uniform(key, (2, 1))
        return {"way": place.T, "fast": False}, {"place": place}

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
        place = state["place"] + action
        return {"way": place.T, "fast": action.sum() > 1}, {"place": place}, 0.0, False, {}


def far(state: Any) -> jax.Array:
    return (state["place"] > 2).reshape(-1)


FLOOR = from_gymnax(Floor(), far, propositions=("x", "y"), horizon=5)


@pytest.mark.parametrize("env", [YARD, FLOOR], ids=["yard", "floor"])
@pytest.mark.parametrize(
    "check",
    [
        contract.test_shapes_dtypes_and_spaces,
        contract.test_truncation_is_not_termination,
        contract.test_reset_to_a_given_layout,
        contract.test_a_batch_equals_its_items,
        contract.test_nothing_recompiles,
        contract.test_a_resampled_layout_differs_only_where_needed,
    ],
)
def test_the_contract_is_kept(check: Any, env: Environment) -> None:
    check(env)


@pytest.mark.parametrize("env", [dataclasses.replace(YARD, terminates=False), FLOOR], ids=["yard", "floor"])
def test_auto_reset(env: Environment) -> None:
    contract.test_auto_reset_keeps_the_final_observation_and_never_repeats_a_layout(env)


def test_what_it_says_of_itself() -> None:
    assert YARD.name == "Yard"
    assert YARD.propositions == ("east", "pushed", "west")
    assert YARD.horizon == LIMIT
    assert YARD.action_space == Discrete(n=4)
    assert YARD.observation_space == Box(low=0.0, high=5.0, shape=(2,))
    assert FLOOR.propositions == ("x", "y")
    assert FLOOR.action_space == Box(low=-1.0, high=1.0, shape=(2,))
    assert FLOOR.observation_shape == (3,)
    assert from_gymnax(Yard(), sides, name="yard", horizon=3).horizon == 3
    assert from_gymnax(Yard(), sides, propositions=("west", "east", "pushed")).propositions[0] == "west"


def test_an_episode_is_the_foreign_one_with_labels() -> None:
    params = YARD.default_params
    layout = YARD.sample_layout(jax.random.key(0), params)
    layout = layout.replace(
        inner=layout.inner.replace(place=jnp.array([1, 3], jnp.int32)), observation=jnp.array([1.0, 3.0])
    )
    observation, state = YARD.reset_to(layout, jax.random.key(1), params)
    place, pushes = np.array([1, 3]), 0
    step = jax.jit(YARD.step_env)
    for t, action in enumerate([0, 0, 0, 2, 1, 1]):
        observation, state, reward, terminated, truncated, _ = step(jax.random.key(t), state, action, params)
        led = np.clip(place + MOVES[action], 0, [HEIGHT - 1, WIDTH - 1])
        pushes += (led == place).all()
        place = led
        assert observation.tolist() == place.tolist() == state.inner.place.tolist()
        assert YARD.labels(state, params).tolist() == [place[1] == WIDTH - 1, pushes > 0, place[1] == 0]
        assert (float(reward), bool(terminated), bool(truncated)) == (0.0, False, False)
        chex.assert_trees_all_equal(state.layout, layout)
    # The foreign goal pays there; here it only ends the episode.
    _, _, reward, terminated, truncated, _ = step(jax.random.key(9), state, 0, params)
    assert (float(reward), bool(terminated), bool(truncated)) == (0.0, True, False)
    goes_on = dataclasses.replace(YARD, terminates=False)
    assert not goes_on.step_env(jax.random.key(9), state, 0, params)[3]


def test_a_time_limit_in_done_is_no_end() -> None:
    class Older(Yard):
        def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            observation, state, reward, done, info = super().step_env(key, state, action, params)
            return observation, state, reward, done | (state.time >= params.max_steps_in_episode), info

        is_truncated = None  # type: ignore[assignment]

    env = from_gymnax(Older(), sides)
    assert env.source.ends_by_time
    assert not YARD.source.ends_by_time
    params = env.default_params
    _, state = env.reset(jax.random.key(0), params)
    step = jax.jit(env.step_env)
    for t in range(LIMIT):
        _, state, _, terminated, truncated, _ = step(jax.random.key(t), state, 3, params)
        assert (bool(terminated), bool(truncated)) == (False, t == LIMIT - 1)


def test_its_own_parameters_are_traced() -> None:
    env = from_gymnax(Yard(), sides, params=YardParams(slip=1.0))
    _, state = YARD.reset(jax.random.key(0), YARD.default_params)
    step = jax.jit(chex.assert_max_traces(env.step_env, n=1))
    for params, pushed in ((env.default_params, True), (env.default_params.replace(inner=YardParams()), False)):
        state = state.replace(inner=state.inner.replace(place=jnp.array([1, 1], jnp.int32)))
        after = step(jax.random.key(1), state, 0, jax.tree.map(jnp.asarray, params))[1]
        assert bool(YARD.labels(after, params)[1]) == pushed


def test_actions_are_stretched_to_their_bounds() -> None:
    params = FLOOR.default_params
    _, state = FLOOR.reset(jax.random.key(0), params)
    start = np.asarray(state.inner["place"])
    for action, expected in (
        ([-1.0, -1.0], Floor.low),
        ([1.0, 1.0], Floor.high),
        ([0.0, 0.0], (Floor.low + Floor.high) / 2),
        ([-7.0, 7.0], [Floor.low[0], Floor.high[1]]),
    ):
        observation, after, *_ = FLOOR.step_env(jax.random.key(1), state, jnp.array(action), params)
        np.testing.assert_allclose(after.inner["place"] - start, expected, atol=1e-6)
        # Arrays in the order of their names: "fast", then "way".
        assert observation[0] == (np.sum(expected) > 1)
        np.testing.assert_array_equal(observation[1:], after.inner["place"][:, 0])


def test_what_is_seen_is_shared_and_scaled_where_bounds_are_known() -> None:
    per_proposition, shared = YARD.proposition_view(jnp.array([0.0, 5.0]))
    assert per_proposition.shape == (3, 0)
    assert shared.tolist() == [-1.0, 1.0]
    assert FLOOR.proposition_view(jnp.array([1.0, -4.0, 7.0]))[1].tolist() == [1.0, -4.0, 7.0]
    assert FLOOR.observation_space == Box(low=-np.inf, high=np.inf, shape=(3,))


def test_images_keep_their_shape() -> None:
    class Camera(Yard):
        def observation_space(self, params: Any) -> Any:
            return types.SimpleNamespace(low=0, high=255, shape=(HEIGHT, WIDTH, 1))

        def reset_env(self, key: Any, params: Any) -> Any:
            observation, state = super().reset_env(key, params)
            return self.picture(observation), state

        def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            observation, *rest = super().step_env(key, state, action, params)
            return self.picture(observation), *rest

        def picture(self, place: Any) -> Any:
            return jnp.zeros((HEIGHT, WIDTH, 1), jnp.uint8).at[place[0], place[1], 0].set(255)

    env = from_gymnax(Camera(), sides)
    observation, state = env.reset(jax.random.key(0), env.default_params)
    assert observation.shape == env.observation_shape == (HEIGHT, WIDTH, 1)
    shared = env.proposition_view(observation)[1]
    assert shared.sum() == 2 - HEIGHT * WIDTH
    assert np.argwhere(shared.reshape(HEIGHT, WIDTH) == 1).tolist() == [state.inner.place.tolist()]


def test_discrete_observations_are_one_hot() -> None:
    class Numbered(Yard):
        def observation_space(self, params: Any) -> Any:
            return types.SimpleNamespace(n=HEIGHT * WIDTH)

        def reset_env(self, key: Any, params: Any) -> Any:
            place, state = super().reset_env(key, params)
            return place[0] * WIDTH + place[1], state

        def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            place, *rest = super().step_env(key, state, action, params)
            return place[0] * WIDTH + place[1], *rest

    env = from_gymnax(Numbered(), sides)
    observation, state = env.reset(jax.random.key(0), env.default_params)
    assert np.flatnonzero(observation).tolist() == [state.inner.place[0] * WIDTH + state.inner.place[1]]
    assert env.observation_shape == (HEIGHT * WIDTH,)


def test_a_view_gets_the_foreign_observation() -> None:
    def view(observation: Any) -> Any:
        return jnp.concatenate([observation["way"].T, -observation["way"].T], 1), observation["fast"][None]

    env = from_gymnax(Floor(), far, propositions=("x", "y"), horizon=5, view=view)
    per_proposition, shared = env.proposition_view(jnp.array([1.0, -4.0, 7.0]))
    assert per_proposition.tolist() == [[-4.0, 4.0], [7.0, -7.0]]
    assert shared.tolist() == [1.0]


def test_layouts_in_files_start_the_same_episode(tmp_path: Any) -> None:
    params = YARD.default_params
    layouts = jax.vmap(YARD.sample_layout, (0, None))(jax.random.split(jax.random.key(0), 3), params)
    save_layouts(tmp_path / "layouts.npz", YARD, layouts)
    loaded = load_layouts(tmp_path / "layouts.npz", YARD)
    chex.assert_trees_all_equal(loaded, layouts)
    with pytest.raises(ValueError, match="number 1: the first observation is not finite"):
        save_layouts(
            tmp_path / "layouts.npz", YARD, layouts.replace(observation=layouts.observation.at[1, 0].set(np.nan))
        )


def test_where_all_starts_are_alike_the_layout_stays() -> None:
    class OneStart(Yard):
        start_anywhere = False

    env = from_gymnax(OneStart(), sides)
    params = env.default_params
    layout = env.sample_layout(jax.random.key(0), params)
    again = jax.jit(env.resample_layout)(jax.random.key(1), layout, jnp.bool_(True), params)
    chex.assert_trees_all_equal(again, layout)


def test_reserved_words_are_those_of_the_language() -> None:
    assert RESERVED == KEYWORDS


@pytest.mark.parametrize(
    ("labels", "options", "message"),
    [
        (sides, {"propositions": ("west", "east")}, r"propositions are \['west', 'east'\], but labels are called"),
        (sides, {"horizon": 0}, "horizon is 0, expected at least 1"),
        (lambda state: {"place": state.place}, {}, r"int32 \[2\] for place, expected bool \[\]"),
        (lambda state: {}, {}, "expected one or more different names"),
        (lambda state: {"or": state.time > 0}, {}, "no proposition can be called 'or'"),
        (lambda state: {"in room": state.time > 0}, {}, "no proposition can be called 'in room'"),
        (lambda state: state.place > 0, {}, "name its entries by propositions="),
        (lambda state: state.place > 0, {"propositions": ("a",)}, r"bool \[2\] for labels, expected bool \[1\]"),
        (lambda state: state.place, {"propositions": ("a", "b")}, r"int32 \[2\] for labels, expected bool \[2\]"),
        (lambda state: [state.time > 0], {"propositions": ("a",)}, "gives a list, expected a dictionary"),
        (lambda state: state.place > 0, {"propositions": ("a", "a")}, "expected one or more different names"),
        (
            sides,
            {"view": lambda seen: (seen[None], seen)},
            r"gives float32 \[1, 2\], float32 \[2\], expected float32 \[3,",
        ),
        (sides, {"view": lambda seen: seen}, r"gives float32 \[2\], expected float32 \[3, ...\]"),
    ],
)
def test_what_cannot_be_meant_is_refused(labels: Any, options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=rf"from_gymnax\(Yard\): .*{message}"):
        from_gymnax(Yard(), labels, **options)


def test_spaces_and_environments_that_cannot_be_used_are_refused() -> None:
    class Unbounded(Yard):
        def action_space(self, params: Any) -> Any:
            return types.SimpleNamespace(low=-np.inf, high=np.inf, shape=(2,))

    class Pair(Yard):
        def action_space(self, params: Any) -> Any:
            return (2, 3)

    class Batched(Yard):
        def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            observation, state, reward, done, info = super().step_env(key, state, action, params)
            return observation, state, reward, done[None], info

    class Growing(Yard):
        def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            return jnp.zeros(3), *super().step_env(key, state, action, params)[1:]

    class Wrapper:
        def __getattr__(self, name: str) -> Any:
            return getattr(Yard(), name)

    class Endless(Yard):
        default_params: Any = ()

    for kind, message in (
        (Unbounded, "expected finite bounds and low < high"),
        (Pair, r"actions lie in \(2, 3\), expected a Discrete or a Box space"),
        (Batched, r"ends have shape \[1\]"),
        (Growing, "other arrays than a reset does"),
        (Wrapper, "without wrappers"),
        (Endless, "give the horizon"),
    ):
        with pytest.raises(ValueError, match=rf"from_gymnax\({kind.__name__}\): .*{message}"):
            from_gymnax(kind(), sides)


GYMNAX_WORLDS = {
    "FourRooms-misc": lambda state: {"left": state.pos[1] < 6, "right": state.pos[1] > 6},
    "CartPole-v1": lambda state: {"left": state.x < -0.5, "right": state.x > 0.5},
    "PointRobot-misc": lambda state: {"north": state.pos[1] > 0.8},
    "FrozenLake-misc": lambda state: {"last": state.position == 15},
    "Breakout-MinAtar": lambda state: {"deep": state.ball_y > 5},
}


@pytest.mark.parametrize("name", GYMNAX_WORLDS)
def test_worlds_of_gymnax(name: str) -> None:
    gymnax = pytest.importorskip("gymnax", reason="gymnax is not installed; it may not go with this JAX")
    inner, params = gymnax.make(name)
    env = from_gymnax(inner, GYMNAX_WORLDS[name], params=params, terminates=False)
    contract.test_shapes_dtypes_and_spaces(env)
    contract.test_nothing_recompiles(env)
    # The same actions lead where gymnax's own steps lead.
    observation, state = env.reset(jax.random.key(0), env.default_params)
    theirs = state.layout.inner
    for t in range(5):
        action = env.action_space.sample(jax.random.key(t))
        key = jax.random.PRNGKey(t)
        low, high = -float(getattr(params, "max_force", 1)), float(getattr(params, "max_force", 1))
        native = action if action.ndim == 0 else low + (action + 1) / 2 * (high - low)
        seen, theirs, *_ = inner.step_env(key, theirs, native, params)
        observation, state, *_ = env.step_env(jax.random.wrap_key_data(key), state, action, env.default_params)
        chex.assert_trees_all_close(state.inner, theirs, atol=1e-6)
        if np.shape(seen) == observation.shape:
            np.testing.assert_allclose(observation, seen, atol=1e-6)
