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
from hrlspec.agent.low_level import LowLevel, Params
from hrlspec.checkpoint.leaves import state_hash
from hrlspec.config import ConfigError, OptimiserConfig, PPOConfig, evolve
from hrlspec.evaluation.episodes import run_episodes
from hrlspec.learning.optimiser import gradient_step, optimiser
from hrlspec.learning.reach import ReachBatch, reach_loss
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.methods import Ours
from hrlspec.spec import TaskTree, initial
from hrlspec.tasks.rewards import RewardMachine, reward_machine
from tests.probes import (
    CORRIDOR_CONFIG,
    CORRIDOR_HELD_OUT,
    Corridor,
    CorridorLayout,
    bank_of,
    on_device,
    probe_task,
    quick_jit,
    random_params,
    small_agent,
    small_config,
    small_planner,
)

# a at 0, b at 4, c at 5; episodes start at 1, 2 or 3.
ENV = Corridor()
CONFIG = small_config(
    total_steps=120 * 32 * 24,
    network=dataclasses.replace(small_config().network, latent=32, encoder_mlp=(64,), critic=(64,), actor=(64,)),
)
TRAINER = Trainer(small_agent(ENV, CONFIG, network__hidden=32, network__features=32))
QUICK = Trainer(small_agent(ENV, CORRIDOR_CONFIG))
"""For what does not depend on how much is learned: the same program as the API's tests train with."""
GAMMA = CONFIG.discount
TASKS = ("a or b", "b or a", "achieve a", "a ensuring not b", "(a or b); c", "a; b", "a or b")
NOTHING_RESERVED = np.zeros(len(CORRIDOR_HELD_OUT), np.uint32)


def task(name: str) -> TaskTree:
    return probe_task(name, num_propositions=4, num_nodes=CONFIG.curriculum.max_nodes)


@functools.cache
def bank() -> TaskTree:
    rows = CONFIG.curriculum.tasks_per_level
    levels = [bank_of([task(name) for name in names], rows) for names in (TASKS[:4], TASKS[4:])]
    return on_device(jax.tree.map(lambda *x: np.concatenate(x), *levels))


def machine(completion: float = 1.0) -> RewardMachine:
    return reward_machine(ENV.propositions, completion=completion)


def fresh(seed: int = 0, trainer: Trainer = QUICK) -> TrainState:
    return trainer.init(jax.random.key(seed), bank(), machine())


def iterate(
    state: TrainState, times: int, completion: float = 1.0, trainer: Trainer = QUICK
) -> tuple[TrainState, list[dict[str, float]]]:
    state, history = jax.tree.map(jnp.copy, state), []  # which an iteration uses up
    for _ in range(times):
        state, metrics = trainer.iterate(state, bank(), machine(completion), NOTHING_RESERVED)
        history.append(metrics)
    return state, [{name: float(value) for name, value in metrics.items()} for metrics in history]


@functools.cache
def trained() -> tuple[TrainState, list[dict[str, float]]]:
    return iterate(fresh(trainer=TRAINER), CONFIG.num_iterations, trainer=TRAINER)


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
    target = jax.eval_shape(QUICK.init, jax.random.key(9), bank(), machine())
    restored = checkpoint.load(tmp_path, target).state
    traces = Trainer.iterate._cache_size()
    resumed, _ = iterate(restored, 2)
    assert state_hash(resumed) == state_hash(straight)
    assert Trainer.iterate._cache_size() == traces


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_updates_that_are_not_finite_are_skipped_and_counted(bad: float) -> None:
    kept, _ = iterate(fresh(), 1)
    after, (metrics,) = iterate(kept, 1, completion=bad)
    assert metrics["successes"] > 0
    for name in ("low", "high"):
        assert metrics[f"{name}/skipped"] > 0
        assert all(np.isfinite(x).all() for x in jax.tree.leaves((after.params[name], after.optimisers[name])))
    if np.isnan(bad):  # NaN is everywhere, infinity only where a task was completed
        for name in ("low", "high"):
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
    with pytest.raises(ConfigError, match="minibatches is 7, expected a divisor of 48"):
        evolve(CONFIG, {"low.optimiser.minibatches": 7})
    with pytest.raises(ConfigError, match="minibatches is 7, expected a divisor of 192"):
        small_agent(ENV, CONFIG, ppo__optimiser__minibatches=7)


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
class ObedientLow(LowLevel):
    """Walks straight to what its sub-task reaches. A low level that learns may go elsewhere when that pays more."""

    def control(self, params: Any, view: Any, instruction: Any) -> tuple[jax.Array, jax.Array]:
        planes, here = view
        cells = jnp.arange(here.shape[0])
        right = (instruction.reach @ planes @ cells) > here @ cells
        return jnp.where(right, 10.0, -10.0) * jnp.array([-1.0, 1.0]), super().control(params, view, instruction)[1]


