"""The five-tuple interface of gymnax, and the task language behind all adapters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax import Letter, Walk
from envs_jax.adapters.gymnax import GymnaxEnv
from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, tree_to_text
from hrlspec.tasks import rewards
from hrlspec.tasks.rewards import Bonus
from hrlspec.tasks.text_tasks import TextTasks
from tests.probes import Corridor, pairs, quick_jit, read_monitor
from tests.trees import random_tree

LEFT, RIGHT = 0, 1
CORRIDOR = Corridor(starts=(2,))
ENV = GymnaxEnv(CORRIDOR, TextTasks(CORRIDOR.propositions, 8), "achieve a")
reset, step = quick_jit(ENV.reset), quick_jit(ENV.step)


def test_what_it_says_of_itself() -> None:
    assert ENV.name == "corridor"
    assert ENV.num_actions == ENV.action_space(ENV.default_params).n == 2
    assert ENV.observation_space(ENV.default_params).shape == (5, 6)
    assert GymnaxEnv(Walk()).num_actions == 2
    assert hash(ENV) == hash(GymnaxEnv(CORRIDOR, TextTasks(CORRIDOR.propositions, 8), "achieve a"))


def test_an_episode_and_the_next() -> None:
    params = ENV.default_params
    first, state = reset(jax.random.key(0), params)
    observation, state, reward, done, info = step(jax.random.key(1), state, LEFT, params)
    assert (float(reward), bool(done), float(info["discount"])) == (0.0, False, 1.0)
    assert np.array_equal(observation, info["final_observation"])
    observation, state, reward, done, info = step(jax.random.key(2), state, LEFT, params)
    assert (float(reward), bool(done), float(info["discount"])) == (1.0, True, 0.0)
    assert (bool(info["terminated"]), bool(info["truncated"]), bool(info["success"])) == (True, False, True)
    assert info["final_observation"][-1].argmax() == 0
    assert info["labels"].tolist() == [True, False, False, False]
    assert np.array_equal(observation, first)
    # The task starts anew.
    for t, expected in enumerate((0.0, 1.0)):
        _, state, reward, _, _ = step(jax.random.key(3 + t), state, LEFT, params)
        assert float(reward) == expected


def test_the_horizon_is_done_but_bootstraps() -> None:
    params = ENV.default_params
    params = params.replace(env=params.env.replace(horizon=jnp.int32(1)))
    _, state = reset(jax.random.key(0), params)
    _, state, _, done, info = step(jax.random.key(1), state, RIGHT, params)
    assert (bool(done), bool(info["truncated"]), float(info["discount"])) == (True, True, 1.0)
    assert int(state.state.time) == 0


def test_without_a_task_nothing_is_paid() -> None:
    env = GymnaxEnv(CORRIDOR)
    _, state = env.reset(jax.random.key(0))
    for t in range(2):
        _, state, reward, done, info = env.step_env(jax.random.key(t), state, LEFT)
        assert (float(reward), bool(done), bool(info["success"])) == (0.0, False, False)
    with pytest.raises(ValueError, match="made without one"):
        env.params_for("achieve a")


def test_wrong_tasks_are_refused_when_made() -> None:
    with pytest.raises(ValueError, match="line 1"):
        GymnaxEnv(CORRIDOR, TextTasks(CORRIDOR.propositions), "achieve z")
    with pytest.raises(ValueError, match="without a task language"):
        GymnaxEnv(CORRIDOR, task="achieve a")
    with pytest.raises(ValueError, match="max_nodes is 8"):
        ENV.params_for("; ".join(["achieve a"] * 9))
    with pytest.raises(ValueError, match="bonus rule"):
        TextTasks(CORRIDOR.propositions, bonuses=(Bonus("a", "z", 1.0),))


def test_a_batch_of_tasks() -> None:
    texts = ("achieve a", "achieve b", "achieve c ensuring not b", "achieve b; achieve c")
    params = jax.tree.map(lambda *x: jnp.stack(x), *map(ENV.params_for, texts))
    keys = jax.random.split(jax.random.key(0), len(texts))

    def episode(key, params):
        def body(state, key):
            _, state, reward, done, info = ENV.step(key, state, RIGHT, params)
            return state, (reward, done, info["success"])

        return jax.lax.scan(body, ENV.reset(key, params)[1], jax.random.split(key, 3))[1]

    reward, done, success = quick_jit(jax.vmap(episode))(keys, params)
    assert reward.tolist() == [[0, 0, 0], [0, 1, 0], [0, 0, 0], [0, 0, 1]]
    assert done.tolist() == [[False] * 3, [False, True, False], [False, True, False], [False, False, True]]
    assert np.array_equal(success, reward > 0)


def test_an_ended_episode_goes_on_in_another_layout() -> None:
    env = GymnaxEnv(Letter(size=3, num_letters=2, num_cells=2, horizon=1))
    params = env.default_params
    keys = jax.random.split(jax.random.key(0), 16)
    _, before = quick_jit(jax.vmap(env.reset, (0, None)))(keys, params)
    _, after, _, done, _ = quick_jit(jax.vmap(env.step, (0, 0, None, None)))(keys, before, 0, params)
    assert done.all()
    assert (before.state.layout != after.state.layout).any((1, 2)).all()


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
def test_tasks_as_text_follow_monitor_and_reward_machine() -> None:
    """Against a plain reading, with rewards for sub-tasks and an order; an ended task pays nothing more."""
    names = tuple("abcd")
    tasks = TextTasks(names, 8, subtask=0.5, bonuses=(Bonus("a", "b", 2.0, ("c",)),))
    machine = rewards.reward_machine(names, subtask=0.5, bonuses=tasks.bonuses)
    advance, pay = quick_jit(tasks.advance), quick_jit(rewards.step)
    rng, ends = np.random.default_rng(0), {"running": 0, "satisfied": 0, "violated": 0}
    status_of = {RUNNING: "running", SATISFIED: "satisfied", VIOLATED: "violated"}
    for _ in range(20):
        text = tree_to_text(random_tree(rng, num_nodes=8, num_propositions=4, distinct=True), names)
        tree = jax.tree.map(np.asarray, tasks.read(text))
        progress, node, blocked, status = tasks.start(tasks.read(text)), 0, set(), "running"
        rules = rewards.initial(machine)
        for _ in range(8):
            labels = rng.random(4) < 0.3
            progress, verdict = advance(tree, progress, labels)
            before, was = node, status
            if was == "running":
                node, blocked, status = read_monitor(tree, node, blocked, pairs(labels), -1)
                completed = status == "satisfied"
                rules, reward = pay(machine, rules, labels, tree.reach[node], node != before, completed)
            assert float(verdict.reward) == (float(reward) if was == "running" else 0.0)
            assert (bool(verdict.ended), bool(verdict.success)) == (status != "running", status == "satisfied")
            shown = tasks.describe(text, jax.device_get(progress))
            assert (shown["node"], shown["status"]) == (node, status)
            assert shown["status"] == status_of[int(progress.task.status)]
            children = {k for k in range(8) if tree.valid[k] and tree.parent[k] == node} - blocked
            assert len(shown["subtasks"]) == (len(children) if status == "running" else 0)
        ends[status] += 1
    assert min(ends.values()) > 0
