"""Training on probe corridors: what is learned, determinism, resuming, guards, and one compilation for all levels."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec import checkpoint
from hrlspec.agent.agent import Agent
from hrlspec.checkpoint.leaves import state_hash
from hrlspec.config import PPOConfig
from hrlspec.evaluation.episodes import run_episodes
from hrlspec.learning import ppo
from hrlspec.learning import train as training
from hrlspec.learning.rollout import Trajectory
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.spec import TaskTree, initial
from hrlspec.tasks.rewards import RewardMachine, reward_machine
from tests.probes import (
    Corridor,
    CorridorLayout,
    bank_of,
    on_device,
    probe_task,
    quick_jit,
    random_params,
    small_config,
)

# a at 0, b at 4, c at 5; episodes start at 1, 2 or 3.
ENV = Corridor()
CONFIG = small_config(
    network=dataclasses.replace(
        small_config().network,
        latent=32,
        encoder_mlp=(64,),
        planner_hidden=32,
        planner_features=32,
        critic=(64,),
        actor=(64,),
    )
)
TRAINER = Trainer(Agent(ENV, CONFIG))
GAMMA = CONFIG.discount
TASKS = ("a or b", "b or a", "achieve a", "a ensuring not b", "(a or b); c", "a; b", "a or b")
ITERATIONS = CONFIG.num_iterations
NOTHING_RESERVED = np.zeros(1, np.uint32)


def task(name: str) -> TaskTree:
    return probe_task(name, num_propositions=4, num_nodes=CONFIG.curriculum.max_nodes)


@functools.cache
def bank() -> TaskTree:
    rows = CONFIG.curriculum.tasks_per_level
    levels = [bank_of([task(name) for name in names], rows) for names in (TASKS[:4], TASKS[4:])]
    return on_device(jax.tree.map(lambda *x: np.concatenate(x), *levels))


def machine(completion: float = 1.0) -> RewardMachine:
    return reward_machine(ENV.propositions, completion=completion)


def fresh(seed: int = 0) -> TrainState:
    return init(jax.random.key(seed), bank(), machine())


init, step = quick_jit(TRAINER.init), quick_jit(TRAINER.iterate)


def iterate(state: TrainState, times: int, completion: float = 1.0) -> tuple[TrainState, list[dict[str, float]]]:
    history = []
    for _ in range(times):
        state, metrics = step(state, bank(), machine(completion), NOTHING_RESERVED)
        history.append(metrics)
    return state, [{name: float(value) for name, value in metrics.items()} for metrics in history]


@functools.cache
def trained() -> tuple[TrainState, list[dict[str, float]]]:
    return iterate(fresh(), ITERATIONS)


# --- One iteration ---


def test_two_runs_are_equal_to_the_bit() -> None:
    one, metrics = iterate(fresh(), 2)
    other, same = iterate(fresh(), 2)
    assert state_hash(one) == state_hash(other)
    assert metrics == same
    assert state_hash(iterate(fresh(1), 2)[0]) != state_hash(one)


def test_training_goes_on_from_a_checkpoint_as_if_nothing_had_happened(tmp_path: Any) -> None:
    straight, _ = iterate(fresh(), 4)
    half, _ = iterate(fresh(), 2)
    checkpoint.save(tmp_path, 2, half)
    target = jax.eval_shape(TRAINER.init, jax.random.key(9), bank(), machine())
    restored = checkpoint.load(tmp_path, target).state
    traces = step._cache_size()
    resumed, _ = iterate(restored, 2)
    assert state_hash(resumed) == state_hash(straight)
    assert step._cache_size() == traces


def test_nothing_compiles_again_across_levels() -> None:
    state, _ = iterate(fresh(), 1)
    traces = step._cache_size()
    ready = state.curriculum.replace(finished=jnp.int32(10_000), succeeded=jnp.int32(10_000))
    state, _ = iterate(state.replace(curriculum=ready), 1)
    assert int(state.curriculum.level) == 1
    state, history = iterate(state, 2)
    assert history[-1]["level"] == 2
    # The tasks of the new level have come in.
    assert np.asarray(state.tasks.depth).max() == 2
    assert step._cache_size() == traces


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_updates_that_are_not_finite_are_skipped_and_counted(bad: float) -> None:
    kept, _ = iterate(fresh(), 1)
    after, (metrics,) = iterate(kept, 1, completion=bad)
    assert metrics["successes"] > 0
    for name in ("controller", "planner"):
        assert metrics[f"{name}/skipped"] > 0
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((after.params[name], after.optimisers[name])))
    if np.isnan(bad):  # NaN is everywhere, infinity only where a task was completed
        for name in ("controller", "planner"):
            assert metrics[f"{name}/skipped"] == 1
            for part in ("params", "optimisers"):
                assert state_hash(getattr(after, part)[name]) == state_hash(getattr(kept, part)[name])
    assert int(after.iteration) == 2
    assert state_hash(after.params["reach_critic"]) != state_hash(kept.params["reach_critic"])


def test_metrics() -> None:
    _, history = iterate(fresh(), 3)
    for metrics in history:
        assert all(np.isfinite(value) for value in metrics.values())
        assert 0 <= metrics["successes"] <= metrics["episodes"]
        assert metrics["returns"] == metrics["successes"]  # reward set 1
    assert sum(metrics["episodes"] for metrics in history) > 50


def test_first_episodes_are_staggered() -> None:
    elapsed = np.asarray(fresh().collector.worker.env_state.time)
    assert len(set(elapsed.tolist())) > 4
    assert elapsed.min() >= 0
    assert elapsed.max() < ENV.horizon


def test_rows_that_do_not_divide_are_refused() -> None:
    config = dataclasses.replace(CONFIG, low=PPOConfig(minibatches=7))
    with pytest.raises(ValueError, match="48 rows do not divide into 7 minibatches"):
        jax.eval_shape(Trainer(Agent(ENV, config)).iterate, fresh(), bank(), machine(), NOTHING_RESERVED)


# --- What is learned ---


@pytest.mark.slow
def test_level_two_is_reached() -> None:
    state, history = trained()
    assert int(state.curriculum.level) == 1
    assert history[-1]["level"] == 2
    assert not any(value for metrics in history for name, value in metrics.items() if "skipped" in name)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "best"),
    [
        ("achieve a", {1: 1, 2: 2, 3: 3}),
        ("a ensuring not b", {1: 1, 2: 2, 3: 3}),
        ("a; b", {1: 5, 2: 6, 3: 7}),
        ("(a or b); c", {1: 4, 2: 3, 3: 2}),  # from 1 the nearest goal is the wrong one
    ],
)
def test_greedy_episodes_are_as_short_as_can_be(name: str, best: dict[int, int]) -> None:
    state, _ = trained()
    starts = np.array(list(best) * 2, np.int32)
    trees = bank_of([task(name)], len(starts))
    layouts = CorridorLayout(start=starts)
    agent = TRAINER.agent
    result = run_episodes(jax.random.key(0), agent, state.params, machine(), trees, layouts, greedy=True, shield=True)
    # With the shield, as collected: steps that it replaced are not the policy's, so beside a forbidden letter it learns
    # nothing of avoiding it.
    assert result.success.all()
    assert result.steps.tolist() == list(best.values()) * 2


@dataclasses.dataclass(frozen=True)
class Obedient(Agent):
    """Walks straight to what its sub-task reaches. A low level that learns may go elsewhere when that pays more."""

    def control(self, params: Any, view: Any, told: Any) -> tuple[jax.Array, jax.Array]:
        planes, here = view
        cells = jnp.arange(here.shape[0])
        right = (told.reach @ planes @ cells) > here @ cells
        return jnp.where(right, 10.0, -10.0) * jnp.array([-1.0, 1.0]), super().control(params, view, told)[1]


@functools.cache
def planner_trained() -> TrainState:
    """120 iterations with an obedient low level and no shield, so that only the planner's choice counts."""
    config = dataclasses.replace(
        CONFIG,
        shield=dataclasses.replace(CONFIG.shield, mode="off"),
        # Faster, and in half of the seeds the choice is made for good before it has learned to see the place.
        high=dataclasses.replace(CONFIG.high, learning_rate=1e-3),
    )
    trainer = Trainer(Obedient(ENV, config))
    state, step = quick_jit(trainer.init)(jax.random.key(0), bank(), machine()), quick_jit(trainer.iterate)
    for _ in range(120):
        state, _ = step(state, bank(), machine(), NOTHING_RESERVED)
    return state


