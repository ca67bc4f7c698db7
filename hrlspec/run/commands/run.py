"""Trains an agent: ``hrlspec run``, with ``--help`` for the flags.

The run folder is described in ``hrlspec/run/folder.py``. Exit status: 0 done, 1 training diverged, 2 bad usage or
input, 130 interrupted with a checkpoint written.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from hrlspec.agent.low_level import Params
from hrlspec.agent_files import AgentFile
from hrlspec.evaluation import SuiteResult, aggregate
from hrlspec.run.configuration import differences
from hrlspec.run.console import PlainConsole, result_console
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import Experiment, experiment_of
from hrlspec.run.extras import check_wandb, drawing
from hrlspec.run.folder import (
    RunFolder,
    check_place,
    check_same,
    followed_run,
    holds_run,
    open_run,
    read_record,
    read_summary,
)
from hrlspec.run.hosts import Hosts, joined
from hrlspec.run.learner import Learner, on_one_device
from hrlspec.run.learners import together
from hrlspec.run.live_curves import CURVES, LiveCurves, draw_curves
from hrlspec.run.loop import Loop
from hrlspec.run.progress import MeanDisplay, ProgressDisplay, duration
from hrlspec.run.run_flags import RunFlags, experiments_of, parse_run, schedules_moved
from hrlspec.run.signals import ended_by_signals
from hrlspec.run.spread import Spread, spread
from hrlspec.run.tables import aggregate_table, final_tables
from hrlspec.run.track import DivergedError, Track, UnsavedError
from hrlspec.run.trained import find_file, load_file
from hrlspec.run.unseen import with_tasks


def main(argv: Sequence[str], *, program: str = "hrlspec run") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage or input; nothing was written.
        AgentFileError: the agent to begin from cannot be used; nothing was written.
        Interrupted: stopped by a signal; a checkpoint was written.
        SystemExit: with a message, when training diverged.
    """
    flags = parse_run(argv, program=program)
    runs = experiments_of(flags)
    given = check_beginning(flags, runs[0][0])
    with joined(flags.distributed, flags.num_processes, flags.process_id) as hosts:
        _run_all(runs, given, flags, hosts)


def _run_all(runs: Sequence[tuple[Experiment, Path]], given: AgentFile | None, flags: RunFlags, hosts: Hosts) -> None:
    """All runs, one after another or side by side, and what they have in common."""
    resumed = hosts.lead(lambda: _check_folders(runs, flags))
    summaries: list[Any] = hosts.lead(
        lambda: [_results(*run) if resume else None for run, resume in zip(runs, resumed, strict=True)]
    )
    left = [number for number, summary in enumerate(summaries) if summary is None]
    how = spread(flags, runs[0][0].config.blocks, [runs[number][1] for number in left], hosts)
    params = None if given is None else load_file(given)
    console = result_console()
    for (_, folder), summary in zip(runs, summaries, strict=True):
        if summary is not None:
            console.say(f"{folder} is finished; its results are in summary.json")
    for numbers in [left] if how.side_by_side else [[number] for number in left]:
        begun = [(*runs[number], resumed[number]) for number in numbers]
        for number, summary in zip(numbers, _run(begun, how, params, flags, console, hosts), strict=True):
            summaries[number] = summary
    if len(summaries) > 1:
        results = [SuiteResult.from_json(summary["final"]["suite"]) for summary in summaries]
        console.print(aggregate_table(_name([experiment for experiment, _ in runs]), aggregate(results)))


def check_beginning(flags: RunFlags, experiment: Experiment) -> AgentFile | None:
    """Refuses what a run could not begin with, as far as that shows before JAX is used.

    Returns:
        The agent that training begins from, if one is named.

    Raises:
        UserError: a library is missing, devices do not share blocks or seeds, or the agent does not fit.
        AgentFileError: the agent cannot be used.
    """
    if flags.wandb is not None:
        check_wandb()
    shared, what = experiment.config.blocks, "--config.blocks"
    if flags.parallel_seeds:
        shared, what = flags.num_seeds, "seeds"
    if flags.devices != "auto" and shared % flags.devices:
        raise UserError(f"--devices is {flags.devices}, expected a divisor of {shared}, the number of {what}")
    return None if flags.from_ is None else _file_that_fits(flags.from_, experiment)