@dataclasses.dataclass(frozen=True)
class Obedient(Agent):
    """An agent whose low level does as it is told."""

    @functools.cached_property
    def low(self) -> LowLevel:
        return ObedientLow(self.env, self.config, self.method.sees, self.high.follows_plan)


# Only the planner's choice counts: no shield, and what the low level would learn is not used. Many decisions in each
# iteration and much randomness at first: with less of either some seeds choose for good before they have learned to see
# the place.
PLANNER_CONFIG = evolve(
    CONFIG,
    {
        "total_steps": 80 * CONFIG.num_envs * CONFIG.num_steps,
        "discount": 0.8,
        "group": CONFIG.num_envs,
        "shield.enabled": False,
        "relabel.share": 0.0,
        "low": PPOConfig(optimiser=OptimiserConfig(learning_rate=0.0, epochs=1, minibatches=1)),
        "network": dataclasses.replace(
            CONFIG.network, latent=16, encoder_mlp=(32,), task_features=4, critic=(4,), actor=(4,)
        ),
    },
)
PLANNER = small_planner(
    network__hidden=32,
    network__features=16,
    steps_per_sample=2,
    ppo__optimiser__learning_rate=3e-3,
    ppo__optimiser__minibatches=4,
    ppo__entropy=1.0,
)
SEQUENCES = ("achieve a", "achieve b", "a ensuring not b", "b ensuring not a")
PLANNERS = {"policy": PLANNER, "paths": evolve(PLANNER, {"values_paths": True})}
LESSONS = {"policy": (TASKS[:4], TASKS[4:]), "paths": (SEQUENCES, tuple(f"({text}); c" for text in SEQUENCES))}
"""One that values paths learns from sequences alone, which leave nothing to choose."""


@functools.cache
def planner_trained(kind: str, seed: int = 0) -> tuple[Params, Agent]:
    """With an obedient low level."""
    trainer = Trainer(Obedient(ENV, PLANNER_CONFIG, Ours(high=PLANNERS[kind])))
    levels = [bank_of([task(name) for name in names], CONFIG.curriculum.tasks_per_level) for names in LESSONS[kind]]
    lessons = on_device(jax.tree.map(lambda *x: np.concatenate(x), *levels))
    state = quick_jit(trainer.init)(jax.random.key(seed), lessons, machine())
    step = quick_jit(trainer.iterate)
    for _ in range(PLANNER_CONFIG.num_iterations):
        state, _ = step(state, lessons, machine(), NOTHING_RESERVED)
    return state.params, trainer.agent


