"""Every preset trains by every recipe and method: shapes and types of a whole iteration, without computing it.

The annotations are checked while the functions are traced (see `tests.typecheck`).
"""

from __future__ import annotations

from typing import Any, get_args

import jax
import jax.numpy as jnp
import pytest

from hrlspec.agent.agent import Agent
from hrlspec.config import CurriculumConfig
from hrlspec.learning.train import Trainer
from hrlspec.methods import METHODS
from hrlspec.presets import PRESETS, Recipe, preset
from hrlspec.spec import TaskTree

QUICK = {("letter", "hrlspec", "ltl2action"), ("walk", "planner", "myopic-low"), ("zone", "paper", "option")}
"""Every recipe, world and method once, but for ours, with or without relabelled experience: others train by these."""
CASES = [
    pytest.param(name, recipe, method, marks=() if (name, recipe, method) in QUICK else pytest.mark.slow)
    for name in PRESETS
    for recipe in get_args(Recipe)
    for method in METHODS
]
"""Tracing one takes seconds, so that most are left to a run of the slow tests."""


@pytest.mark.parametrize(("name", "recipe", "method"), CASES)
def test_an_iteration_of_every_preset_recipe_and_method_has_its_shapes(name: str, recipe: Recipe, method: str) -> None:
    if name.startswith("zone"):
        pytest.importorskip("mujoco.mjx")
    world = preset(name)
    config, chosen = world.settings(method, recipe, 2)
    trainer, machine = Trainer(Agent(world.make(), config, chosen)), world.rewards(2)
    bank = _blank(config.curriculum, trainer.agent.env.num_propositions)
    state = jax.eval_shape(trainer.init, jax.random.key(0), bank, machine)
    reserved = jax.ShapeDtypeStruct((3,), jnp.uint32)
    after, metrics = jax.eval_shape(trainer.iterate, state, bank, machine, reserved)
    assert jax.tree.map(_kind, after) == jax.tree.map(_kind, state)
    assert {metric.shape for metric in metrics.values()} == {()}


def _kind(x: jax.ShapeDtypeStruct) -> tuple[Any, Any, bool]:
    """All that a compiled program depends on: were the weak type another one, the second iteration would compile."""
    return x.shape, x.dtype, x.weak_type


def _blank(config: CurriculumConfig, num_propositions: int) -> TaskTree:
    """A bank of training tasks, of which nothing but shapes and types is read."""
    nodes = (config.levels * config.tasks_per_level, config.max_nodes)
    return TaskTree(
        parent=jnp.zeros(nodes, jnp.int32),
        reach=jnp.zeros((*nodes, num_propositions), bool),
        avoid=jnp.zeros((*nodes, num_propositions), bool),
        accepting=jnp.zeros(nodes, bool),
        valid=jnp.zeros(nodes, bool),
        depth=jnp.zeros(nodes, jnp.int32),
    )
