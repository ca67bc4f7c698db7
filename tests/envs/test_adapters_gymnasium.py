"""Gymnasium: single and vector environments, with and without tasks."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

import hrlspec.gymnasium
from envs_jax import Letter, Walk
from envs_jax.adapters import gymnasium as adapter
from envs_jax.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from envs_jax.zone.world import Zone
from hrlspec.gymnasium import make, make_vec
from tests.probes import Corridor, CorridorLayout

ROOT = Path(__file__).parents[2]
LEFT, RIGHT = 0, 1
CORRIDOR = Corridor(starts=(2,))
WANDERING = Corridor()
TASKS = ("achieve a; achieve b", "achieve b or achieve c", "achieve b ensuring not a")


def trace(env: gymnasium.Env, actions: list[int]) -> list[tuple[float, bool, bool, str]]:
    steps = (env.step(action) for action in actions)
    return [(reward, terminated, truncated, info["status"]) for _, reward, terminated, truncated, info in steps]


@pytest.mark.parametrize("world", [WANDERING, Walk(horizon=20), Letter(size=3, num_letters=2, num_cells=2, horizon=9)])
@pytest.mark.parametrize("task", [None, "achieve a or achieve b"])
def test_gymnasiums_own_checks_pass(world: Any, task: str | None) -> None:
    # Render modes are tried only on environments made by id; there are none.
    check_env(make(world, task=task), skip_render_check=True)


def test_a_task_from_text_to_reward() -> None:
    env = make(CORRIDOR)
    observation, info = env.reset(seed=0, options={"task": "achieve a; (achieve b ensuring not c or achieve c)"})
    assert env.observation_space.contains(observation)
    assert info.pop("labels").tolist() == [False] * 4
    assert info == {"status": "running", "node": 0, "subtasks": ("achieve a",), "success": False}
    assert trace(env, [LEFT]) == [(0.0, False, False, "running")]
    _, reward, terminated, truncated, info = env.step(LEFT)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert info.pop("labels").tolist() == [True, False, False, False]
    offered = ("achieve b ensuring not c", "achieve c ensuring not b")
    assert info == {"status": "running", "node": 1, "subtasks": offered, "success": False}
    assert trace(env, [RIGHT] * 3) == [(0.0, False, False, "running")] * 3
    observation, reward, terminated, truncated, info = env.step(RIGHT)
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert observation[-1].tolist() == [0, 0, 0, 0, 1, 0]
    assert (info["status"], info["subtasks"], info["success"]) == ("satisfied", (), True)


def test_a_blocked_subtask_is_open_no_longer() -> None:
    env = make(CORRIDOR, task="(achieve b ensuring not a) or achieve c")
    assert len(env.reset()[1]["subtasks"]) == 2
    env.step(LEFT)
    assert env.step(LEFT)[-1]["subtasks"] == ("achieve c ensuring not b",)


def test_a_violated_task_terminates_without_reward() -> None:
    env = make(CORRIDOR, task="achieve b ensuring not a")
    env.reset()
    assert trace(env, [LEFT, LEFT]) == [(0.0, False, False, "running"), (0.0, True, False, "violated")]


def test_the_horizon_truncates_and_completion_comes_first() -> None:
    env = make(Corridor(starts=(2,), horizon=2), task="achieve b")
    env.reset()
    assert trace(env, [LEFT, RIGHT]) == [(0.0, False, False, "running"), (0.0, False, True, "running")]
    env.reset(options={"task": "achieve a"})
    assert trace(env, [LEFT, LEFT])[-1] == (1.0, True, False, "satisfied")


def test_an_environment_may_end_episodes_itself() -> None:
    env = make(Walk(low=-0.2, step_size=0.3, ends_outside=True), task="achieve a")
    env.reset()
    _, reward, terminated, truncated, info = env.step(np.array([-1.0, -1.0], np.float32))
    assert (reward, terminated, truncated, info["status"]) == (0.0, True, False, "running")


def test_a_task_stays_until_another_is_given() -> None:
    env = make(CORRIDOR, task="achieve a")
    assert env.reset()[1]["subtasks"] == ("achieve a",)
    assert env.reset(options={"task": "achieve b"})[1]["subtasks"] == ("achieve b",)
    assert env.reset(options={})[1]["subtasks"] == ("achieve b",)
    assert list(env.reset(options={"task": None})[1]) == ["labels"]
    env.step(LEFT)
    _, reward, terminated, truncated, info = env.step(LEFT)
    assert (reward, terminated, truncated, list(info)) == (0.0, False, False, ["labels"])


def test_a_refused_task_changes_nothing() -> None:
    env = make(CORRIDOR, task="achieve b")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="line 1"):
        env.reset(options={"task": "achieve z"})
    assert env.reset()[1]["subtasks"] == ("achieve b",)


def test_wrong_calls_are_refused() -> None:
    env = make(CORRIDOR)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(LEFT)
    for options, reason in (
        ({"tsak": "achieve a"}, r"'tsak', known are task, layout"),
        ({"task": 3}, "task of type int"),
        ({"layout": np.zeros((2, 2))}, "corridor expects int32"),
        ({"layout": CorridorLayout(np.int32(9))}, "start is 9"),
    ):
        with pytest.raises(ValueError, match=reason):
            env.reset(options=options)
    env.reset()
    for action in (2, -1, 0.5, [0]):
        with pytest.raises(ValueError, match=r"found .*action"):
            env.step(action)
    with pytest.raises(ValueError, match=r"without a task language.*hrlspec\.gymnasium\.make"):
        GymnasiumEnv(CORRIDOR, task="achieve a")
    with pytest.raises(ValueError, match=r"found sizes \(horizon\)"):
        make(CORRIDOR, horizon=3)


def test_a_nan_is_no_action() -> None:
    """It would stay in the state for ever. Numbers out of the box are actions, at its side."""
    for world in (Zone(physics="closed-form"), Walk()):
        single, vector = make(world), make_vec(world, 2)
        single.reset(seed=0)
        vector.reset(seed=0)
        with pytest.raises(ValueError, match=r"found action \[nan, 0.0\], expected numbers"):
            single.step(np.array([np.nan, 0.0], np.float32))
        with pytest.raises(ValueError, match=r"found action \[\[0.0, 0.0\], \[0.0, nan\]\], expected numbers"):
            vector.step(np.array([[0.0, 0.0], [0.0, np.nan]]))
    assert np.isfinite(single.step(np.array([3.0, -np.inf]))[0]).all()
    assert np.isfinite(vector.step(np.zeros((2, 2)))[0]).all()


def test_a_given_layout() -> None:
    observation, _ = make(WANDERING).reset(options={"layout": CorridorLayout(np.int32(3))})
    assert observation[-1].argmax() == 3
    layouts = CorridorLayout(np.array([3, 1], np.int32))
    observations, _ = make_vec(WANDERING, 2).reset(options={"layout": layouts})
    assert observations[:, -1].argmax(-1).tolist() == [3, 1]
    with pytest.raises(ValueError, match="2 layouts for 3 environments"):
        make_vec(WANDERING, 3).reset(options={"layout": layouts})


def test_seeds_decide_layouts() -> None:
    env = make(WANDERING)
    starts = [[int(env.reset(seed=seed)[0][-1].argmax()), int(env.reset()[0][-1].argmax())] for seed in range(20)]
    again = [[int(env.reset(seed=seed)[0][-1].argmax()), int(env.reset()[0][-1].argmax())] for seed in range(20)]
    assert starts == again
    assert set(np.ravel(starts)) == {1, 2, 3}


def test_a_vector_behaves_as_gymnasiums_own() -> None:
    """Every episode starts alike here, so that both can be compared across resets, infos included."""
    ours = make_vec(CORRIDOR, len(TASKS), task=TASKS)
    plain = SyncVectorEnv(
        [lambda task=task: make(CORRIDOR, task=task) for task in TASKS], autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert ours.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert (ours.observation_space, ours.action_space) == (plain.observation_space, plain.action_space)
    assert data_equivalence(ours.reset(seed=3), plain.reset(seed=3), exact=True)
    rng, ends = np.random.default_rng(0), np.zeros((2, len(TASKS)), int)
    for _ in range(60):
        actions = rng.choice([LEFT, RIGHT], len(TASKS), p=[0.4, 0.6])
        found, expected = ours.step(actions), plain.step(actions)
        assert data_equivalence(found, expected, exact=True)
        ends += np.stack([found[2], found[3]])
    assert ends.any(1).all()
    assert ends.sum() > 6


def test_a_vector_is_seeded_as_its_items() -> None:
    vector = make_vec(WANDERING, 5)
    single = make(WANDERING)
    for seed, seeds in ((7, range(7, 12)), ([9, 2, 9, 4, 1], [9, 2, 9, 4, 1])):
        observations, _ = vector.reset(seed=seed)
        assert data_equivalence(observations, np.stack([single.reset(seed=one)[0] for one in seeds]))
    first, second = vector.reset(seed=7)[0], vector.reset()[0]
    assert data_equivalence(vector.reset(seed=7)[0], first)
    assert data_equivalence(vector.reset()[0], second)


def test_auto_reset_draws_another_layout() -> None:
    env = GymnasiumVectorEnv(Letter(size=3, num_letters=2, num_cells=2, horizon=1), 8)
    before, _ = env.reset(seed=0)
    after, _, terminated, truncated, infos = env.step(np.zeros(8, int))
    assert truncated.all()
    assert not terminated.any()
    assert (before != after).any((1, 2, 3)).all()
    final = np.stack(infos["final_obs"])
    # A move up turns the torus around the agent.
    assert np.array_equal(final[..., :2], np.roll(before[..., :2], 1, axis=1))


def test_a_vector_refuses_what_does_not_fit() -> None:
    env = make_vec(CORRIDOR, 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, int))
    with pytest.raises(ValueError, match="3 tasks for 2 environments"):
        env.reset(options={"task": TASKS})
    with pytest.raises(ValueError, match="for some environments only"):
        env.reset(options={"task": [TASKS[0], None]})
    with pytest.raises(ValueError, match="1 seeds for 2 environments"):
        env.reset(seed=[1])
    with pytest.raises(ValueError, match="num_envs is 0"):
        make_vec(CORRIDOR, 0)
    env.reset()
    with pytest.raises(ValueError, match=r"shape \[3\], expected \[2\]"):
        env.step(np.zeros(3, int))


def test_another_task_compiles_nothing() -> None:
    env = make_vec(CORRIDOR, 3, task="achieve a")
    env.reset(seed=0)
    env.step(np.zeros(3, int))
    sizes = adapter._begin_all._cache_size(), adapter._step_all._cache_size()
    for task in (*TASKS, TASKS):
        env.reset(options={"task": task})
        env.step(np.zeros(3, int))
    assert (adapter._begin_all._cache_size(), adapter._step_all._cache_size()) == sizes


def test_gymnasiums_wrappers_count_returns() -> None:
    env = RecordEpisodeStatistics(make_vec(CORRIDOR, 2, task=["achieve a", "achieve b"]))
    env.reset()
    env.step(np.array([LEFT, RIGHT]))
    infos = env.step(np.array([LEFT, RIGHT]))[-1]
    assert infos["episode"]["r"].tolist() == [1.0, 1.0]
    assert infos["episode"]["l"].tolist() == [2, 2]


@pytest.fixture
def mine() -> Iterator[tuple[str, ...]]:
    names = hrlspec.gymnasium.register("mine")
    yield names
    for name in names:
        del gymnasium.registry[name]


def test_another_namespace(mine: tuple[str, ...]) -> None:
    assert "mine/letter-v0" in mine
    assert set(mine) <= set(gymnasium.registry)
    assert hrlspec.gymnasium.register("mine") == mine


def test_ids() -> None:
    """Known from the import on, also by the name of the module that registers them."""
    for name in ("hrlspec/walk-v0", "hrlspec.gymnasium:hrlspec/walk-v0"):
        assert gymnasium.make(name, task="achieve a", render_mode=None).reset(seed=0)[1]["subtasks"] == ("achieve a",)
    with pytest.raises(TypeError, match="found render_mode 'human', expected None"):
        gymnasium.make("hrlspec/walk-v0", render_mode="human")
    env = gymnasium.make("hrlspec/walk-v0", task="achieve a", horizon=30)
    check_env(env.unwrapped)
    assert env.reset(seed=0)[1]["subtasks"] == ("achieve a",)
    assert env.step(env.action_space.sample())[4]["status"] == "running"
    envs = gymnasium.make_vec("hrlspec/walk-v0", num_envs=2, task="achieve b", horizon=30)
    assert envs.reset(seed=0)[1]["subtasks"].tolist() == [("achieve b",)] * 2


def test_a_presets_name_is_enough() -> None:
    env = hrlspec.gymnasium.make("letter")
    env.reset(seed=0, options={"task": "achieve a; achieve b"})
    assert env.propositions == tuple("abcde")
    assert jax.tree.leaves(env.action_space.sample())[0] in range(4)


FORKS = """
import functools
import gymnasium, numpy as np
from jax._src.xla_bridge import backends_are_initialized
import hrlspec.gymnasium

hrlspec.gymnasium.make("zone")
hrlspec.gymnasium.make_vec("letter", 3, task=["achieve a", "achieve b", "achieve c; achieve d"])
make = functools.partial(hrlspec.gymnasium.make, "walk", task="achieve a")
envs = gymnasium.vector.AsyncVectorEnv([make] * 2, context="fork")
assert not backends_are_initialized()
assert envs.reset(seed=0)[1]["success"].tolist() == [False, False]
assert np.isfinite(envs.step(np.zeros((2, 2), np.float32))[0]).all()
envs.close()

make().reset()
envs = gymnasium.vector.AsyncVectorEnv([make], context="fork")
try:
    envs.reset()
except RuntimeError as error:
    assert "JAX had started in the process" in str(error), error
else:
    raise AssertionError("not refused")
envs.close()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_forks_work_before_jax_starts_and_are_refused_afterwards() -> None:
    script = [sys.executable, "-c", FORKS]
    ran = subprocess.run(script, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
