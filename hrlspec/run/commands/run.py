"""Trains an agent: ``hrlspec run``, with ``--help`` for the flags.

The run folder is described in ``hrlspec/run/folder.py``. Exit status: 0 done, 1 training diverged, 2 bad usage or
input, 130 interrupted with a checkpoint written.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from hrlspec.evaluation import SuiteResult, aggregate
from hrlspec.run import platform
from hrlspec.run.errors import Interrupted, UserError
from hrlspec.run.experiment import Experiment, experiment_of
from hrlspec.run.folder import RunFolder, open_run, read_metrics, read_record, read_summary
from hrlspec.run.learner import Learner
from hrlspec.run.loop import DivergedError, Loop
from hrlspec.run.progress import ProgressDisplay, duration
from hrlspec.run.run_flags import RunFlags, experiments_of, parse_run
from hrlspec.run.tables import aggregate_table, final_tables, result_console
from hrlspec.run.unseen import with_tasks


def main(argv: Sequence[str], *, program: str = "hrlspec run") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage or input; nothing was written.
        Interrupted: stopped by a signal; a checkpoint was written.
        SystemExit: with a message, when training diverged.
    """
    flags = parse_run(argv, program=program)
    runs = experiments_of(flags)
    resumed = _check_folders(runs, flags)
    platform.prepare()
    console = result_console()
    summaries = [
        _run(experiment, folder, resume, flags, console)
        for (experiment, folder), resume in zip(runs, resumed, strict=True)
    ]
    if len(summaries) > 1:
        results = [SuiteResult.from_json(summary["final"]["suite"]) for summary in summaries]
        name = runs[0][0].name.rpartition("-")[0]
        console.print(aggregate_table(f"{name}, seeds {flags.seed} to {runs[-1][0].seed}", aggregate(results)))


def _check_folders(runs: Sequence[tuple[Experiment, Path]], flags: RunFlags) -> list[bool]:
    """For each run whether to resume it; refuses before the first begins what would fail at a later one."""
    begun = [(folder / "config.json").exists() for _, folder in runs]
    if not flags.resume:
        for (_, folder), exists in zip(runs, begun, strict=True):
            if exists:
                raise UserError(f"{folder} holds a run already: continue it with --resume, or choose another --out")
        return begun
    if not any(begun):
        raise UserError(f"there is no run to resume in {runs[0][1]}")
    for (experiment, folder), exists in zip(runs, begun, strict=True):
        record = read_record(folder) if exists else {}
        if exists and read_summary(folder) is not None and experiment_of(record["config"], str(folder)) != experiment:
            raise UserError(f"{folder} holds a finished run with other settings; choose another --out")
    return begun


def _run(experiment: Experiment, folder: Path, resume: bool, flags: RunFlags, console: Console) -> dict[str, Any]:
    """One run from its beginning, or from where it was left, to its summary."""
    summary = read_summary(folder) if resume else None
    if summary is not None:
        console.print(f"{folder} is finished; its results are in summary.json", highlight=False, soft_wrap=True)
        return summary
    preset = with_tasks(experiment.preset, folder, experiment.seed)
    learner = Learner(experiment, preset)
    with open_run(folder, experiment, resume=resume) as run:
        for name, text in preset.texts.items():
            run.write_tasks(name, text)
        job = learner.job()
        total = job.num_iterations * job.steps_per_iteration
        with ProgressDisplay(total, experiment.name) as display:
            loop = Loop(job, run, display, checkpoint_seconds=60 * flags.checkpoint_minutes)
            state = loop.restore()
            begin = loop.position.done * job.steps_per_iteration
            if begin:
                display.note(f"continuing after {begin:,} steps")
            try:
                state = loop.train(state)
            except DivergedError as error:
                raise SystemExit(f"error: {error}") from None
        wall = loop.position.wall
        console.print(f"{experiment.name}: trained in {duration(wall)}; evaluating", highlight=False, soft_wrap=True)
        try:
            return _finish(learner, run, state.params, total, wall, console)
        except KeyboardInterrupt:
            raise Interrupted(f"during the final evaluation; training is saved in {folder}, --resume ends it") from None


def _finish(
    learner: Learner, run: RunFolder, params: Any, env_steps: int, wall: float, console: Console
) -> dict[str, Any]:
    """Evaluates, prints, draws; the summary comes last and so says that nothing is missing."""
    results = learner.final_results(params)
    for table in final_tables(results):
        console.print(table)
    pictures = _draw(learner, run, params, console)
    summary = {
        "name": learner.experiment.name,
        "env_steps": env_steps,
        "wall_s": wall,
        "steps_per_s": env_steps / wall,  # compilation and evaluations included
        "final": results.to_json(),
        "pictures": pictures,
    }
    run.write_summary(summary)
    console.print(f"results, curves and pictures: {run.path}", highlight=False, soft_wrap=True)
    written = read_summary(run.path)
    assert written is not None
    return written


def _draw(learner: Learner, run: RunFolder, params: Any, console: Console) -> list[str]:
    """Learning curves and example trajectories; a missing extra costs the pictures, not the results."""
    try:
        from hrlspec.run import plots

        files = [plots.learning_curves({learner.experiment.name: read_metrics(run.path)}, run.plots / "curves.png")]
        files += plots.examples(
            jax.random.key(learner.experiment.seed),
            learner.agent,
            params,
            learner.machine,
            learner.test_suite,
            run.plots,
        )
    except ImportError as error:
        console.print(f'no pictures ({error}): pip install "hrlspec\\[plot]"', soft_wrap=True)
        return []
    return [str(file.relative_to(run.path)) for file in files]
