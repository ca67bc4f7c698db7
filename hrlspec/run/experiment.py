"""What ``hrlspec.run.commands.run`` can be told, and what it makes of it: one `Experiment` for each seed."""

from __future__ import annotations

import argparse
import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from envs_jax import Environment, make, registered
from hrlspec.config import Config, PPOConfig
from hrlspec.presets.settings import preset
from hrlspec.run.errors import UserError
from hrlspec.run.flags import parse_flags

Method = Literal["ours", "ltl2action", "option", "myopic-low", "no-er"]
Recipe = Literal["paper", "hrlspec"]
RECIPES: tuple[Recipe, ...] = typing.get_args(Recipe)
RewardSet = Literal[1, 2]

PROGRAM = "python -m experiments.run"


@dataclasses.dataclass(frozen=True)
class EvaluationConfig:
    """When and on what a run is evaluated."""

    every: int = 50_000
    """Environment steps between evaluations during training."""
    episodes: int = 100
    """Episodes of an evaluation during training, spread over 10 unseen tasks."""
    final_tasks: int = 200
    """Unseen tasks of the evaluation at the end, at most as many as the test suite has; 10 layouts for each."""
    contested: int = 400
    """Layouts of the contested-choice suite at the end; 0 leaves it out."""
    greedy: bool = False
    """Take the most likely action and sub-task instead of sampling."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Everything that determines a run; what ``config.json`` keeps."""

    env: str
    method: Method
    recipe: Recipe
    reward_set: RewardSet
    seed: int
    evaluation: EvaluationConfig
    config: Config

    @property
    def name(self) -> str:
        """Such as ``letter-ours-hrlspec-set1-seed0``."""
        return f"{self.env}-{self.method}-{self.recipe}-set{self.reward_set}-seed{self.seed}"


@dataclasses.dataclass(frozen=True)
class RunFlags:
    """Trains an agent, evaluates it on tasks it never saw, and writes everything into a run folder.

    --config.* shows the preset of the chosen environment, method, recipe and reward set, and overrides it.
    """

    env: Literal["letter", "letter12", "walk", "flatworld", "zone", "zone-ltl2action", "zone-nm"] = "letter"
    method: Method = "ours"
    """ltl2action: one flat policy sees the whole task; option: value iteration chooses options; myopic-low: the low
    level does not see what comes after its sub-task; no-er: no relabelled experience."""
    recipe: Recipe = "hrlspec"
    """paper: the paper's method, made to learn; hrlspec: what was measured to be better."""
    reward_set: RewardSet = 1
    """1: 1 for completing the task; 2: also for sub-tasks and for visiting some in order."""
    seed: int = 0
    num_seeds: int = 1
    """Seeds to run one after another, from --seed on, each in a folder of its own."""
    total_steps: int | None = None
    """Environment steps; the preset's if not given."""
    out: Path | None = None
    """The run folder; runs/<name> if not given. With several seeds, the folder that holds seed<n>/."""
    resume: bool = False
    """Continue what is in the folder, with the flags it was begun with; finished seeds are skipped."""
    checkpoint_minutes: float = 1.0
    """How much work a kill may cost."""
    no_max_operator: bool = False
    """Targets of the low level without the planner's value of what remains."""
    no_shield: bool = False
    """Collect without replacing actions that would step on forbidden propositions."""
    no_relabel: bool = False
    """No experience relabelled into other tasks."""
    no_curriculum: bool = False
    """All levels from the start, in equal shares."""
    no_transe: bool = False
    """No loss that shapes the planner's latent transitions."""
    evaluation: EvaluationConfig = EvaluationConfig()
    config: Config = dataclasses.field(default_factory=Config)


def parse_run(argv: Sequence[str]) -> RunFlags:
    """The flags of ``hrlspec.run.commands.run``; presets fill in what is not given.

    Raises:
        UserError: something is not allowed.
    """
    # The preset depends on four flags and is the default of all others, so those four are looked at first.
    scan = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    names = ("env", "method", "recipe", "reward_set")
    for name in names:
        scan.add_argument(f"--{name.replace('_', '-')}", f"--{name}", dest=name, default=None)
    try:
        seen = vars(scan.parse_known_args(list(argv))[0])
    except argparse.ArgumentError:
        seen = {}  # tyro says it better
    fields = {field.name: field for field in dataclasses.fields(RunFlags)}
    chosen: dict[str, Any] = {}
    for name in names:
        allowed = typing.get_args(typing.get_type_hints(RunFlags)[name])
        given = [value for value in allowed if str(value) == seen.get(name)]
        chosen[name] = given[0] if given else fields[name].default
    config = preset(chosen["env"], chosen["recipe"], chosen["reward_set"], chosen["method"])
    flags = parse_flags(RunFlags, argv, program=PROGRAM, default=RunFlags(config=config))
    if flags.num_seeds < 1:
        raise UserError(f"--num-seeds is {flags.num_seeds}, expected at least 1")
    if not 0 <= flags.seed <= 2**31 - flags.num_seeds:
        raise UserError(f"--seed is {flags.seed}, expected a number from 0 to 2147483647")
    if not 0 <= flags.checkpoint_minutes < 1e6:
        raise UserError(f"--checkpoint-minutes is {flags.checkpoint_minutes}, expected a number of minutes, 0 or more")
    return flags