@functools.cache
def planner_at(name: str, kind: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities ``[3, N]`` and values ``[3]`` from cells 1, 2 and 3."""
    params, agent = planner_trained(kind, seed)
    tree = on_device(task(name))

    @quick_jit
    def plan(views: Any) -> Any:
        alike = (tree, initial(tree), agent.low.instruct(params, tree))
        alike = jax.tree.map(lambda x: jnp.stack([x] * 3), alike)
        choice = agent.high.choose(agent.low, params, views, *alike)
        return jax.nn.softmax(choice.logits), choice.value

    return jax.tree.map(np.asarray, plan(ENV.view_at(np.array([1, 2, 3]))))


@pytest.mark.slow
@pytest.mark.parametrize("kind", PLANNERS)
def test_the_planner_picks_the_shorter_branch(kind: str) -> None:
    # The smallest of the seven, over 20 seeds at three instruction sets: 0.949 ± 0.032 (standard deviation), never
    # below 0.75.
    least = 0.6
    for name, nearest in (("a or b", 1), ("b or a", 2)):
        chosen, _ = planner_at(name, kind)
        assert chosen[0, nearest] > least  # a is next to cell 1,
        assert chosen[2, 3 - nearest] > least  # b to cell 3
    chosen, _ = planner_at("(a or b); c", kind)
    assert (chosen[:, 2] > least).all()  # b lies on the way to c


@pytest.mark.slow
@pytest.mark.parametrize("kind", PLANNERS)
def test_the_planner_knows_the_values(kind: str) -> None:
    """γ^(steps - 1), the return of the best branch."""
    # The largest error, over 20 seeds at three instruction sets: 0.034 ± 0.020, at most 0.094.
    for name, others in (("achieve a", [0, 1, 2]), ("a or b", [0, 1, 0]), ("(a or b); c", [3, 2, 1])):
        np.testing.assert_allclose(planner_at(name, kind)[1], PLANNER_CONFIG.discount ** np.array(others), atol=0.15)


@pytest.mark.slow
def test_the_low_level_knows_the_values() -> None:
    params, agent, tree = trained()[0].params, TRAINER.agent, on_device(task("a; b"))
    instruction = jax.tree.map(lambda x: x[1], agent.low.instruct(params, tree))
    _, values = quick_jit(jax.vmap(lambda view: agent.low.control(params, view, instruction)))(
        ENV.view_at(np.array([1, 2, 3]))
    )
    np.testing.assert_allclose(values, GAMMA ** np.array([4, 5, 6]), atol=0.05)


def test_the_reach_critic_learns_the_distance() -> None:
    """V = discount^(steps - 1) of every letter from every cell, from all steps that there are."""
    low = TRAINER.agent.low
    num_cells = len(ENV.cells)
    letters, distance = ENV.table[:, :3], np.zeros((num_cells, 3))
    for cell, letter in np.ndindex(distance.shape):
        there = int(np.flatnonzero(letters[:, letter])[0])
        at_wall = there in (0, num_cells - 1)
        # Standing on it, it takes a step into the wall, or one away and one back.
        distance[cell, letter] = abs(there - cell) or (1 if at_wall else 2)
    here, action = np.indices((num_cells, 2), np.int32).reshape(2, 1, -1)
    there = np.clip(here + 2 * action - 1, 0, num_cells - 1)
    before, after = ENV.view_at(here), ENV.view_at(there)
    transform, num_updates = optimiser(CONFIG.shield.optimiser), 2000

    def best(params: Any, view: Any) -> jax.Array:
        return low.reach_values({"reach_critic": params}, view).max(-1)

    @quick_jit
    def fit(params: Any) -> Any:
        def update(carry: Any, share_done: jax.Array) -> Any:
            params, state = carry
            ahead = jax.vmap(jax.vmap(functools.partial(best, params)))(after)
            target = jnp.where(ENV.table[there], 1.0, CONFIG.shield.discount * ahead)
            batch = ReachBatch(before, jnp.asarray(action), target)

            def loss(p: Any) -> Any:
                return reach_loss(low, p, batch)

            rate = 0.02 * (1 - share_done)
            return gradient_step(jax.value_and_grad(loss, has_aux=True), params, state, transform, rate)[:2], None

        (params, _), _ = jax.lax.scan(update, (params, transform.init(params)), jnp.arange(num_updates) / num_updates)
        return jax.vmap(functools.partial(best, params))(ENV.view_at(np.arange(num_cells)))

    values = np.asarray(fit(random_params(TRAINER.agent, 0)["reach_critic"]))
    # The largest error, over 20 draws of the parameters: 0.007 ± 0.002 (standard deviation), at most 0.014.
    np.testing.assert_allclose(values[:, :3], CONFIG.shield.discount ** (distance - 1), atol=0.03)
    assert (values[:, 3] < 0.03).all()  # there is no d
