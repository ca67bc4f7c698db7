"""From an experiment to what the host loop drives, and to its final results."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hrlspec.agent.low_level import Params
from hrlspec.evaluation import (
    ChoiceResult,
    FirstChoiceResult,
    ReturnResult,
    Suite,
    SuiteEvaluation,
    SuiteResult,
    choice_evaluation,
    final_evaluation,
    first_choice_evaluation,
    periodic_evaluation,
    return_evaluation,
)
from hrlspec.exact.contested import Contestable
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.presets import Preset, Split
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import Experiment
from hrlspec.run.programs import Program
from hrlspec.run.track import Job
from hrlspec.tasks.bank import TaskBanks, joint_labels

PERIODIC_TASKS = (1, 2, 5, 10)  # the most there are; each divides the number of episodes
LAYOUTS: dict[Split, int] = {"validation": 1, "test": 2}
"""Seeds of the layouts at the end; the learning curve's have another one."""
_EVALUATION_STREAM, _FINAL_STREAM = 1, 2  # of random numbers, apart from training's


@dataclasses.dataclass(frozen=True)
class FinalResults:
    """What a trained agent is reported with.

    Attributes:
        suite: on unseen tasks.
        choice: contested choice, where the environment allows it and it was asked for.
        returns: return over optimum, under reward set 2 where the environment allows it.
        first_choice: how often the first sub-task is the best one, where that is known and the high level assigns any.
    """

    suite: SuiteResult
    choice: ChoiceResult | None
    returns: ReturnResult | None
    first_choice: FirstChoiceResult | None

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {
            "suite": self.suite.to_json(),
            "contested_choice": None if self.choice is None else self.choice.to_json(),
            "return_over_optimum": None if self.returns is None else self.returns.to_json(),
            "first_choice": None if self.first_choice is None else self.first_choice.to_json(),
        }


