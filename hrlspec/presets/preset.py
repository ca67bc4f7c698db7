"""A preset is one value: everything that a world needs to be trained, evaluated and drawn."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Literal

import jax
import numpy as np

from envs_jax import Environment
from hrlspec.agent.method import Method
from hrlspec.config import Config, Effort, evolve
from hrlspec.evaluation import Suite, suite_from_text
from hrlspec.methods import METHODS, ImplicitPlanner
from hrlspec.presets.recipes import Recipe, RewardSet, Settings, recipe, with_bonuses
from hrlspec.presets.suite_rules import VALIDATION, SuiteRule
from hrlspec.presets.suites import SuiteError, hashes_of, packaged_hashes, packaged_suite
from hrlspec.spec import TaskTree, compile_task, parse
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine

Split = Literal["validation", "test"]
"""Tasks and layouts for whoever tunes or chooses anything, and those that are left to the end."""
Fit = Callable[[Settings, Recipe], Settings]


def _as_it_is(settings: Settings, recipe: Recipe) -> Settings:
    del recipe
    return settings


@dataclasses.dataclass(frozen=True)
class Preset:
    """A world with its settings.

    Attributes:
        name: as flags and run folders know it.
        make: the environment.
        fit: a recipe's settings fitted to the world.
        fit_bonuses: the same, besides, under reward set 2.
        bonuses: order bonuses of reward set 2 (paper, "Reward Function of Subgoals").
        learning_rates: where a method's tuning chose another one than its recipe's, by recipe and method: the trial
            with the largest sum of the learning curve's mean and the final return (``reproduce --only walk-tuning`` and
            its like).
        suites: suites for test and validation by name, and how those in the files of this package were drawn.
        texts: the suites by name, one formula a line, where they are not in those files.
        collected: the tasks that are collected on, in SPECTRL, where hardly any random task can be carried out. They
            may be those of the suites: nothing is held out then.
        compiled_with: the effort that compiling programs is worth. Where matrix products, which are not compiled, are
            most of the time, the least.
    """

    name: str
    make: Callable[[], Environment]
    fit: Fit = _as_it_is
    fit_bonuses: Fit = _as_it_is
    bonuses: tuple[Bonus, ...] = ()
    learning_rates: Mapping[tuple[Recipe, str], float] = dataclasses.field(default_factory=dict)
    suites: Mapping[str, SuiteRule] = dataclasses.field(default_factory=dict)
    texts: Mapping[str, str] = dataclasses.field(default_factory=dict)
    collected: tuple[str, ...] = ()
    compiled_with: Effort = "most"

    def settings(
        self, method: str | Method = "ours", recipe_name: Recipe = "hrlspec", reward_set: RewardSet = 1
    ) -> tuple[Config, Method]:
        """The settings of a run unless told otherwise.

        Args:
            method: by name, with the planner's settings as the recipe has them; or a value, whose settings stay.
            recipe_name: ``paper``, the paper's method fitted to the world; ``planner``, the same, but that V^h is asked
                about every path; or ``hrlspec``, what measured better.
            reward_set: 1 or 2.

        Raises:
            ValueError: there is no such method.
        """
        settings = self.fit(recipe(recipe_name), recipe_name)
        if reward_set == 2:
            settings = self.fit_bonuses(with_bonuses(settings, recipe_name), recipe_name)
        chosen = method if isinstance(method, Method) else named_method(method)
        if chosen is not method and isinstance(chosen.high, ImplicitPlanner):
            chosen = dataclasses.replace(chosen, high=settings.planner)
        config = chosen.configure(settings.config)
        # An ablation is ours but for one thing.
        tuned = "ours" if isinstance(chosen.high, ImplicitPlanner) else chosen.name
        family: Recipe = "hrlspec" if recipe_name == "hrlspec" else "paper"
        rate = self.learning_rates.get((family, tuned), config.low.optimiser.learning_rate)
        return evolve(config, {"low.optimiser.learning_rate": rate}), chosen

    def effort(self, recipe_name: Recipe) -> Effort:
        """How much a recipe's programs are compiled with; the others have more around their matrix products."""
        return self.compiled_with if recipe_name == "hrlspec" else "most"

    def rewards(self, reward_set: RewardSet = 1) -> RewardMachine:
        """The rewards of a reward set: 1 for completion; in set 2 also for sub-tasks and for orders of letters."""
        propositions = self.make().propositions
        if reward_set == 1:
            return reward_machine(propositions)
        return reward_machine(propositions, subtask=1.0, bonuses=self.bonuses)

    @property
    def suite_names(self) -> tuple[str, ...]:
        """The suites; none for a world that nobody drew any for."""
        return (*self.suites, *self.texts)

    def suite_for(self, split: Split, name: str = "dag") -> Suite:
        """A test suite, or its counterpart for validation; a world without the latter is validated on the former.

        Raises:
            SuiteError: there is none, or its file cannot be read.
        """
        other = name + VALIDATION
        return self.suite(other if split == "validation" and other in self.suite_names else name)

    def suite(self, name: str) -> Suite:
        """A suite by its name.

        Raises:
            SuiteError: there is none, or its file cannot be read.
        """
        propositions = self.make().propositions
        if name in self.texts:
            return suite_from_text(name, self.texts[name], propositions)
        if name not in self.suites:
            known = f"expected one of: {', '.join(self.suite_names)}" if self.suite_names else "there is none for it"
            raise SuiteError(f"unknown suite {name!r} of {self.name!r}; {known}")
        return packaged_suite(self.name, name, propositions)

    @functools.cached_property
    def reserved(self) -> np.ndarray:
        """Sorted hashes of the tasks of all suites, uint32 ``[...]``: training must not see them.

        Tasks of one sub-task are not among them: where there are such, everything else is made of them.

        Raises:
            SuiteError: a suite's file cannot be read.
        """
        if self.collected:
            return np.zeros(0, np.uint32)
        if self.suites:
            return packaged_hashes(self.name, tuple(self.suites), self.make().propositions)
        suites = [self.suite(name) for name in self.texts]
        return hashes_of([suite.take(np.flatnonzero(suite.depths > 1)) for suite in suites])

    def collected_tasks(self, max_nodes: int) -> TaskTree | None:
        """The tasks that are collected on, leading axis M, padded to ``max_nodes``; ``None`` for random ones.

        Raises:
            SpecError: one has a tree of more nodes.
        """
        if not self.collected:
            return None
        propositions = self.make().propositions
        trees = [compile_task(parse(text), propositions, max_nodes, on_host=True) for text in self.collected]
        given: TaskTree = jax.tree.map(lambda *x: np.stack(x), *trees)
        return given


def named_method(name: str) -> Method:
    """A method of `hrlspec.methods` by its name.

    Raises:
        ValueError: there is none; the message lists those there are.
    """
    if name not in METHODS:
        raise ValueError(f"unknown method {name!r}, expected one of: {', '.join(METHODS)}")
    return METHODS[name]
