"""brax: its interface, run with its own training wrappers."""

from __future__ import annotations

import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax import Letter, Walk
from hrlspec.tasks.text_tasks import TextTasks
from tests.probes import Corridor, quick_jit

with warnings.catch_warnings():
    # brax's, at import, under the newest JAX.
    warnings.simplefilter("ignore", DeprecationWarning)
    from brax.envs.base import Env
    from brax.envs.wrappers import training

    from envs_jax.adapters.brax import BraxEnv, wrap

LEFT, RIGHT = np.array([0.7, 0.1], np.float32), np.array([-0.2, -0.1], np.float32)
CORRIDOR = Corridor(starts=(2,))
BATCH = 3


def corridor(task: str | None = "achieve a", **sizes: Any) -> BraxEnv:
    world = Corridor(**{"starts": (2,)} | sizes)
    return BraxEnv(world, TextTasks(world.propositions, 8), task=task)


def started(env: Any) -> tuple[Any, Any]:
    """First state of a batch, and the jitted step."""
    return quick_jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), BATCH)), quick_jit(env.step)


def batch(*actions: np.ndarray) -> jax.Array:
    return jnp.stack(actions if len(actions) == BATCH else actions * BATCH)


def test_it_is_a_brax_environment() -> None:
    env = corridor()
    assert isinstance(env, Env)
    assert (env.observation_size, env.action_size, env.backend, env.horizon) == (30, 2, "corridor", 12)
    walk = BraxEnv(Walk())
    assert (walk.observation_size, walk.action_size) == (2, 2)
    state = env.reset(jax.random.PRNGKey(0))
    assert state.obs.shape == (30,)
    stepped = quick_jit(env.step)(state, LEFT)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), stepped) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert stepped.pipeline_state.state.position == 1


def test_either_kind_of_key_will_do() -> None:
    env = BraxEnv(Corridor())
    for seed in range(5):
        left, right = env.reset(jax.random.PRNGKey(seed)), env.reset(jax.random.key(seed))
        assert np.array_equal(left.obs, right.obs)


def test_boxes_are_stretched() -> None:
    class Shifted(Walk):
        @property
        def action_space(self) -> Any:
            return super().action_space.replace(low=0.0, high=0.5)

    env = BraxEnv(Shifted())
    state = env.step(env.reset(jax.random.key(0)), jnp.array([-1.0, 1.0]))
    assert np.allclose(state.pipeline_state.state.position, [0.0, 0.05])


def test_wrong_tasks_are_refused() -> None:
    with pytest.raises(ValueError, match="line 1"):
        corridor("achieve z")
    with pytest.raises(ValueError, match="without a task language"):
        BraxEnv(CORRIDOR, task="achieve a")


def test_brax_own_wrappers_with_a_task() -> None:
    env = training.wrap(corridor(), episode_length=4)
    state, step = started(env)
    first = state.obs
    actions = [batch(LEFT, RIGHT, LEFT), batch(LEFT, RIGHT, RIGHT), batch(RIGHT), batch(RIGHT), batch(LEFT)]
    reward, done, truncation, success = [], [], [], []
    for action in actions:
        state = step(state, action)
        reward.append(state.reward.tolist())
        done.append(state.done.tolist())
        truncation.append(state.info["truncation"].tolist())
        success.append(state.metrics["success"].tolist())
        ended = state.done > 0
        assert np.array_equal(state.obs[ended], first[ended])
    # The first reaches a twice over; the others are cut off after four steps.
    assert reward == success == [[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert done == [[0, 0, 0], [1, 0, 0], [0, 0, 0], [0, 1, 1], [0, 0, 0]]
    assert truncation == [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 1, 1], [0, 0, 0]]
    assert state.info["steps"].tolist() == [3, 1, 1]
    # After the reset the task has to be done again.
    assert (state.pipeline_state.progress.task.node == 0).all()


def test_brax_evaluation_adds_up_success() -> None:
    env = training.EvalWrapper(training.wrap(corridor(), episode_length=6))
    state, step = started(env)
    for _ in range(3):
        state = step(state, batch(LEFT, RIGHT, LEFT))
    metrics = state.info["eval_metrics"]
    assert metrics.episode_metrics["success"].tolist() == [1, 0, 1]
    assert metrics.episode_metrics["reward"].tolist() == [1, 0, 1]
    assert metrics.episode_steps.tolist() == [2, 3, 2]


def test_a_violated_task_is_done() -> None:
    env = corridor("achieve b ensuring not a")
    state = env.reset(jax.random.key(0))
    step = quick_jit(env.step)
    state = step(step(state, LEFT), LEFT)
    assert (float(state.reward), float(state.done), float(state.metrics["success"])) == (0.0, 1.0, 0.0)
    assert state.info["labels"].tolist() == [True, False, False, False]


def test_new_layouts_at_every_reset() -> None:
    env = wrap(BraxEnv(Letter(size=3, num_letters=2, num_cells=2, horizon=2)))
    state, step = started(env)
    same = []
    for t in range(1, 7):
        layout, before = state.pipeline_state.state.layout, state.info["key"]
        state = step(state, jnp.tile(jnp.eye(4)[0], (BATCH, 1)))
        same.append((layout == state.pipeline_state.state.layout).all((1, 2)).tolist())
        assert state.done.tolist() == state.info["truncation"].tolist() == [float(t % 2 == 0)] * BATCH
        assert state.info["steps"].tolist() == [2.0 - t % 2] * BATCH
        assert state.pipeline_state.state.time.tolist() == [t % 2] * BATCH
        assert (before != state.info["key"]).any()
    assert same == [[True] * BATCH, [False] * BATCH] * 3


def test_new_layouts_do_not_disturb_rewards_and_metrics() -> None:
    """One long scan with both kinds of reset: where all episodes start alike, nothing but the key differs."""

    @functools.partial(quick_jit, static_argnums=0)
    def rollout(env: Any, keys: jax.Array, actions: jax.Array) -> Any:
        def body(state: Any, action: jax.Array) -> Any:
            state = env.step(state, action)
            kept = {k: v for k, v in state.info.items() if k in ("steps", "truncation", "episode_metrics")}
            return state, (state.obs, state.reward, state.done, state.metrics, kept)

        return jax.lax.scan(body, env.reset(keys), actions)[1]

    env = corridor("achieve a; achieve b")
    keys = jax.random.split(jax.random.PRNGKey(0), BATCH)
    actions = jax.random.normal(jax.random.key(1), (80, BATCH, 2))
    ours, theirs = rollout(wrap(env), keys, actions), rollout(training.wrap(env, env.horizon), keys, actions)
    assert all(jax.tree.leaves(jax.tree.map(np.array_equal, ours, theirs)))
    assert ours[1].sum() > 0
    assert ours[4]["truncation"].sum() > 0
