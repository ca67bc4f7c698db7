"""Evaluations of trained agents on formulas of others, in one JSON Lines file: each line one agent on one suite.

A line holds ``run``, ``asked_steps``, ``seed``, ``suite``, the ``commit`` that evaluated, and under ``scores`` what
``python -m experiments.evaluate --json`` prints. Lines are added and never edited.
"""

from __future__ import annotations

import concurrent.futures
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.paper.panels import Run
from experiments.published.comparisons import EPISODES
from hrlspec.run.circumstances import current_commit
from hrlspec.run.errors import UserError
from hrlspec.run.places import Place, places

FILE = "evaluations.jsonl"


class Evaluation(NamedTuple):
    """One agent on one suite."""

    run: Run
    suite: str


Scores = Mapping[Evaluation, Mapping[str, Any]]
"""What was found, by evaluation."""


def read_evaluations(wanted: Sequence[Evaluation], folder: Path) -> dict[Evaluation, dict[str, Any]]:
    """Those that are known already.

    Raises:
        UserError: a line is no evaluation.
    """
    known, file = dict[tuple[str, int, str], dict[str, Any]](), folder / FILE
    for number, text in enumerate(file.read_text().splitlines() if file.exists() else (), 1):
        try:
            line = json.loads(text)
            known[line["run"], line["asked_steps"], line["suite"]] = line["scores"]
        except (ValueError, TypeError, KeyError) as error:
            reason = f"no evaluation ({error}); one whose line is deleted is made again"
            raise UserError(f"{file}, line {number}: {reason}") from error
    keys = {one: (one.run.name, one.run.total_steps, one.suite) for one in wanted}
    return {one: known[key] for one, key in keys.items() if key in known}


def evaluate(missing: Sequence[Evaluation], *, work: Path, folder: Path, jobs: int | None) -> Iterator[Evaluation]:
    """Evaluates agents, several side by side, and adds a line for each; yields each when it is done.

    Args:
        missing: agents whose run folders are in ``work``.
        work: the run folders.
        folder: of the file.
        jobs: side by side; one for each accelerator or CPU core if ``None``.

    Raises:
        UserError: an evaluation failed; the others that had begun are kept.
    """
    free = places(jobs)
    with concurrent.futures.ThreadPoolExecutor(len(free)) as pool:

        def one(evaluation: Evaluation) -> dict[str, Any]:
            place = free.pop()
            try:
                return _scores(evaluation, work, place)
            finally:
                free.append(place)

        futures = {pool.submit(one, evaluation): evaluation for evaluation in missing}
        try:
            for future in concurrent.futures.as_completed(futures):
                _add(futures[future], future.result(), folder)
                yield futures[future]
        finally:
            pool.shutdown(cancel_futures=True)


def _scores(evaluation: Evaluation, work: Path, place: Place) -> dict[str, Any]:
    """What ``experiments.evaluate`` says of an agent."""
    how = ["--protocol", "jaxolotl"] if "/" in evaluation.suite else ["--episodes", str(2 * EPISODES)]  # two chains
    flags = ["--run", str(work / evaluation.run.name), "--suite", evaluation.suite, *how, "--json"]
    command = [sys.executable, "-m", "experiments.evaluate", *flags]
    with place.start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        said, complaint = process.communicate()
    if process.returncode:
        what = f"evaluating {evaluation.run.name} on {evaluation.suite}"
        raise UserError(f"{what} failed: {complaint.decode(errors='replace').strip()}")
    found: dict[str, Any] = json.loads(said)
    return {name: value for name, value in found.items() if name not in ("run", "suite", "per_task", "per_depth")}


def _add(evaluation: Evaluation, scores: Mapping[str, Any], folder: Path) -> None:
    run = evaluation.run
    about = {"run": run.name, "asked_steps": run.total_steps, "seed": run.seed, "suite": evaluation.suite}
    line = json.dumps({**about, "commit": current_commit(), "scores": scores}, separators=(",", ":"))
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / FILE).open("a") as file:
        file.write(line + "\n")
