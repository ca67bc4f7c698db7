"""What ``hrlspec run`` can be told, and what it makes of it: one `Experiment` for each seed."""

from __future__ import annotations

import argparse
import dataclasses
import re
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from hrlspec.config import Checked, Config, ConfigError, evolve, setting, without_copies
from hrlspec.methods import METHODS, OURS, Method
from hrlspec.presets import KNOWN, PRESETS, Recipe, RewardSet
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import EvaluationConfig, Experiment
from hrlspec.run.flags import flag_of, in_flags, parse_flags, settings_in
from hrlspec.run.hosts import AUTO
from hrlspec.run.lookup import method_named, preset_named
from hrlspec.run.trained import find_file

_FIRST = next(iter(PRESETS))
LAST_SEED = 2**31 - 1


@dataclasses.dataclass(frozen=True)
class RunFlags(Checked):
    """Trains an agent, evaluates it on tasks it never saw, and writes everything into a run folder.

    --config.* and --method.* show the settings of the chosen environment, method, recipe and reward set, and override
    them.
    """

    env: str = _FIRST
    """A name from above, or module:factory, or module:PRESET."""
    method: str = "ours"
    """A name from above, or module:VALUE."""
    recipe: Recipe = "hrlspec"
    """paper: the paper's method, made to learn; planner: the same, but that the planner is asked about every path on;
    hrlspec: what was measured to be better."""
    reward_set: RewardSet = 1
    """1: 1 for completing the task; 2: also for sub-tasks and for visiting some in order."""
    seed: int = setting(0, least=0, most=LAST_SEED)
    num_seeds: int = setting(1, least=1)
    """Seeds to run, from --seed on, each in a folder of its own: one after another or side by side, whichever is
    faster."""
    parallel_seeds: bool = False
    """Train the seeds side by side as one program, on a processor one or more a core, on an accelerator all at once.
    Results do not depend on it, but for rounding where it is all at once."""
    no_parallel_seeds: bool = False
    """Train them one after another."""
    total_steps: int | None = setting(None, least=1, most=2**40)
    """Environment steps; the preset's if not given."""
    out: Path | None = None
    """The run folder; runs/<name> if not given. With several seeds, the folder that holds seed<n>/."""
    from_: Annotated[str | None, arg(name="from")] = None
    """An agent whose parameters training begins from, with everything else fresh: one that comes along, by its name, or
    a .safetensors file. Environment, method and networks must be its own."""
    resume: bool = False
    """Continue what is in the folder, with the flags it was begun with; finished seeds are skipped. More --total-steps
    make a run longer, finished or not."""
    devices: int | Literal["auto"] = setting("auto", least=1)
    """Devices to spread the environments over, a divisor of --config.blocks; those of a processor are its cores. auto:
    as many as there are. Several processes share them. Seeds side by side are spread instead of environments. Results
    do not depend on it."""
    distributed: str | None = None
    """Several processes train one run together. auto: as SLURM, Open MPI or Kubernetes has started them; elsewhere
    HOST:PORT, where the first one listens, with --num-processes and --process-id. See also hrlspec launch."""
    num_processes: int | None = setting(None, least=1)
    """How many they are."""
    process_id: int | None = setting(None, least=0)
    """Which one this is, from 0."""
    checkpoint_minutes: float = setting(1.0, least=0, most=1e6)
    """How much work a kill may cost."""
    wandb: str | None = None
    """A project in Weights & Biases that is told all numbers too; with WANDB_MODE=offline they stay in the run folder.
    A resumed run goes on there if the flag is given again."""
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
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    config: Config = dataclasses.field(default_factory=Config)
    method_settings: Annotated[Method, arg(name="method")] = OURS

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seed + self.num_seeds - 1 > LAST_SEED:
            raise ConfigError(
                f"RunFlags.num_seeds is {self.num_seeds}, expected the last seed to be at most {LAST_SEED}"
            )
        self._check_seeds()
        self._check_processes()

    def _check_seeds(self) -> None:
        if not self.parallel_seeds:
            return
        if self.num_seeds < 2:
            raise ConfigError("RunFlags.parallel_seeds is True, expected --num-seeds of 2 or more with it")
        if self.no_parallel_seeds:
            raise ConfigError("RunFlags.parallel_seeds is True, expected no --no-parallel-seeds with it")
        if self.distributed is not None:
            raise ConfigError("RunFlags.parallel_seeds is True, expected no --distributed: one process trains them all")

    def _check_processes(self) -> None:
        given = self.num_processes, self.process_id
        if self.distributed in (None, AUTO):
            if given != (None, None):
                name, value = ("num_processes", given[0]) if given[0] is not None else ("process_id", given[1])
                raise ConfigError(f"RunFlags.{name} is {value}, expected --distributed HOST:PORT with it")
        elif not re.fullmatch(r"\S+:\d{1,5}", self.distributed):
            raise ConfigError(f"RunFlags.distributed is {self.distributed!r}, expected {AUTO} or HOST:PORT")
        elif self.num_processes is None or self.process_id is None:
            raise ConfigError(
                f"RunFlags.distributed is {self.distributed}, expected --num-processes and --process-id with it"
            )
        elif self.process_id >= self.num_processes:
            raise ConfigError(
                f"RunFlags.process_id is {self.process_id}, expected less than {self.num_processes}, the number of "
                "processes"
            )


