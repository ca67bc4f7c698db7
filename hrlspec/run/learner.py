"""From an experiment to what the host loop drives, and to its final results."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs_jax import Environment
from hrlspec.agent.agent import Agent, Params
from hrlspec.evaluation import (
    ChoiceResult,
    ReturnResult,
    Suite,
    SuiteEvaluation,
    SuiteResult,
    choice_evaluation,
    final_evaluation,
    periodic_evaluation,
    return_evaluation,
)
from hrlspec.exact.contested import can_contest
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.presets.settings import rewards_of
from hrlspec.presets.suites import load_suite, reserved_hashes, suite_names
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import Experiment, environment_of
from hrlspec.run.loop import Job
from hrlspec.run.programs import Program
from hrlspec.spec import TaskTree
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import RewardMachine

BANK_ITERATIONS = 16  # a bank of training tasks serves this many iterations
PERIODIC_TASKS = 10
_EVALUATION_STREAM, _FINAL_STREAM = 1, 2  # of random numbers, apart from training's


@dataclasses.dataclass(frozen=True)
class FinalResults:
    """What a trained agent is reported with.

    Attributes:
        suite: on unseen tasks.
        choice: contested choice, where the environment allows it and it was asked for.
        returns: return over optimum, under reward set 2 where the environment allows it.
    """

    suite: SuiteResult
    choice: ChoiceResult | None
    returns: ReturnResult | None

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {
            "suite": self.suite.to_json(),
            "contested_choice": None if self.choice is None else self.choice.to_json(),
            "return_over_optimum": None if self.returns is None else self.returns.to_json(),
        }


class Learner:
    """An experiment with everything it needs: environment, agent, rewards, held-out tasks.

    Raises:
        UserError: no training task can be drawn under the experiment's configuration.
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.env: Environment = environment_of(experiment)
        self.agent = Agent(self.env, experiment.config)
        self.trainer = Trainer(self.agent)
        self._init_program = Program("init", Trainer.init, self.trainer)
        self._iterate_program = Program("iterate", Trainer.iterate, self.trainer)
        self.machine: RewardMachine = rewards_of(experiment.env, experiment.reward_set)
        self._reserved = reserved_hashes(experiment.env)
        self._reserved_on_device = jnp.asarray(self._reserved)
        self._bank: tuple[int, TaskTree] | None = None
        try:
            self._bank_of(0)
        except ValueError as error:
            raise UserError(f"no training tasks with this --config.curriculum: {error}") from error

    def job(self) -> Job:
        """The experiment as the host loop wants it."""
        return Job(
            init=self._init,
            iterate=self._iterate,
            evaluate=self._evaluate,
            summarise=self._summarise,
            healthy=lambda state: bool(_all_finite(state.params)),
            steps_per_iteration=self.experiment.config.steps_per_iteration,
            num_iterations=self.experiment.config.num_iterations,
            evaluate_every=self.experiment.evaluation.every,
        )

    def final_results(self, params: Params) -> FinalResults:
        """Evaluates a trained agent."""
        settings = self.experiment.evaluation
        keys = jax.random.split(self._key(_FINAL_STREAM), 3)
        how = self.agent, params, self.machine
        suite = self.test_suite.take(_spread(len(self.test_suite), settings.final_tasks))
        result = final_evaluation(self.env, suite, episodes=len(suite), greedy=settings.greedy)(keys[0], *how)
        choice = returns = None
        if settings.contested and can_contest(self.env):
            evaluation = choice_evaluation(self.env, num_cases=settings.contested, greedy=settings.greedy)
            choice = evaluation(keys[1], *how)
        if self.experiment.reward_set == 2 and "branches" in suite_names(self.experiment.env):
            branches = load_suite(self.experiment.env, "branches")
            branches = branches.take(_spread(len(branches), settings.final_tasks))
            returns = return_evaluation(self.env, branches, self.machine, greedy=settings.greedy)(keys[2], *how)
        return FinalResults(result, choice, returns)

    @functools.cached_property
    def test_suite(self) -> Suite:
        """Unseen tasks."""
        return load_suite(self.experiment.env, "dag")

    @functools.cached_property
    def _periodic(self) -> SuiteEvaluation:
        settings = self.experiment.evaluation
        return periodic_evaluation(
            self.env, self.test_suite, num_tasks=PERIODIC_TASKS, episodes=settings.episodes, greedy=settings.greedy
        )

    def _init(self) -> TrainState:
        key = jax.random.key(self.experiment.seed)
        state: TrainState = self._init_program(key, self._bank_of(0), self.machine)
        return state

    def _iterate(self, state: TrainState, index: int) -> tuple[TrainState, Mapping[str, jax.Array]]:
        bank = self._bank_of(index // BANK_ITERATIONS)
        result: tuple[TrainState, Mapping[str, jax.Array]] = self._iterate_program(
            state, bank, self.machine, self._reserved_on_device
        )
        return result

    def _bank_of(self, number: int) -> TaskTree:
        """A bank depends on the seed and its number alone, so that a resumed run draws the same ones."""
        if self._bank is None or self._bank[0] != number:
            rng = np.random.default_rng([self.experiment.seed, number])
            bank = draw_bank(rng, self.experiment.config.curriculum, self.env.num_propositions, self._reserved)
            self._bank = number, jax.tree.map(jnp.asarray, bank)
        return self._bank[1]

    def _evaluate(self, state: TrainState, env_steps: int) -> dict[str, Any]:
        key = jax.random.fold_in(self._key(_EVALUATION_STREAM), env_steps % 2**32)
        result = self._periodic(key, self.agent, state.params, self.machine)
        return {"level": int(state.curriculum.level) + 1, **result.metrics()}

    def _summarise(self, sums: Mapping[str, float], iterations: int) -> dict[str, Any]:
        """Means over episodes of what the metrics add up over episodes, and over iterations of the others."""
        rest = {name: value / iterations for name, value in sums.items() if name != "level"}
        episodes, successes, returns = (rest.pop(name) for name in ("episodes", "successes", "returns"))
        steps = self.experiment.config.steps_per_iteration
        return {
            "train/success_rate": successes / episodes if episodes else None,
            "train/return_mean": returns / episodes if episodes else None,
            "train/episode_length": steps / episodes if episodes else None,
            **{name if "/" in name else f"train/{name}": value for name, value in rest.items()},
        }

    def _key(self, stream: int) -> jax.Array:
        return jax.random.fold_in(jax.random.key(self.experiment.seed), 2**31 + stream)


@jax.jit
def _all_finite(params: Params) -> jax.Array:
    return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(params)]))


def _spread(total: int, wanted: int) -> np.ndarray:
    """Rows spread evenly over a suite, which is ordered by depth."""
    return np.unique(np.linspace(0, total - 1, min(total, wanted)).round().astype(int))
