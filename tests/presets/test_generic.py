"""Environments that nobody tuned: what their settings follow from, and the tasks that they are tested on."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
import pytest

from envs_jax import Letter, Walk
from envs_jax.rooms.world import Rooms
from hrlspec.agent.agent import Agent
from hrlspec.evaluation import Suite, suite_from_text
from hrlspec.presets import RECIPES, preset_for
from hrlspec.presets.generic import unseen_tasks
from hrlspec.presets.suite_rules import shortest
from hrlspec.spec import task_hashes
from hrlspec.tasks.bank import TaskBanks
from hrlspec.tasks.sampling import sample_trees
from tests.bare import Bare
from tests.probes import Corridor

SEED = 3


@functools.cache
def named(*names: str) -> Any:
    """An environment that is asked for nothing but its propositions."""

    @dataclasses.dataclass(frozen=True)
    class Named(Bare):
        propositions = names  # type: ignore[assignment]
        horizon = 100  # type: ignore[assignment]

    return Named(Letter())


@functools.cache
def texts_of(env: Any, seed: int = SEED) -> dict[str, str]:
    return unseen_tasks(env, seed)


def suite_of(env: Any) -> Suite:
    return suite_from_text("dag", texts_of(env)["dag"], env.propositions)


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("env", [Letter(), Walk(), Rooms(), Corridor()], ids=lambda env: env.name)
def test_settings_by_spaces(env: Any, recipe: Any) -> None:
    config, _ = preset_for(env).settings("ours", recipe)
    assert config.discount == pytest.approx(min(max(1 - 3 / env.horizon, 0.9), 0.998))
    assert config.curriculum.max_avoid <= max(0, env.num_propositions - 2)
    # Coloured noise and long rollouts are for continuous actions alone.
    small_steps = isinstance(env, Walk)
    assert (config.noise_correlation > 0) == small_steps
    assert (config.num_steps > 64) == small_steps


@pytest.mark.parametrize("recipe", ["paper", "hrlspec", pytest.param("planner", marks=pytest.mark.slow)])
@pytest.mark.parametrize("env", [Letter(), Letter(size=3, num_letters=2, num_cells=2), Rooms(), Corridor(), Walk()])
def test_networks_fit_what_is_seen(env: Any, recipe: Any) -> None:
    """Images of any size; a convolution of 2x2 takes a row and a column. The flat policy's are never seen by role."""
    for name in ("ours", "ltl2action"):
        config, method = preset_for(env).settings(name, recipe)
        params = jax.eval_shape(Agent(env, config, method).init, jax.random.key(0))
        assert all(leaf.size for leaf in jax.tree.leaves(params))
        leaves = jax.tree_util.tree_flatten_with_path(params["low"])[0]
        convolutions = sum("conv_" in str(path) and "bias" not in str(path) for path, _ in leaves)
        of_image = min(3, min(env.observation_shape[1:]) - 1) if len(env.observation_shape) == 3 else 0
        assert convolutions == (0 if recipe == "hrlspec" and name == "ours" else of_image)


@pytest.mark.parametrize(("number", "seed"), [(1, SEED), (2, 0), (2, 1), (2, 2), (3, SEED), (4, SEED)])
def test_whatever_is_held_out_every_level_can_be_drawn(number: int, seed: int) -> None:
    env = named(*"abcd"[:number])
    some = dataclasses.replace(preset_for(env), texts=texts_of(env, seed))
    for curriculum in {some.settings("ours", recipe)[0].curriculum for recipe in RECIPES}:
        bank = TaskBanks(0, curriculum, number, some.reserved).at(0)
        assert not np.isin(task_hashes(bank), some.reserved).any()


def test_with_many_propositions_there_are_200_tasks() -> None:
    suite = suite_of(named(*"abcde"))
    assert dict(zip(*np.unique(suite.depths, return_counts=True), strict=True)) == {2: 66, 3: 67, 4: 67}
    assert len(set(suite.hashes.tolist())) == 200
    assert (shortest(suite.trees) >= 2).all()


def test_with_two_at_most_a_quarter_of_what_there_is() -> None:
    """Branches alternate between the two, so that a task is two lengths, 0 for no branch, of which one is its depth."""
    suite = suite_of(named("left", "right"))
    for depth in (2, 3, 4):
        drawn = sample_trees(
            np.random.default_rng(1),
            num_tasks=500,
            num_propositions=2,
            max_nodes=16,
            min_depth=depth,
            max_depth=depth,
            max_branching=3,
        )
        there_are = len(set(task_hashes(drawn)[shortest(drawn) >= 2].tolist()))
        assert there_are == 2 * depth - 1
        assert (suite.depths == depth).sum() == there_are // 4


def test_with_one_the_only_task_is_not_held_out() -> None:
    env = named("goal")
    texts = texts_of(env)
    for name in ("dag", "dag_validation"):
        assert texts[name] == f"# bare letter/{name}: the only task there is, and so not unseen\nachieve goal\n"
    assert dataclasses.replace(preset_for(env), texts=texts).reserved.shape == (0,)
    assert preset_for(env).settings("ours")[0].curriculum.levels == 1


def test_validation_and_test_share_no_task() -> None:
    env = named(*"abcde")
    texts = texts_of(env)
    one, other = (suite_from_text(name, texts[name], env.propositions) for name in ("dag", "dag_validation"))
    assert (len(one), len(other)) == (200, 200)
    assert not np.isin(one.hashes, other.hashes).any()


def test_tasks_follow_the_seed() -> None:
    env = named("left", "right")
    assert unseen_tasks(env, SEED) == texts_of(env)
    assert unseen_tasks(env, SEED + 1) != texts_of(env)


@pytest.mark.slow
def test_what_cannot_be_done_in_time_is_left_out() -> None:
    """In Letter there is an exact solver. Four letters cannot be reached within three steps."""
    letter = Letter(size=4, num_letters=5, num_cells=5, horizon=3)
    assert shortest(suite_of(letter).trees).max() <= 3
    with pytest.raises(ValueError, match="none of 200 random tasks can be satisfied within 1 steps"):
        unseen_tasks(dataclasses.replace(letter, horizon=1), 0)