@functools.cache
def planner_at(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities ``[3, N]`` and values ``[3]`` from cells 1, 2 and 3."""
    params, agent, tree = planner_trained().params, TRAINER.agent, on_device(task(name))

    def one(view: Any) -> Any:
        logits, value = agent.plan(params, view, tree, initial(tree), agent.instruct(params, tree))
        return jax.nn.softmax(logits), value

    return jax.tree.map(np.asarray, quick_jit(jax.vmap(one))(ENV.view_at(np.array([1, 2, 3]))))


def test_the_planner_picks_the_shorter_branch() -> None:
    for name, nearest in (("a or b", 1), ("b or a", 2)):
        chosen, _ = planner_at(name)
        assert chosen[0, nearest] > 0.8  # a is next to cell 1,
        assert chosen[2, 3 - nearest] > 0.8  # b to cell 3
    chosen, _ = planner_at("(a or b); c")
    assert (chosen[:, 2] > 0.8).all()  # b lies on the way to c


def test_the_planner_knows_the_values() -> None:
    """γ^(steps - 1), the return of the best branch."""
    np.testing.assert_allclose(planner_at("achieve a")[1], GAMMA ** np.array([0, 1, 2]), atol=0.12)
    np.testing.assert_allclose(planner_at("a or b")[1], GAMMA ** np.array([0, 1, 0]), atol=0.12)
    np.testing.assert_allclose(planner_at("(a or b); c")[1], GAMMA ** np.array([3, 2, 1]), atol=0.12)


@pytest.mark.slow
def test_the_low_level_knows_the_values() -> None:
    params, agent, tree = trained()[0].params, TRAINER.agent, on_device(task("a; b"))
    told = jax.tree.map(lambda x: x[1], agent.instruct(params, tree))
    _, values = quick_jit(jax.vmap(lambda view: agent.control(params, view, told)))(ENV.view_at(np.array([1, 2, 3])))
    np.testing.assert_allclose(values, GAMMA ** np.array([4, 5, 6]), atol=0.12)


def test_the_reach_critic_learns_the_distance() -> None:
    """V = discount^(steps - 1) of every letter from every cell, from random walks."""
    agent = TRAINER.agent
    settings, transform = PPOConfig(), ppo.optimiser(1.0)
    letters, distance = ENV.table[:, :3], np.zeros((len(ENV.cells), 3))
    for cell, letter in np.ndindex(distance.shape):
        there = int(np.flatnonzero(letters[:, letter])[0])
        at_wall = there in (0, len(ENV.cells) - 1)
        # Standing on it, it takes a step into the wall, or one away and one back.
        distance[cell, letter] = abs(there - cell) or (1 if at_wall else 2)
    rng = np.random.default_rng(0)
    blank = dict.fromkeys((field for field in Trajectory.__dataclass_fields__), None)

    def walk() -> Trajectory:
        action, here = rng.integers(2, size=(32, 16)), [rng.integers(len(ENV.cells), size=16)]
        for a in action:
            here.append(np.clip(here[-1] + 2 * a - 1, 0, len(ENV.cells) - 1))
        labels, view = ENV.table[np.stack(here[1:])], ENV.view_at(np.stack(here))
        return Trajectory(**{**blank, "labels": labels, "action": action, "view": view})

    @quick_jit
    def fit(params: Any, state: Any, walks: Trajectory) -> Any:
        def fit_one(carry: Any, trajectory: Trajectory) -> Any:
            params, state = carry
            values = jax.vmap(jax.vmap(lambda view: agent.reach_values({"reach_critic": params}, view).max(-1)))
            before, after = (jax.tree.map(lambda x, s=s: x[s], trajectory.view) for s in (slice(-1), slice(1, None)))
            trajectory = trajectory.replace(view=before, reach_value=values(after))
            batch = training.reach_batch(agent, trajectory)

            def loss(p: Any) -> Any:
                return training.reach_loss(agent, p, batch, settings, jnp.float32(0))

            params, state, metrics = ppo.gradient_step(loss, params, state, transform, jnp.float32(0.005))
            return (params, state), metrics["value_loss"]

        return jax.lax.scan(fit_one, (params, state), walks)

    walks = jax.tree.map(lambda *x: np.stack(x), *[walk() for _ in range(3000)])
    params = random_params(agent, 0)["reach_critic"]
    (params, _), losses = fit(params, transform.init(params), walks)
    values = jax.vmap(lambda view: agent.reach_values({"reach_critic": params}, view).max(-1))(
        ENV.view_at(np.arange(len(ENV.cells)))
    )
    np.testing.assert_allclose(np.asarray(values)[:, :3], CONFIG.shield.discount ** (distance - 1), atol=0.08)
    assert (np.asarray(values)[:, 3] < 0.3).all()  # there is no d
    assert losses[-1] < losses[0] / 5
