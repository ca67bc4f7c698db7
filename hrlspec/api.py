"""Entry points of the library: `train` an agent, or take a `pretrained` one, and `evaluate` it.

What they call can be used by itself.

Axes: **S** seeds trained in parallel.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Key, Shaped, UInt32

from envs_jax import Environment
from envs_jax.arrays import Array
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.agent.method import Method
from hrlspec.agent_files import read_agent, read_params
from hrlspec.config import evolve
from hrlspec.evaluation import Suite, SuiteResult, evaluate_suite, suite_from_text
from hrlspec.learning.seeds import Seeds
from hrlspec.learning.train import Trainer
from hrlspec.presets import Preset, Recipe, RewardSet, preset, preset_for
from hrlspec.tasks.bank import TaskBanks, joint_labels, seed_of
from hrlspec.tasks.rewards import RewardMachine

Progress = Callable[[int, Mapping[str, Shaped[np.ndarray, "..."]]], object]
"""Called after each iteration with the environment steps done and its metrics, float32 ``[]``, or ``[S]``."""


@dataclasses.dataclass(frozen=True)
class TrainedAgent:
    """An agent with parameters.

    Attributes:
        agent: environment, settings and method.
        params: parameters, leading axis S where S seeds were trained in parallel.
        rewards: the reward machine it was trained with.
    """

    agent: Agent
    params: Params
    rewards: RewardMachine

    def __getitem__(self, seed: int) -> TrainedAgent:
        """One of S agents trained in parallel."""
        return dataclasses.replace(self, params=jax.tree.map(lambda x: x[seed], self.params))


def train(
    key: Key[Array, "*S"],
    env: str | Environment,
    *,
    total_steps: int | None = None,
    method: str | Method = "ours",
    recipe: Recipe = "hrlspec",
    reward_set: RewardSet = 1,
    changes: Mapping[str, Any] | None = None,
    held_out: Suite | None = None,
    progress: Progress | None = None,
) -> TrainedAgent:
    """Trains an agent on a curriculum of random tasks (paper, "Algorithm").

    Args:
        key: one key, or S keys for S agents trained side by side, at once or, on a CPU, by turns; each with the result
            of training alone.
        env: the name of a preset, or any environment; its settings are then chosen by its spaces.
        total_steps: environment steps for each agent; the preset's if not given.
        method: one of `hrlspec.methods.METHODS` by name, or a value of a `hrlspec.methods.Method`.
        recipe: ``paper``, the paper's method; ``planner``, the same, but that the planner is asked about every path; or
            ``hrlspec``, what measured better.
        reward_set: 1, for completing the task, or 2, also for sub-tasks and for some orders of them.
        changes: shared settings to change, by dotted names such as ``{"low.optimiser.learning_rate": 1e-3}``.
        held_out: tasks that must not be trained on, besides the preset's test suites.
        progress: called after each iteration; blocks until the iteration's metrics are computed.

    Raises:
        ValueError: there is no such preset or method, or no training task can be drawn.
        ConfigError: a setting cannot be meant.
    """
    world = preset(env) if isinstance(env, str) else preset_for(env)
    config, chosen = world.settings(method, recipe, reward_set)
    config = evolve(config, {**(changes or {}), **({} if total_steps is None else {"total_steps": total_steps})})
    agent, machine = Agent(world.make(), config, chosen), world.rewards(reward_set)
    reserved, given = _reserved(world, held_out), world.collected_tasks(config.curriculum.max_nodes)
    together = joint_labels(agent.env, config.curriculum)
    banks = [
        TaskBanks(seed_of(one), config.curriculum, agent.env.num_propositions, reserved, given, together)
        for one in jnp.atleast_1d(key)
    ]
    return TrainedAgent(agent, _params(key, Trainer(agent), machine, banks, reserved, progress), machine)


def pretrained(name: str | os.PathLike[str]) -> TrainedAgent:
    """An agent that was trained before, from a file; nothing in it is executed.

    Args:
        name: of an agent that comes along, such as ``letter``; or the path of a ``.safetensors`` file that ``hrlspec
            export`` wrote, with its card beside it.

    Raises:
        AgentFileError: there is none, or file, card and this version do not fit each other.
        ImportError: the extra ``files`` is missing, or a library that the environment needs.
    """
    file = read_agent(name)
    return TrainedAgent(file.agent, read_params(file), file.rewards)


def evaluate(
    key: Key[Array, ""],
    trained: TrainedAgent,
    tasks: str | Suite,
    *,
    episodes: int = 500,
    seed: int = 0,
    greedy: bool = False,
    shield: bool = False,
) -> SuiteResult:
    """Evaluates a trained agent on tasks in random layouts.

    Args:
        key: of the agent's and the environment's randomness; consumed.
        trained: one agent.
        tasks: SPECTRL, one formula a line, or a suite.
        episodes: in all; at least one for each task.
        seed: of the layouts.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.

    Raises:
        SpecError: a task cannot be read.
        ValueError: a task cannot be satisfied in (nearly) any layout; or a shield is asked for, and the agent has no
            reach critic, since it was trained without one.
    """
    agent = trained.agent
    suite = suite_from_text("tasks", tasks, agent.env.propositions) if isinstance(tasks, str) else tasks
    return evaluate_suite(
        key,
        agent,
        trained.params,
        trained.rewards,
        suite,
        layouts_per_task=-(-episodes // len(suite)),
        seed=seed,
        greedy=greedy,
        shield=shield,
    )


def _params(
    key: Key[Array, "*S"],
    trainer: Trainer,
    machine: RewardMachine,
    banks: Sequence[TaskBanks],
    reserved: UInt32[np.ndarray, " _"],
    progress: Progress | None,
) -> Params:
    """Parameters after all iterations, for one key or S keys, each with its banks."""
    config, held_out = trainer.agent.config, jnp.asarray(reserved)
    states = [trainer.init(one, some.at(0), machine) for one, some in zip(jnp.atleast_1d(key), banks, strict=True)]
    several = Seeds(trainer, len(states)) if key.ndim else None
    held_out = held_out if several is None else jnp.stack([held_out] * several.number)
    state = states[0] if several is None else several.join(states)
    del states  # donated
    for i in range(config.num_iterations):
        bank = [some.at(i) for some in banks]
        if several is None:
            state, metrics = trainer.iterate(state, bank[0], machine, held_out)
        else:
            each = jax.tree.map(lambda *x: jnp.stack(x), *bank)
            state, metrics = several.iterate(state, each, machine, held_out)
        if progress is not None:
            progress((i + 1) * config.steps_per_iteration, jax.device_get(metrics))
    params: Params = state.params
    return params


def _reserved(world: Preset, held_out: Suite | None) -> UInt32[np.ndarray, " _"]:
    """Sorted hashes of tasks that training must not see, uint32."""
    return world.reserved if held_out is None else np.union1d(world.reserved, held_out.hashes)