class Learner:
    """An experiment with everything it needs: environment, agent, rewards, held-out tasks.

    Args:
        experiment: what to learn.
        preset: its environment's, with test suites.
        devices: how many train it; see `hrlspec.learning.train.Trainer`.
        params: parameters to begin from, by part; parts that are not among them are fresh.

    Raises:
        UserError: no training task can be drawn under the experiment's configuration.
    """

    def __init__(self, experiment: Experiment, preset: Preset, devices: int = 1, params: Params | None = None) -> None:
        self.experiment, self.preset = experiment, preset
        self._given = params or {}
        self.agent = experiment.agent
        self.env = self.agent.env
        self.trainer = Trainer(self.agent, devices)
        self._init_program = self.program("init", Trainer.init, self.trainer, devices)
        self._iterate_program = self.program("iterate", Trainer.iterate, self.trainer, devices)
        self.machine = experiment.rewards
        self.reserved = jnp.asarray(preset.reserved)
        curriculum = experiment.config.curriculum
        try:
            given = preset.collected_tasks(curriculum.max_nodes)
            together = joint_labels(self.env, curriculum)
            number = self.env.num_propositions
            self.banks = TaskBanks(experiment.seed, curriculum, number, preset.reserved, given, together)
        except ValueError as error:
            raise UserError(f"no training tasks with this --config.curriculum: {error}") from error

    def program(self, name: str, function: Any, of: Any, devices: int) -> Program:
        """A method of a trainer or the like; kept from run to run unless made of code that others may change."""
        effort, kept = self.preset.effort(self.experiment.recipe), not self.experiment.is_foreign
        return Program(name, function, of, effort=effort, kept=kept, devices=devices)

    def beside(self, experiment: Experiment, preset: Preset) -> Learner:
        """That of another seed, with the same compiled programs."""
        other = Learner(experiment, preset, self.trainer.devices, self._given)
        other._init_program, other._iterate_program = self._init_program, self._iterate_program
        return other

    def job(self) -> Job:
        """The experiment as the host loop wants it."""
        return Job(
            init=self._init,
            iterate=self._iterate,
            evaluate=self._evaluate,
            summarise=self._summarise,
            healthy=lambda state: bool(_all_finite(on_one_device(state.params))),
            steps_per_iteration=self.experiment.config.steps_per_iteration,
            num_iterations=self.experiment.config.num_iterations,
            evaluate_every=self.experiment.evaluation.every,
        )

    def final_results(self, params: Params) -> FinalResults:
        """Evaluates a trained agent."""
        settings = self.experiment.evaluation
        keys = jax.random.split(self._key(_FINAL_STREAM), 3)
        how = self.agent, params, self.machine
        where: dict[str, Any] = {"seed": LAYOUTS[settings.final], "greedy": settings.greedy}
        suite = self._some("dag")
        result = final_evaluation(self.env, suite, episodes=len(suite), **where)(keys[0], *how)
        choice = returns = first = None
        if self.agent.method.sees != "whole task":
            # There may be no such case, or nothing by which to tell what is best.
            evaluation = None
            with contextlib.suppress(ValueError):
                evaluation = first_choice_evaluation(self.env, suite, self.machine, **where)
            if evaluation is not None:
                first = evaluation(jax.random.fold_in(self._key(_FINAL_STREAM), 3), *how)
        if settings.contested and isinstance(self.env, Contestable):
            # An environment of somebody else's may be of that kind and yet have hardly any such layout.
            contested = None
            with contextlib.suppress(ValueError):
                contested = choice_evaluation(self.env, num_cases=settings.contested, **where)
            if contested is not None:
                choice = contested(keys[1], *how)
        if self.experiment.reward_set == 2 and "branches" in self.preset.suite_names:
            returns = return_evaluation(self.env, self._some("branches"), self.machine, **where)(keys[2], *how)
        return FinalResults(result, choice, returns, first)

    @functools.cached_property
    def validation_suite(self) -> Suite:
        """Unseen tasks, on which learning is watched."""
        return self.preset.suite_for("validation")

    def _some(self, name: str) -> Suite:
        """As many tasks of a suite as the evaluation at the end asks for, evenly spread."""
        settings = self.experiment.evaluation
        suite = self.preset.suite_for(settings.final, name)
        return suite.take(spread(len(suite), settings.final_tasks))

    @functools.cached_property
    def _periodic(self) -> SuiteEvaluation:
        settings, suite = self.experiment.evaluation, self.validation_suite
        num_tasks = max(number for number in PERIODIC_TASKS if number <= len(suite))
        return periodic_evaluation(
            self.env, suite, num_tasks=num_tasks, episodes=settings.episodes, greedy=settings.greedy
        )

    def _init(self) -> TrainState:
        key = jax.random.key(self.experiment.seed)
        state: TrainState = self._init_program(key, self.banks.at(0), self.machine)
        # Copies, since the state is donated; where the fresh parameters lie.
        fresh = {name: part for name, part in state.params.items() if name in self._given}
        begun = jax.tree.map(lambda new, old: jax.device_put(jnp.array(new), old.sharding), self._given, fresh)
        return dataclasses.replace(state, params={**state.params, **begun})

    def _iterate(self, state: TrainState, index: int) -> tuple[TrainState, Mapping[str, jax.Array]]:
        result: tuple[TrainState, Mapping[str, jax.Array]] = self._iterate_program(
            state, self.banks.at(index), self.machine, self.reserved
        )
        return result

    def _evaluate(self, state: TrainState, env_steps: int) -> dict[str, Any]:
        key = jax.random.fold_in(self._key(_EVALUATION_STREAM), env_steps % 2**32)
        result = self._periodic(key, self.agent, on_one_device(state.params), self.machine)
        return {"level": int(state.curriculum.level) + 1, **result.metrics()}

    def _summarise(self, sums: Mapping[str, float], iterations: int) -> dict[str, Any]:
        """Means over episodes of what the metrics add up over episodes, and over iterations of the others."""
        names = ("episodes", "successes", "returns", "steps")
        episodes, successes, returns, steps = (sums[name] for name in names)
        rest = {name: value / iterations for name, value in sums.items() if name not in (*names, "level")}
        return {
            "train/success_rate": successes / episodes if episodes else None,
            "train/return_mean": returns / episodes if episodes else None,
            "train/episode_length": steps / episodes if episodes else None,
            **{name if "/" in name else f"train/{name}": value for name, value in rest.items()},
        }

    def _key(self, stream: int) -> jax.Array:
        return jax.random.fold_in(jax.random.key(self.experiment.seed), 2**31 + stream)


def on_one_device(params: Params) -> Params:
    """Parameters that lie on every device, as arrays of the first: what uses them then runs there once."""
    one: Params = jax.tree.map(lambda x: x.addressable_data(0), params)
    return one


@jax.jit
def _all_finite(params: Params) -> jax.Array:
    return jnp.all(jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(params)]))


def spread(total: int, wanted: int) -> np.ndarray:
    """Rows spread evenly over a suite, which is ordered by depth."""
    return np.unique(np.linspace(0, total - 1, min(total, wanted)).round().astype(int))