def experiments_of(flags: RunFlags) -> list[tuple[Experiment, Path]]:
    """The runs that the flags ask for and their folders.

    Raises:
        UserError: the configuration does not make sense.
    """
    config = _switched(flags)
    check_config(config)
    check_evaluation(flags.evaluation)
    runs = []
    for seed in range(flags.seed, flags.seed + flags.num_seeds):
        experiment = Experiment(
            env=flags.env,
            method=flags.method,
            recipe=flags.recipe,
            reward_set=flags.reward_set,
            seed=seed,
            evaluation=flags.evaluation,
            config=config,
        )
        if flags.out is None:
            folder = Path("runs") / experiment.name
        else:
            folder = flags.out if flags.num_seeds == 1 else flags.out / f"seed{seed}"
        runs.append((experiment, folder))
    return runs


def _switched(flags: RunFlags) -> Config:
    """The configuration with the short flags applied."""
    config = flags.config
    if flags.total_steps is not None:
        config = dataclasses.replace(config, total_steps=flags.total_steps)
    if flags.no_max_operator:
        config = dataclasses.replace(config, max_operator=False)
    if flags.no_shield:
        config = dataclasses.replace(config, shield=dataclasses.replace(config.shield, mode="off"))
    if flags.no_relabel:
        config = dataclasses.replace(config, relabel=dataclasses.replace(config.relabel, share=0.0))
    if flags.no_transe:
        config = dataclasses.replace(config, transe=0.0)
    if flags.no_curriculum:
        # Every verdict promotes, and "a level already passed" has the share of all levels but one.
        levels = max(config.curriculum.levels, 1)
        at_once = dataclasses.replace(config.curriculum, promotion=0.0, window=0, earlier=1 - 1 / levels)
        config = dataclasses.replace(config, curriculum=at_once)
    return config


# What a configuration must satisfy ----------------------------------------------------------------------------------


def check_config(config: Config) -> None:
    """Refuses values that cannot be meant, before anything is compiled or written.

    Raises:
        UserError: naming the first flag at fault, what was found and what was expected.
    """
    curriculum, relabel, shield, network = config.curriculum, config.relabel, config.shield, config.network
    for name in ("num_envs", "num_steps", "total_steps", "steps_per_slot", "planner_share", "group"):
        _at_least(1, name, getattr(config, name))
    _at_least(2, "num_steps", config.num_steps)
    for name in ("levels", "tasks_per_level", "max_branching"):
        _at_least(1, f"curriculum.{name}", getattr(curriculum, name))
    _at_least(0, "curriculum.window", curriculum.window)
    _at_least(0, "curriculum.max_avoid", curriculum.max_avoid)
    _at_least(curriculum.levels + 2, "curriculum.max_nodes", curriculum.max_nodes)
    for name, value in (
        ("discount", config.discount),
        ("curriculum.promotion", curriculum.promotion),
        ("curriculum.earlier", curriculum.earlier),
        ("curriculum.tree_share", curriculum.tree_share),
        ("curriculum.contested", curriculum.contested),
        ("relabel.share", relabel.share),
        ("relabel.branch", relabel.branch),
        ("shield.threshold", shield.threshold),
        ("shield.discount", shield.discount),
    ):
        _between(0, 1, name, value)
    for name, value in (
        ("transe", config.transe),
        ("transe_margin", config.transe_margin),
        ("shield.learning_rate", shield.learning_rate),
    ):
        _between(0, 1e6, name, value)
    _between(0, 0.999, "noise_correlation", config.noise_correlation)
    _between(0, 0.999, "final_noise_correlation", config.final_noise_correlation)
    _between(0, 1e6, "network.advice", network.advice)
    for field in dataclasses.fields(network):
        sizes = getattr(network, field.name)
        least = 1 if field.name in ("latent", "planner_features", "planner_hidden", "task_features") else 0
        for size in sizes if isinstance(sizes, tuple) else (sizes,):
            _at_least(1 if isinstance(sizes, tuple) else least, f"network.{field.name}", size)
    _between(1e-3, 1e3, "network.task_scale", network.task_scale)
    parts = (network.roles, network.advice, network.task_rounds, network.memory, config.options)
    if network.whole_task and any(parts):
        raise UserError(
            "--config.network.whole-task leaves no sub-task: expected it without network.roles, network.advice, "
            "network.task-rounds, network.memory and options"
        )
    _check_level("low", config.low)
    _check_level("high", config.high)
    _check_minibatches(config)


