"""Evaluations of trained agents on formulas of others, in one JSON Lines file: each line one agent on one suite.

A line holds ``run``, ``asked_steps``, ``seed`` (of the run, and of the layouts), ``suite``, the ``commit`` that
evaluated, and under ``scores`` what ``python -m experiments.evaluate --json`` prints. Lines are added and never edited;
commands side by side may add to one file.
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
from hrlspec.presets.peers import peer_formulas, peer_suites
from hrlspec.run.circumstances import current_commit
from hrlspec.run.console import counted
from hrlspec.run.errors import UserError
from hrlspec.run.places import Place, places, tethered
from hrlspec.run.planned import problem_of
from hrlspec.spec import bare_lines

FILE = "evaluations.jsonl"


class Evaluation(NamedTuple):
    """One agent on one suite."""

    run: Run
    suite: str


OF_FORMULA = (
    "formula",
    "cut",
    "silent",
    "success_rate",
    "violation_rate",
    "ended_rate",
    "steps_mean",
    "rounds_mean",
    "no_round_rate",
)
"""What is used of the scores on a formula."""
OF_CHAINS = ("success_rate", "steps_mean", "optimal_steps_mean")
"""What is used of those on a suite in SPECTRL."""

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
            known[line["run"], line["asked_steps"], line["suite"]] = _checked(line["suite"], line["scores"])
        except (ValueError, TypeError, KeyError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else error
            reason = f"no evaluation ({what}); one whose line is deleted is made again"
            raise UserError(f"{file}, line {number}: {reason}") from error
    keys = {one: (one.run.name, one.run.total_steps, one.suite) for one in wanted}
    return {one: known[key] for one, key in keys.items() if key in known}


def _checked(suite: str, scores: dict[str, Any]) -> dict[str, Any]:
    """The scores.

    Raises:
        KeyError: something that is used is missing.
        TypeError: they are nothing of the kind.
        ValueError: the suite has other formulas now.
    """
    rows, names = (scores["per_formula"], OF_FORMULA) if "/" in suite else ([scores], OF_CHAINS)
    for row in rows:
        for name in names:
            row[name]
    if suite in peer_suites():
        formulas = [" ".join(line.split()) for line in bare_lines(peer_formulas(suite)) if line.strip()]
        if [row["formula"] for row in rows] != formulas:
            raise ValueError(f"{suite} has other formulas now")
    return scores


def evaluate(missing: Sequence[Evaluation], *, work: Path, folder: Path, jobs: int | None) -> Iterator[Evaluation]:
    """Evaluates agents, several side by side, and adds a line for each; yields each when it is done.

    Args:
        missing: agents whose run folders are in ``work``.
        work: the run folders.
        folder: of the file.
        jobs: side by side; one for each accelerator or CPU core if ``None``.

    Raises:
        UserError: evaluations failed; the others are done.
    """
    free, failed = places(jobs), list[str]()
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
                try:
                    scores = future.result()
                except UserError as error:
                    failed.append(str(error))
                    continue
                _add(futures[future], scores, folder)
                yield futures[future]
        finally:
            pool.shutdown(cancel_futures=True)
    if failed:
        raise UserError(f"{counted(len(failed), 'evaluation')} failed; {failed[0]}; the same command tries again")


def flags_of(evaluation: Evaluation, work: Path) -> list[str]:
    """Of ``experiments.evaluate``. Each run has layouts of its own, as intervals over runs suppose."""
    how = ["--protocol", "jaxolotl"] if "/" in evaluation.suite else ["--episodes", str(2 * EPISODES)]  # two chains
    which = ["--run", str(work / evaluation.run.name), "--suite", evaluation.suite]
    return [*which, *how, "--seed", str(evaluation.run.seed), "--json"]


def _scores(evaluation: Evaluation, work: Path, place: Place) -> dict[str, Any]:
    """What ``experiments.evaluate`` says of an agent."""
    command = [sys.executable, "-m", "experiments.evaluate", *flags_of(evaluation, work)]
    with place.start(tethered(command), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        said, complaint = process.communicate()
    problem = problem_of(process.returncode)
    if problem is not None:
        last_words = ["", *complaint.decode(errors="replace").splitlines()][-1]
        raise UserError(f"{evaluation.run.name} on {evaluation.suite} ({problem}): {last_words or 'nothing was said'}")
    found: dict[str, Any] = json.loads(said)
    return {name: value for name, value in found.items() if name not in ("run", "suite", "per_task", "per_depth")}


def _add(evaluation: Evaluation, scores: Mapping[str, Any], folder: Path) -> None:
    run = evaluation.run
    about = {"run": run.name, "asked_steps": run.total_steps, "seed": run.seed, "suite": evaluation.suite}
    line = json.dumps({**about, "commit": current_commit(), "scores": scores}, separators=(",", ":"))
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / FILE).open("ab", buffering=0) as file:
        file.write(f"{line}\n".encode())  # at once: others may add lines of theirs