def parse_run(argv: Sequence[str], *, program: str = "hrlspec run") -> RunFlags:
    """The flags of ``hrlspec run``; presets fill in what is not given.

    Raises:
        UserError: something is not allowed.
    """
    chosen = _chosen(argv)
    name = chosen["method"]
    config, method = preset_named(chosen["env"]).settings(
        name if name in METHODS else method_named(name), chosen["recipe"], chosen["reward_set"]
    )
    default = RunFlags(config=config, method_settings=method)
    return parse_flags(RunFlags, argv, program=program, default=default, about=_about())


def _chosen(argv: Sequence[str]) -> dict[str, Any]:
    """The four flags that all other defaults depend on, as given; the default where it is not, or not allowed."""
    scan = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    names = ("env", "method", "recipe", "reward_set")
    for name in names:
        scan.add_argument(f"--{name.replace('_', '-')}", f"--{name}", dest=name, default=None)
    try:
        seen = vars(scan.parse_known_args(list(argv))[0])
    except argparse.ArgumentError:
        seen = {}  # tyro says it better
    hints = typing.get_type_hints(RunFlags)
    default: dict[str, Any] = {name: getattr(RunFlags, name) for name in names}
    for name in names:
        allowed = typing.get_args(hints[name]) or (seen.get(name),)  # any text, where the type is no Literal
        default[name] = next((value for value in allowed if str(value) == seen.get(name)), default[name])
    return default


def _about() -> str:
    """What the help begins with."""
    methods = "\n".join(f"  {method.name}: {method.about}" for method in METHODS.values())
    return (
        f"{' '.join(str(RunFlags.__doc__).split())}\n\nEnvironments: {KNOWN}; any other as "
        "--env module:factory, where calling factory makes it; the module is looked for in the current directory "
        f"first.\n\nMethods, any other as --method module:VALUE:\n{methods}\n"
    )


def experiments_of(flags: RunFlags) -> list[tuple[Experiment, Path]]:
    """The runs that the flags ask for and their folders.

    Raises:
        UserError: the settings do not make sense.
        AgentFileError: there is no such agent to begin from.
    """
    try:
        config, method = _switched(flags)
        method.high.check(config)
    except ConfigError as error:
        raise UserError(in_flags(error, flags)) from None
    begun_from = None if flags.from_ is None else find_file(flags.from_).card.sha256
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
            method_settings=method,
            begun_from=begun_from,
        )
        if flags.out is None:
            folder = Path("runs") / experiment.name
        else:
            folder = flags.out if flags.num_seeds == 1 else flags.out / f"seed{seed}"
        runs.append((experiment, folder))
    return runs


def schedules_moved(experiment: Experiment, done: int, iterations: int) -> str:
    """What becomes of the settings that change while training, linearly in the share that is done, in a longer run.

    Args:
        experiment: the longer run.
        done: iterations done.
        iterations: how many there were to be.

    Returns:
        Such as ``--config.low.entropy from 0.004 to 0.012``, with commas between; empty if nothing changes.
    """
    moved = []
    for place, some in settings_in(experiment):
        for field in dataclasses.fields(some):
            first, last = getattr(some, field.name), getattr(some, f"final_{field.name}", None)
            if last in (None, first) or (field.name == "entropy_floor" and not first):  # 0 stands for none
                continue
            was, now = (
                first + (last - first) * min(done / total, 1)
                for total in (iterations, experiment.config.num_iterations)
            )
            moved.append(f"{flag_of(f'{place}.{field.name}')} from {was:.3g} to {now:.3g}")
    return ", ".join(moved)


def _switched(flags: RunFlags) -> tuple[Config, Method]:
    """The settings with the short flags applied."""
    changes: dict[str, Any] = {}
    if flags.total_steps is not None:
        changes["total_steps"] = flags.total_steps
    if flags.no_shield:
        changes["shield.enabled"] = False
    if flags.no_curriculum:
        # Every verdict promotes, and "a level already passed" has the share of all levels but one.
        levels = flags.config.curriculum.levels
        changes |= {"curriculum.promotion": 0.0, "curriculum.window": 0, "curriculum.earlier": 1 - 1 / levels}
    method = flags.method_settings
    if flags.no_max_operator:
        method = _without(method, "max-operator", {"max_operator": False})
    if flags.no_transe:
        method = _without(method, "transe", {"transe": 0.0})
    config = evolve(flags.config, changes)
    return without_copies(config) if flags.no_relabel else config, method


def _without(method: Method, technique: str, changes: Mapping[str, Any]) -> Method:
    try:
        return method.replace(**changes)
    except TypeError:
        raise UserError(f"--no-{technique}: the method {method.name} has no such technique") from None