def check_folder(experiment: Experiment, folder: Path, flags: RunFlags) -> bool:
    """Whether a run that is to be made, or resumed where it was begun, is finished.

    Raises:
        UserError: it could be neither made nor resumed.
    """
    if not holds_run(folder):
        check_place(folder, resume=False)
        return False
    _check_resumable(experiment, folder, flags)
    return _results(experiment, folder) is not None


def _file_that_fits(name: str, experiment: Experiment) -> AgentFile:
    """The agent that training begins from, if it has the experiment's environment, method and networks.

    Raises:
        UserError: it has not.
    """
    file = find_file(name)
    origin = experiment_of(file.card.config, name, to_act=True)
    for setting, (there, here) in differences(origin, experiment).items():
        if setting in ("env", "method") or re.match(r"(config|method_settings\..*)\.network\.", setting):
            raise UserError(f"--from {name} has {setting} = {there!r}, not {here!r}: train on with what it has")
    return file


def _check_folders(runs: Sequence[tuple[Experiment, Path]], flags: RunFlags) -> list[bool]:
    """For each run whether to resume it; refuses before the first begins what would fail at a later one."""
    begun = [flags.resume and holds_run(folder) for _, folder in runs]
    if flags.resume and not any(begun):
        raise UserError(f"there is no run to resume in {runs[0][1]}")
    for (experiment, folder), resume in zip(runs, begun, strict=True):
        if resume:
            _check_resumable(experiment, folder, flags)
        else:
            check_place(folder, resume=False)
    return begun


def _check_resumable(experiment: Experiment, folder: Path, flags: RunFlags) -> None:
    """Refuses to continue another run, or this one with fewer steps than it was to have."""
    record = read_record(folder)
    before = experiment_of(record["config"], str(folder))
    check_same(folder, record["config"], experiment, _may_change(flags))
    if experiment.config.total_steps < before.config.total_steps:
        raise UserError(f"{folder} was begun with --total-steps {before.config.total_steps}: give more, or the same")
    if _results(experiment, folder) is None:
        check_place(folder, resume=True)


def _may_change(flags: RunFlags) -> tuple[str, ...]:
    """In what a resumed run may differ: its length, if it is given and not the preset's."""
    return () if flags.total_steps is None else ("config.total_steps",)


def _results(experiment: Experiment, folder: Path) -> dict[str, Any] | None:
    """The summary of a run that is finished, unless it is to become longer."""
    summary = read_summary(folder)
    config = experiment.config
    if summary is None or "pictures" not in summary:
        return None
    return summary if summary["env_steps"] >= config.num_iterations * config.steps_per_iteration else None


def _run(
    runs: Sequence[tuple[Experiment, Path, bool]],
    how: Spread,
    params: Params | None,
    flags: RunFlags,
    console: PlainConsole,
    hosts: Hosts,
) -> list[dict[str, Any]]:
    """A run, or several side by side, from their beginning, or from where they were left, to their summaries."""
    experiments = [experiment for experiment, _, _ in runs]
    first, folder, resume = runs[0]
    before = experiment_of(read_record(folder)["config"], str(folder)) if resume else first
    learners = _learners(runs, 1 if how.side_by_side else how.devices, params)
    with contextlib.ExitStack() as stack:
        folders = [stack.enter_context(_opened(*run, flags, hosts)) for run in runs]
        if hosts.leads:
            for learner, run in zip(learners, folders, strict=True):
                # Suite dag comes last: where it is there all are.
                for name, text in sorted(learner.preset.texts.items(), reverse=True):
                    run.write_tasks(name, text)
        hosts.meet(learners[0].trainer.shards.mesh)
        jobs = [learner.job() for learner in learners]
        total, name = jobs[0].num_iterations * jobs[0].steps_per_iteration, _name(experiments)
        with ProgressDisplay(total, name) as display:
            shown = MeanDisplay(display, len(runs)) if how.side_by_side else display
            curves = [
                LiveCurves(shown, run, one.name, len(runs)) for one, run in zip(experiments, folders, strict=True)
            ]
            loop = Loop(
                [Track(*parts) for parts in zip(jobs, folders, curves, strict=True)],
                together(learners, how.devices) if how.side_by_side else None,
                checkpoint_seconds=60 * flags.checkpoint_minutes,
                hosts=hosts,
            )
            state = loop.restore(how.step)
            if loop.position.done:
                display.note(_continuing(first, before, loop.position.done))
            try:
                state = loop.train(state)
            except (DivergedError, UnsavedError) as error:
                raise SystemExit(f"error: {error}") from None
        wall = loop.position.wall
        console.say(f"{name}: trained in {duration(wall)}; evaluating")
        with ended_by_signals(f"during the final evaluation; training is saved in {loop.where}, --resume ends it"):
            summaries = []
            for learner, run, part in zip(learners, folders, loop.parts(state), strict=True):
                finish = functools.partial(_finish, learner, run, on_one_device(part.params), total, wall, console)
                summaries.append(hosts.lead(finish))
            return summaries


