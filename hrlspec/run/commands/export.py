"""Writes the agent of a run as a file: ``hrlspec export --run DIR``, with ``--help`` for the flags.

Exit status: 0 done, 2 bad usage or input.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import jax

from hrlspec.agent_files import Card, write_agent
from hrlspec.api import TrainedAgent
from hrlspec.config import Checked, setting
from hrlspec.evaluation import SuiteEvaluation, SuiteResult, final_evaluation, make_cases
from hrlspec.presets import Preset
from hrlspec.presets.suite_rules import VALIDATION
from hrlspec.run import platform
from hrlspec.run.circumstances import circumstances
from hrlspec.run.console import PlainConsole, result_console
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import experiment_of
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import check_writable, read_record
from hrlspec.run.learner import LAYOUTS, spread
from hrlspec.run.tables import plain_table
from hrlspec.run.trained import find_trained
from hrlspec.run.unseen import with_tasks

_DIGITS = 3
"""Of the bounds that a card states."""


@dataclasses.dataclass(frozen=True)
class ExportFlags(Checked):
    """Writes a trained agent into NAME.safetensors and, beside it, what it is into NAME.json.

    The former holds the parameters that acting needs; the latter settings, origin, and what the agent achieves on the
    test suites of its environment, on which it is evaluated for that.
    """

    run: Path
    """The run folder."""
    out: Path | None = None
    """A name, or a folder, where the run's name is taken; agent in the run folder if not given."""
    step: int | None = None
    """The checkpoint to export; the newest if not given."""
    tasks: int = setting(200, least=1)
    """Tasks of each test suite, at most as many as it has; 10 layouts for each."""


def main(argv: Sequence[str], *, program: str = "hrlspec export") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage or input; nothing was written.
        CheckpointError: there is no usable checkpoint.
    """
    flags = parse_flags(ExportFlags, argv, program=program)
    name = experiment_of(read_record(flags.run)["config"], str(flags.run), to_act=True).name
    file = _file(flags, name)
    check_writable(file.parent)
    for there in (file, file.with_suffix(".json")):
        if there.exists():
            raise UserError(f"{there} is there already; choose another --out")
    platform.prepare()
    console = result_console()
    card = export(flags.run, file, step=flags.step, num_tasks=flags.tasks, console=console)
    table = plain_table(f"{name}, {card.env_steps:,} steps", ["test suite", "success [95 %]", "at least"], "")
    for suite, least in card.success_at_least.items():
        rate = SuiteResult.from_json(card.results[suite] | {"per_task": []}).total.success_rate
        table.add_row(suite, str(rate), f"{least:.{_DIGITS}f}")
    console.print(table)
    console.say(f"written: {file} and {file.with_suffix('.json')}")


def export(run: Path, file: Path, *, step: int | None, num_tasks: int, console: PlainConsole) -> Card:
    """Evaluates the agent of a run and writes it, replacing what is there.

    Args:
        run: its folder.
        file: ends in ``.safetensors``; the folder is made.
        step: the checkpoint; the newest if ``None``.
        num_tasks: of each test suite, at most.
        console: is told what is done.

    Raises:
        UserError: the run cannot be read here, or its environment or its method is not one of the library.
        CheckpointError: there is no usable checkpoint.
    """
    record = read_record(run)
    experiment = experiment_of(record["config"], str(run), to_act=True)
    if experiment.is_foreign:
        raise UserError(
            f"{run} is of {experiment.env}, {experiment.method}: agents are exported whose environment and method are "
            "hrlspec's own, since reading a file must not run the code that it names"
        )
    trained, facts = find_trained(run, None, step).load()
    preset = with_tasks(experiment.preset, run, experiment.seed)
    results = {}
    for number, name in enumerate(name for name in preset.suite_names if not name.endswith(VALIDATION)):
        console.say(f"{experiment.name}: evaluating on {name}")
        key = jax.random.fold_in(jax.random.key(experiment.seed), number)
        results[name] = _evaluated(key, trained, preset, name, num_tasks)
    file.parent.mkdir(parents=True, exist_ok=True)
    here = circumstances()
    try:
        return write_agent(
            file,
            trained.agent,
            trained.params,
            config=record["config"],
            env_steps=facts["checkpoint_step"],
            trained={name: record[name] for name in ("commit", "versions")},
            evaluated={name: here[name] for name in ("commit", "versions")},
            results={name: _summary(result) for name, result in results.items()},
            success_at_least={name: _rounded_down(result) for name, result in results.items()},
        )
    except ImportError as error:
        raise UserError(str(error)) from error


def _file(flags: ExportFlags, name: str) -> Path:
    """Where the parameters go."""
    if flags.out is None:
        return flags.run / "agent.safetensors"
    if flags.out.is_dir():
        return flags.out / f"{name}.safetensors"
    stem = flags.out.stem if flags.out.suffix in (".safetensors", ".json") else flags.out.name
    return flags.out.with_name(f"{stem}.safetensors")


def _evaluated(key: jax.Array, trained: TrainedAgent, preset: Preset, name: str, num_tasks: int) -> SuiteResult:
    """The agent on a test suite, in the layouts that are left to the end."""
    env, suite, seed = trained.agent.env, preset.suite(name), LAYOUTS["test"]
    some = suite.take(spread(len(suite), num_tasks))
    try:
        make_cases(env, some, layouts_per_task=1, seed=seed)  # which is quicker to refuse
        evaluation = final_evaluation(env, some, episodes=len(some), seed=seed)
    except ValueError:  # nothing can satisfy some of the tasks in time: there they fail, and no case is left out
        evaluation = SuiteEvaluation(make_cases(env, some, seed=seed, optima=False))
    return evaluation(key, trained.agent, trained.params, trained.rewards)


def _summary(result: SuiteResult) -> dict[str, object]:
    """A result without those of single tasks."""
    return {name: value for name, value in result.to_json().items() if name != "per_task"}


def _rounded_down(result: SuiteResult) -> float:
    """The lower end of the success rate's interval."""
    return math.floor(result.total.success_rate.low * 10**_DIGITS) / 10**_DIGITS
