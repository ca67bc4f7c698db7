"""JAX with 64-bit types, switched on by code that calls the library: everything is as without."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core

import envs_jax
from envs_jax.adapters.gymnax import GymnaxEnv
from envs_jax.rooms.world import Rooms
from envs_jax.zone import physics
from envs_jax.zone.world import Zone
from hrlspec.agent.agent import Agent
from hrlspec.config import CurriculumConfig
from hrlspec.evaluation.episodes import run_episodes
from hrlspec.learning.train import Trainer
from hrlspec.presets import preset
from hrlspec.spec import TaskTree
from hrlspec.tasks.rewards import reward_machine
from hrlspec.tasks.text_tasks import TextTasks
from tests.probes import Corridor, quick_jit, small_agent

WORLDS = {name: envs_jax.make(name) for name in envs_jax.registered() if not name.startswith("zone")}
WORLDS |= {"rooms": Rooms(), "zone in closed form": Zone(physics="closed-form")}
MJX = {name: envs_jax.make(name) for name in envs_jax.registered() if name.startswith("zone")}


def wide(jaxpr: Any) -> Iterator[str]:
    """Operations on arrays of 64-bit floats, or that draw 64 random bits; optax counts its steps in a number."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "random_bits" and equation.params["bit_width"] > 32:
            yield str(equation)
        if any(x.aval.dtype == jnp.float64 and x.aval.ndim for x in equation.outvars if hasattr(x.aval, "dtype")):
            yield str(equation)[:200]
        for value in equation.params.values():
            for inner in value if isinstance(value, tuple | list) else [value]:
                if isinstance(inner, core.ClosedJaxpr | core.Jaxpr):
                    yield from wide(getattr(inner, "jaxpr", inner))


def blank(config: CurriculumConfig, num_propositions: int) -> TaskTree:
    nodes = (config.levels * config.tasks_per_level, config.max_nodes)
    ints, bools = jax.ShapeDtypeStruct(nodes, jnp.int32), jax.ShapeDtypeStruct(nodes, bool)
    literals = jax.ShapeDtypeStruct((*nodes, num_propositions), bool)
    return TaskTree(parent=ints, reach=literals, avoid=literals, accepting=bools, valid=bools, depth=ints)  # type: ignore[arg-type]


def dtypes(tree: Any) -> Any:
    return jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree)


def trains_in_single_precision(agent: Agent, rewards: Any) -> None:
    """The program of an iteration, of which the annotations are checked while it is traced, too."""
    trainer, bank = Trainer(agent), blank(agent.config.curriculum, agent.env.num_propositions)
    state = jax.eval_shape(trainer.init, jax.random.key(0), bank, rewards)
    reserved = jax.ShapeDtypeStruct((3,), jnp.uint32)
    layout = jax.eval_shape(agent.env.sample_layout, jax.random.key(0), agent.env.default_params)
    layouts = jax.tree.map(lambda x: jax.ShapeDtypeStruct((bank.parent.shape[0], *x.shape), x.dtype), layout)
    evaluate = functools.partial(run_episodes, agent=agent, machine=rewards, chunk=bank.parent.shape[0])
    with jax.enable_x64(True):
        init, first = jax.make_jaxpr(trainer.init, return_shape=True)(jax.random.key(0), bank, rewards)
        iterate, (after, metrics) = jax.make_jaxpr(trainer.iterate, return_shape=True)(state, bank, rewards, reserved)
        episodes = jax.make_jaxpr(lambda *x: evaluate(x[0], params=x[1], tasks=x[2], layouts=x[3]))(
            jax.random.key(0), state.params, bank, layouts
        )
    assert dtypes(first) == dtypes(after) == dtypes(state)
    assert {str(x.dtype) for x in metrics.values()} == {"float32"}
    assert not [*wide(init.jaxpr), *wide(iterate.jaxpr), *wide(episodes.jaxpr)]


def test_an_iteration() -> None:
    trains_in_single_precision(small_agent(Corridor()), reward_machine(Corridor().propositions))


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["paper", "hrlspec"])
@pytest.mark.parametrize("method", ["ours", "option", "ltl2action"])
@pytest.mark.parametrize("name", ["letter", "walk", "zone"])
def test_an_iteration_of_the_presets(name: str, method: str, recipe: Any) -> None:
    world = preset(name)
    config, chosen = world.settings(method, recipe, 2)
    trains_in_single_precision(Agent(world.make(), config, chosen), world.rewards(2))


@pytest.mark.parametrize(
    "env",
    [
        *(pytest.param(env, id=name) for name, env in WORLDS.items()),
        *(pytest.param(env, id=name, marks=pytest.mark.slow) for name, env in MJX.items()),
    ],
)
def test_worlds_are_as_without(env: envs_jax.Environment) -> None:
    """Layouts, observations and what a step leads to; in the types that the spaces say, from actions of any."""
    params, action = env.default_params, np.zeros(env.action_space.shape) + 0.3

    def episode(key: jax.Array, action: Any) -> Any:
        observation, state = env.reset(key, params)
        native = action if env.action_space.shape else action.astype(jnp.int32)
        return observation, env.step(key, state, native, params), env.labels(state, params)

    without = quick_jit(episode)(jax.random.key(3), action)
    with jax.enable_x64(True):
        within = quick_jit(episode)(jax.random.key(3), action)
    assert within[0].dtype == np.float32
    assert dtypes(within) == dtypes(without)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=5e-3), within, without)


def test_layouts_that_are_contested_are_as_without() -> None:
    for env in (envs_jax.make("letter", size=5), Zone()):
        first, second = np.eye(env.num_propositions, dtype=bool)[:2]
        draw = quick_jit(env.contested_layout)
        without = draw(jax.random.key(1), first, second, env.default_params)
        with jax.enable_x64(True):
            within = draw(jax.random.key(1), first, second, env.default_params)
        assert dtypes(within) == dtypes(without)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), within, without)


def test_physics_are_of_the_bodys_precision() -> None:
    """MJX makes arrays of the default type; the model and its program are none the less of single precision."""
    body, control = jax.ShapeDtypeStruct((6,), jnp.float32), jax.ShapeDtypeStruct((2,), jnp.float32)
    with jax.enable_x64(True):
        physics._mjx_model.cache_clear()
        physics._mjx_programs.cache_clear()
        program, after = jax.make_jaxpr(physics.step_function("mjx"), return_shape=True)(body, control)
    assert dtypes(after) == (((6,), "float32"), ((12,), "float32"))
    assert not [*wide(program.jaxpr)]


def test_adapters_pay_in_single_precision() -> None:
    env = GymnaxEnv(Corridor(), TextTasks(Corridor().propositions, 8), "achieve a")
    with jax.enable_x64(True):
        _, state = jax.eval_shape(env.reset, jax.random.key(0), env.default_params)
        observation, after, reward, _, info = jax.eval_shape(env.step, jax.random.key(0), state, 0, env.default_params)
    assert {str(x.dtype) for x in (observation, reward, info["discount"])} == {"float32"}
    assert dtypes(after) == dtypes(state)