def _learners(runs: Sequence[tuple[Experiment, Path, bool]], devices: int, params: Params | None) -> list[Learner]:
    """One for each run, with the same programs."""
    presets = [with_tasks(experiment.preset, folder, experiment.seed) for experiment, folder, _ in runs]
    first = Learner(runs[0][0], presets[0], devices, params)
    return [first, *(first.beside(run[0], preset) for run, preset in zip(runs[1:], presets[1:], strict=True))]


def _opened(
    experiment: Experiment, folder: Path, resume: bool, flags: RunFlags, hosts: Hosts
) -> contextlib.AbstractContextManager[RunFolder]:
    """The folder of a run, to write to on the first process alone."""
    if not hosts.leads:
        return followed_run(folder, experiment, resume=resume)
    return open_run(folder, experiment, resume=resume, may_change=_may_change(flags), wandb=flags.wandb)


def _name(experiments: Sequence[Experiment]) -> str:
    """What one or several that differ in their seeds are called."""
    first, last = experiments[0], experiments[-1]
    if len(experiments) == 1:
        return first.name
    return f"{first.name.rpartition('-')[0]}, seeds {first.seed} to {last.seed}"


def _continuing(experiment: Experiment, before: Experiment, done: int) -> str:
    """What is said of a run that goes on."""
    said = f"continuing after {done * experiment.config.steps_per_iteration:,} steps"
    iterations = before.config.num_iterations
    if experiment.config.num_iterations == iterations:
        return said
    said += f", now to {experiment.config.total_steps:,} instead of {before.config.total_steps:,}"
    moved = schedules_moved(experiment, done, iterations)
    if moved:
        said += f"; what changes while training is where the longer one puts it: {moved}"
    return said


def _finish(
    learner: Learner, run: RunFolder, params: Any, env_steps: int, wall: float, console: PlainConsole
) -> dict[str, Any]:
    """Evaluates, writes the results, prints them, draws; the summary names the pictures once nothing is missing."""
    results = learner.final_results(params)
    summary = {
        "name": learner.experiment.name,
        "env_steps": env_steps,
        "wall_s": wall,
        "steps_per_s": env_steps / wall,  # compilation and evaluations included
        "final": results.to_json(),
    }
    run.write_summary(summary)
    run.tell(env_steps, {"final": results.to_json()})
    for table in final_tables(results):
        console.print(table)
    pictures = []
    try:
        for file in _draw(learner, run, params):
            pictures.append(str(file.relative_to(run.path)))
    except UserError as error:
        console.say(str(error))
    run.write_summary({**summary, "pictures": pictures})
    console.say(f"results, curves and pictures: {run.path}")
    written = read_summary(run.path)
    assert written is not None
    return written


def _draw(learner: Learner, run: RunFolder, params: Any) -> Iterator[Path]:
    """Learning curves and example trajectories, one after the other.

    Raises:
        UserError: one cannot be drawn, which costs the pictures and not the results.
    """
    with drawing():
        from hrlspec.run import plots

        draw_curves(run, learner.experiment.name)
        yield run.plots / CURVES
        yield from plots.examples(
            jax.random.key(learner.experiment.seed),
            learner.agent,
            params,
            learner.machine,
            learner.validation_suite,
            run.plots,
        )
