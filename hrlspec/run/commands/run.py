"""Trains an agent: ``hrlspec run``, with ``--help`` for the flags.

The run folder is described in ``hrlspec/run/folder.py``. Exit status: 0 done, 1 training diverged, 2 bad usage or
input, 130 interrupted with a checkpoint written.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from hrlspec.agent.low_level import Params
from hrlspec.agent_files import AgentFile
from hrlspec.evaluation import SuiteResult, aggregate
from hrlspec.learning.shards import most_devices, num_devices
from hrlspec.run import platform
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
from hrlspec.run.live_curves import CURVES, LiveCurves, draw_curves
from hrlspec.run.loop import DivergedError, Loop, UnsavedError
from hrlspec.run.progress import ProgressDisplay, duration
from hrlspec.run.run_flags import RunFlags, experiments_of, parse_run, schedules_moved
from hrlspec.run.signals import ended_by_signals
from hrlspec.run.tables import aggregate_table, final_tables
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
    """One run after the other, and what they have in common."""
    resumed = hosts.lead(lambda: _check_folders(runs, flags))
    devices = _devices(flags, runs[0][0].config.blocks, hosts)
    params = None if given is None else load_file(given)
    console = result_console()
    summaries = [
        _run(experiment, folder, resume, devices, params, flags, console, hosts)
        for (experiment, folder), resume in zip(runs, resumed, strict=True)
    ]
    if len(summaries) > 1:
        results = [SuiteResult.from_json(summary["final"]["suite"]) for summary in summaries]
        name = runs[0][0].name.rpartition("-")[0]
        console.print(aggregate_table(f"{name}, seeds {flags.seed} to {runs[-1][0].seed}", aggregate(results)))


def check_beginning(flags: RunFlags, experiment: Experiment) -> AgentFile | None:
    """Refuses what a run could not begin with, as far as that shows before JAX is used.

    Returns:
        The agent that training begins from, if one is named.

    Raises:
        UserError: a library is missing, devices do not share the blocks, or the agent does not fit.
        AgentFileError: the agent cannot be used.
    """
    if flags.wandb is not None:
        check_wandb()
    blocks = experiment.config.blocks
    if flags.devices != "auto" and blocks % flags.devices:
        raise UserError(f"--devices is {flags.devices}, expected a divisor of {blocks}, the number of --config.blocks")
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
    for setting, (there, here) in differences(file.card.config, experiment).items():
        if setting in ("env", "method") or re.match(r"(config|method_settings\..*)\.network\.", setting):
            raise UserError(f"--from {name} has {setting} = {there!r}, not {here!r}: train on with what it has")
    return file


def _devices(flags: RunFlags, blocks: int, hosts: Hosts) -> int:
    """Prepares JAX and says how many devices a run is spread over, as many of each process."""
    automatic, count = flags.devices == "auto", hosts.count
    if blocks % count:
        raise UserError(f"--config.blocks is {blocks}, expected a multiple of {count}, the number of processes")
    wanted = hosts.lead(lambda: most_devices(blocks // count, len(platform.cores())) * count)
    if not automatic:
        wanted = int(flags.devices)
    if wanted % count:
        raise UserError(f"--devices is {wanted}, expected a multiple of {count}, the number of processes")
    platform.prepare(host_devices=wanted // count)
    available = num_devices()
    if automatic:
        return most_devices(blocks // count, available // count) * count
    if wanted > available:
        raise UserError(f"--devices is {wanted}, but JAX has {available} ({jax.default_backend()})")
    return wanted


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
    experiment: Experiment,
    folder: Path,
    resume: bool,
    devices: int,
    params: Params | None,
    flags: RunFlags,
    console: PlainConsole,
    hosts: Hosts,
) -> dict[str, Any]:
    """One run from its beginning, or from where it was left, to its summary."""
    summary = hosts.lead(lambda: _results(experiment, folder) if resume else None)
    if summary is not None:
        console.say(f"{folder} is finished; its results are in summary.json")
        return summary
    before = experiment_of(read_record(folder)["config"], str(folder)) if resume else experiment
    preset = with_tasks(experiment.preset, folder, experiment.seed)
    learner = Learner(experiment, preset, devices, params)
    with (
        open_run(folder, experiment, resume=resume, may_change=_may_change(flags), wandb=flags.wandb)
        if hosts.leads
        else followed_run(folder, experiment, resume=resume) as run
    ):
        if hosts.leads:
            # Suite dag comes last: where it is there all are.
            for name, text in sorted(preset.texts.items(), reverse=True):
                run.write_tasks(name, text)
        hosts.meet(learner.trainer.shards.mesh)
        job = learner.job()
        total = job.num_iterations * job.steps_per_iteration
        with ProgressDisplay(total, experiment.name) as display:
            watched = LiveCurves(display, run, experiment.name)
            loop = Loop(job, run, watched, checkpoint_seconds=60 * flags.checkpoint_minutes, hosts=hosts)
            state = loop.restore()
            if loop.position.done:
                display.note(_continuing(experiment, before, loop.position.done))
            try:
                state = loop.train(state)
            except (DivergedError, UnsavedError) as error:
                raise SystemExit(f"error: {error}") from None
        wall = loop.position.wall
        console.say(f"{experiment.name}: trained in {duration(wall)}; evaluating")
        with ended_by_signals(f"during the final evaluation; training is saved in {folder}, --resume ends it"):
            params = on_one_device(state.params)
            return hosts.lead(lambda: _finish(learner, run, params, total, wall, console))


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