def _check_level(level: str, settings: PPOConfig) -> None:
    for name in ("epochs", "minibatches"):
        _at_least(1, f"{level}.{name}", getattr(settings, name))
    _between(0, 1, f"{level}.gae_lambda", settings.gae_lambda)
    _between(0, 1, f"{level}.expectile", settings.expectile)
    weights = ("clip", "entropy", "final_entropy", "entropy_floor", "final_entropy_floor", "value_coefficient")
    for name in ("learning_rate", "final_learning_rate", *weights, "relative"):
        _between(0, 1e6, f"{level}.{name}", getattr(settings, name))
    _between(1 + settings.clip, 1e9, f"{level}.most_ratio", settings.most_ratio)
    _between(1e-9, 1e9, f"{level}.max_grad_norm", settings.max_grad_norm)


def _check_minibatches(config: Config) -> None:
    """Batches must divide evenly."""
    copies = round(config.relabel.share * config.num_envs)
    decisions = config.steps_per_iteration // config.planner_share
    batches = [
        ("low.minibatches", config.low.minibatches, config.num_envs + copies, "environments and relabelled copies"),
        ("high.minibatches", config.high.minibatches, decisions, "planner samples (E x T / planner_share)"),
    ]
    if config.shield.mode != "off":
        batches.append(("shield.minibatches", config.shield.minibatches, config.num_envs, "environments"))
    for name, parts, size, what in batches:
        _at_least(1, name, parts)
        if size < parts or size % parts:
            raise UserError(f"--config.{_flag(name)} is {parts}, expected a divisor of {size}, the number of {what}")


def check_evaluation(evaluation: EvaluationConfig) -> None:
    """As `check_config`."""
    for name in ("every", "final_tasks"):
        _at_least(1, name, getattr(evaluation, name), "evaluation")
    _between(10, 1_000_000, "episodes", evaluation.episodes, "evaluation")
    if evaluation.episodes % 10:
        raise UserError(f"--evaluation.episodes is {evaluation.episodes}, expected a multiple of the 10 tasks")
    _between(0, 100_000, "contested", evaluation.contested, "evaluation")
    if evaluation.contested % 2:
        raise UserError(f"--evaluation.contested is {evaluation.contested}, expected an even number: half are controls")


def _at_least(least: int, name: str, value: int, group: str = "config") -> None:
    if not least <= value < 2**40:
        raise UserError(f"--{group}.{_flag(name)} is {value}, expected at least {least}")


def _between(low: float, high: float, name: str, value: float, group: str = "config") -> None:
    if not low <= value <= high:
        raise UserError(f"--{group}.{_flag(name)} is {value}, expected a number from {low:g} to {high:g}")


def _flag(name: str) -> str:
    return name.replace("_", "-")


# Back from a run folder -----------------------------------------------------------------------------------------------

T = TypeVar("T")


def experiment_of(record: Mapping[str, Any], where: str) -> Experiment:
    """The experiment in ``config.json``'s ``config``.

    Raises:
        UserError: the record is of a version with other settings.
    """
    experiment = _dataclass(Experiment, record, where, "")
    if experiment.env not in registered():
        raise UserError(f"{where} is a run in the unknown environment {experiment.env!r}")
    check_config(experiment.config)
    return experiment


def environment_of(experiment: Experiment) -> Environment:
    """The environment of an experiment."""
    return make(experiment.env)


def _dataclass(kind: type[T], data: Any, where: str, prefix: str) -> T:
    """A dataclass from plain JSON values; lists become tuples."""
    fields = typing.get_type_hints(kind)
    if not isinstance(data, Mapping) or data.keys() != fields.keys():
        found = set(data) if isinstance(data, Mapping) else set()
        name = prefix + min(found ^ fields.keys(), default="")
        raise UserError(f"{where} was made by another version of hrlspec: the setting {name!r} is not in both")
    return kind(**{name: _value(fields[name], value, where, f"{prefix}{name}") for name, value in data.items()})


def _value(kind: Any, value: Any, where: str, name: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return _dataclass(typing.cast("type[Any]", kind), value, where, f"{name}.")
    origin, options = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and isinstance(value, list):
        return tuple(_value(options[0], item, where, name) for item in value)
    if origin is Literal:
        allowed: tuple[Any, ...] = options
        fits = value in allowed
    elif origin in (typing.Union, types.UnionType):
        fits = any(_is(option, value) for option in options)
    else:
        fits = _is(kind, value)
    if not fits:
        raise UserError(f"{where} was made by another version of hrlspec: {name} is {value!r}")
    return float(value) if kind is float else value


def _is(kind: Any, value: Any) -> bool:
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is kind
