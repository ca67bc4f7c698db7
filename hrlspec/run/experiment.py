"""A run as a value: what ``config.json`` keeps, and reading it back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from hrlspec.agent.agent import Agent
from hrlspec.agent_files import acts
from hrlspec.config import Checked, Config, ConfigError, from_plain, setting
from hrlspec.methods import Method
from hrlspec.presets import Preset, Recipe, RewardSet, Split
from hrlspec.run.errors import UserError
from hrlspec.run.lookup import method_named, preset_named
from hrlspec.tasks.rewards import RewardMachine


@dataclasses.dataclass(frozen=True)
class EvaluationConfig(Checked):
    """When and on what a run is evaluated."""

    every: int = setting(50_000, least=1)
    """Environment steps between evaluations during training."""
    episodes: int = setting(100, least=10, most=1_000_000)
    """Episodes of an evaluation during training, spread over 10 unseen tasks."""
    final: Split = "validation"
    """Tasks and layouts of the evaluation at the end. Those of the learning curve are always validation's; test is for
    agents of which nothing will be chosen afterwards."""
    final_tasks: int = setting(200, least=1)
    """Unseen tasks of the evaluation at the end, at most as many as the suite has; 10 layouts for each."""
    contested: int = setting(400, least=0, most=100_000)
    """Layouts of the contested-choice suite at the end; 0 leaves it out."""
    greedy: bool = False
    """Take the most likely action and sub-task instead of sampling."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episodes % 10:
            raise ConfigError(f"EvaluationConfig.episodes is {self.episodes}, expected a multiple of the 10 tasks")
        if self.contested % 2:
            raise ConfigError(
                f"EvaluationConfig.contested is {self.contested}, expected an even number: half are controls"
            )


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Everything that determines a run; what ``config.json`` keeps.

    Attributes:
        env: name of a preset, or ``module:factory``.
        method: name of a method, or ``module:VALUE``.
        recipe: whose settings were begun with.
        reward_set: the rewards.
        seed: of everything random.
        evaluation: when and on what it is evaluated.
        config: settings that all methods share.
        method_settings: the method itself, whose fields are its settings.
        begun_from: SHA-256 of the file of parameters that training begins from; ``None`` for fresh ones.
    """

    env: str
    method: str
    recipe: Recipe
    reward_set: RewardSet
    seed: int
    evaluation: EvaluationConfig
    config: Config
    method_settings: Method
    begun_from: str | None = setting(None, later=True)

    @property
    def name(self) -> str:
        """Such as ``letter-ours-hrlspec-set1-seed0``."""
        parts = f"{self.env}-{self.method}-{self.recipe}-set{self.reward_set}-seed{self.seed}"
        return parts.replace(":", ".")

    @property
    def is_foreign(self) -> bool:
        """Whether its environment or its method is not of this library."""
        return ":" in self.env + self.method

    @property
    def preset(self) -> Preset:
        """The environment with what belongs to it."""
        return preset_named(self.env)

    @property
    def agent(self) -> Agent:
        """The agent, without parameters.

        Raises:
            UserError: a library that its environment needs is missing.
        """
        env = self.preset.make()
        try:
            env.check_installed()
        except ImportError as error:
            raise UserError(str(error)) from error
        return Agent(env, self.config, self.method_settings)

    @property
    def rewards(self) -> RewardMachine:
        """The rewards of its set."""
        return self.preset.rewards(self.reward_set)


def experiment_of(record: Mapping[str, Any], where: str, *, to_act: bool = False) -> Experiment:
    """The experiment in ``config.json``'s ``config``.

    Args:
        record: its entries.
        where: what to call it in messages.
        to_act: whether it is wanted for an agent to act. Settings that training alone heeds may then be missing, as
            where they came later, and have their defaults.

    Raises:
        UserError: the record is of a version with other settings, or its environment or method is not to be had.
    """
    try:
        preset_named(str(record.get("env")))
        method = method_named(str(record.get("method")))
    except UserError as error:
        raise UserError(f"{where} is a run that cannot be read here: {error}") from None
    example = Experiment("", "", "hrlspec", 1, 0, EvaluationConfig(), Config(), method)
    try:
        return from_plain(example, record, needed=acts if to_act else lambda _: True)
    except ConfigError as error:
        raise UserError(f"{where} was made by another version of hrlspec: {error}") from None
