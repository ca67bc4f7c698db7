"""Evaluating an agent: on suites, on return over optimum, on contested choices, and the paper's protocol.

An evaluation is prepared once (layouts drawn, optima solved) and then called with any parameters; the rollout is
compiled on the first call and never again, since its shapes do not change.

Axes: **M** tasks, **B** episodes.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Key

from envs_jax import Environment
from envs_jax.arrays import Array
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.evaluation.cases import LAYOUTS_PER_TASK, BranchCases, Cases, make_branch_cases, make_cases
from hrlspec.evaluation.episodes import run_episodes, trace_episodes
from hrlspec.evaluation.results import ChoiceResult, ReturnResult, SuiteResult
from hrlspec.evaluation.scoring import score_choices, score_returns, score_suite
from hrlspec.evaluation.suite import Suite
from hrlspec.exact.contested import ContestedSuite, chosen_instances, contested_suite
from hrlspec.spec import TaskTree
from hrlspec.tasks.rewards import RewardMachine

CHUNK = 500
"""Default for the number of episodes run in parallel."""


@dataclasses.dataclass(frozen=True)
class SuiteEvaluation:
    """Runs one episode per case; call it.

    Attributes:
        cases: tasks in layouts.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.
        chunk: episodes run in parallel; bounds memory.
    """

    cases: Cases
    greedy: bool = False
    shield: bool = False
    chunk: int = CHUNK

    def __call__(self, key: Key[Array, ""], agent: Agent, params: Params, machine: RewardMachine) -> SuiteResult:
        """Scores an agent. The key is consumed."""
        how: dict[str, Any] = {"greedy": self.greedy, "shield": self.shield}
        cases = self.cases
        episodes = run_episodes(
            key, agent, params, machine, cases.trees, cases.layouts, chunk=_even(len(cases), self.chunk), **how
        )
        return score_suite(cases, jax.device_get(episodes), machine, horizon=agent.env.horizon, **how)


@dataclasses.dataclass(frozen=True)
class ReturnEvaluation:
    """Return over optimum; call it. Prepare the cases with the same rewards that it is called with.

    Attributes:
        cases: tasks in layouts where the branch matters.
        greedy: take the most likely action and sub-task instead of sampling.
        chunk: episodes run in parallel; bounds memory.
    """

    cases: BranchCases
    greedy: bool = False
    chunk: int = CHUNK

    def __call__(self, key: Key[Array, ""], agent: Agent, params: Params, machine: RewardMachine) -> ReturnResult:
        """Scores an agent. The key is consumed."""
        cases = self.cases
        episodes = run_episodes(
            key,
            agent,
            params,
            machine,
            cases.trees,
            cases.layouts,
            greedy=self.greedy,
            chunk=_even(len(cases), self.chunk),
        )
        return score_returns(cases, jax.device_get(episodes), machine, greedy=self.greedy)


@dataclasses.dataclass(frozen=True)
class ChoiceEvaluation:
    """Contested choice; call it.

    Attributes:
        suite: the cases.
        greedy: take the most likely action and sub-task instead of sampling.
    """

    suite: ContestedSuite
    greedy: bool = False

    def __call__(self, key: Key[Array, ""], agent: Agent, params: Params, machine: RewardMachine) -> ChoiceResult:
        """Scores an agent. The key is consumed."""
        suite = self.suite
        traced = trace_episodes(key, agent, params, machine, suite.tasks, suite.layouts, greedy=self.greedy)
        episodes, trace = jax.device_get(traced)
        # Entry t of a trace is the state before step t, so the first one away from the root is where the edge led.
        away = trace.running & (trace.node != TaskTree.ROOT)
        there = jax.tree.map(lambda x: x[away.argmax(0), np.arange(x.shape[1])], trace.env_state)
        place = chosen_instances(agent.env, there, np.asarray(suite.tasks.reach[:, 1]))
        return score_choices(suite, np.asarray(episodes.success), np.where(away.any(0), place, -1), greedy=self.greedy)


def evaluate_suite(
    key: Key[Array, ""],
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    suite: Suite,
    *,
    layouts_per_task: int = LAYOUTS_PER_TASK,
    seed: int = 0,
    greedy: bool = False,
    shield: bool = False,
    chunk: int = CHUNK,
) -> SuiteResult:
    """Success, violations, return, steps and SPL on a suite, in layouts that depend on ``seed`` alone.

    Args:
        key: of the agent's and the environment's randomness; consumed.
        agent: the networks.
        params: their parameters.
        machine: the rewards.
        suite: M tasks.
        layouts_per_task: episodes of each task, each in a layout of its own.
        seed: of the layouts.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.
        chunk: episodes run in parallel; bounds memory.

    Raises:
        ValueError: if a task cannot be satisfied in (nearly) any layout.
    """
    cases = make_cases(agent.env, suite, layouts_per_task=layouts_per_task, seed=seed)
    return SuiteEvaluation(cases, greedy, shield, chunk)(key, agent, params, machine)


def periodic_evaluation(
    env: Environment, suite: Suite, *, num_tasks: int = 10, episodes: int = 100, seed: int = 0, greedy: bool = False
) -> SuiteEvaluation:
    """The paper's evaluation during training: 10 random unseen tasks, 100 episodes in all.

    Args:
        env: the environment.
        suite: unseen tasks to draw from.
        num_tasks: how many are drawn, at most M.
        episodes: in all, a multiple of the number of tasks drawn.
        seed: of tasks and layouts, which stay the same throughout.
        greedy: take the most likely action and sub-task instead of sampling.

    Raises:
        ValueError: if ``episodes`` cannot be spread evenly.
    """
    num_tasks = min(num_tasks, len(suite))
    if episodes < num_tasks or episodes % num_tasks:
        raise ValueError(f"episodes is {episodes}, expected a multiple of the {num_tasks} tasks")
    rows = np.sort(np.random.default_rng(seed).choice(len(suite), num_tasks, replace=False))
    cases = make_cases(env, suite.take(rows), layouts_per_task=episodes // num_tasks, seed=seed)
    return SuiteEvaluation(cases, greedy, chunk=episodes)


def final_evaluation(
    env: Environment, suite: Suite, *, episodes: int = 1000, seed: int = 1, greedy: bool = False, shield: bool = False
) -> SuiteEvaluation:
    """The evaluation at the end of training: all tasks, ten layouts or more for each, at least ``episodes`` in all.

    Args:
        env: the environment.
        suite: unseen tasks.
        episodes: fewest episodes.
        seed: of the layouts; another one than in :func:`periodic_evaluation` unless asked.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.
    """
    layouts_per_task = max(LAYOUTS_PER_TASK, -(-episodes // len(suite)))
    return SuiteEvaluation(make_cases(env, suite, layouts_per_task=layouts_per_task, seed=seed), greedy, shield)


def return_evaluation(
    env: Environment,
    suite: Suite,
    machine: RewardMachine,
    *,
    layouts_per_task: int = LAYOUTS_PER_TASK,
    seed: int = 1,
    greedy: bool = False,
) -> ReturnEvaluation:
    """Return over optimum on the tasks and layouts of a suite in which the branch matters.

    Raises:
        ValueError: if the environment is no :class:`envs_jax.FiniteGraph`, or the branch matters nowhere.
    """
    cases = make_branch_cases(env, suite, machine, layouts_per_task=layouts_per_task, seed=seed)
    return ReturnEvaluation(cases, greedy)


def choice_evaluation(
    env: Environment, *, num_cases: int = 400, seed: int = 1, greedy: bool = False
) -> ChoiceEvaluation:
    """Contested choice on ``num_cases`` layouts, half of them controls.

    Raises:
        ValueError: if the environment is not ``hrlspec.exact.contested.Contestable``.
    """
    return ChoiceEvaluation(contested_suite(jax.random.key(seed), env, num_cases=num_cases), greedy)


def _even(total: int, most: int) -> int:
    """A chunk of at most ``most`` that divides the work with the least left over."""
    rounds = -(-total // most)
    return -(-total // rounds)
