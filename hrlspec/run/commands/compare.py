"""Puts runs side by side, finished or not: ``hrlspec compare RUN RUN``, with ``--help`` for the flags."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tyro
from rich.table import Column, Table

from hrlspec.config import Checked
from hrlspec.evaluation.results import interval_from_json, interval_to_json
from hrlspec.evaluation.stats import Interval, mean_interval
from hrlspec.run.configuration import config_hash, dotted
from hrlspec.run.console import result_console
from hrlspec.run.errors import UserError
from hrlspec.run.extras import PICTURES, check_picture, drawing
from hrlspec.run.flags import parse_flags
from hrlspec.run.listing import FoundRun, look_at
from hrlspec.run.tables import cell, plain_table

Group = Sequence[FoundRun]
"""Runs that differ in nothing but the seed."""

SCORES = {
    "success_rate": ("success", "suite"),
    "return_mean": ("return", "suite"),
    "steps_mean": ("steps", "suite"),
    "spl": ("SPL", "suite"),
    "contested_choice": ("contested", "contested_choice"),
    "first_choice": ("first choice", "first_choice"),
}
"""By name of a score its title and the part of the final results that it is in."""
_WIDTH = 160


@dataclasses.dataclass(frozen=True)
class CompareFlags(Checked):
    """Shows final results and differing settings of several runs, and draws their learning curves.

    Runs that differ in nothing but the seed, the code's commit included, share a curve: their mean, from three seeds on
    with Student's t interval (95 %).
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """The run folders."""
    out: Path | None = None
    """A picture (.png or .svg) of the learning curves."""
    json: bool = False
    """Print one JSON object and nothing else on standard output."""


def main(argv: Sequence[str], *, program: str = "hrlspec compare") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage, or what is named is no run or a damaged one.
    """
    flags = parse_flags(CompareFlags, argv, program=program)
    if not flags.runs:
        raise UserError(f"expected run folders, found none (see {program} --help)")
    if flags.out is not None:
        check_picture("--out", flags.out, PICTURES)
    for path in flags.runs:
        if not path.is_dir():
            raise UserError(f"there is no folder {path}")
    runs = [look_at(path) for path in dict.fromkeys(flags.runs)]
    for run in runs:
        if run.damage:
            raise UserError(run.damage)
    groups = groups_of(runs)
    if flags.json:
        print(json.dumps(_to_json(groups), allow_nan=False), flush=True)
    else:
        console = result_console(_WIDTH)
        console.print(_results(groups))
        differing = differences(groups)
        if differing:
            console.print(_settings(differing, [label_of(group) for group in groups]))
    if flags.out is not None:
        with drawing():
            from hrlspec.run.curves import learning_curves

            flags.out.parent.mkdir(parents=True, exist_ok=True)
            learning_curves({label_of(group): [run.rows for run in group] for group in groups}, flags.out)


def groups_of(runs: Sequence[FoundRun]) -> list[Group]:
    """The runs that differ in nothing but the seed together, in the order of the first of each; no seed twice."""
    groups: dict[tuple[str, int], list[FoundRun]] = {}
    before: collections.Counter[tuple[str, int]] = collections.Counter()
    for run in runs:
        key = config_hash(_facts(run))
        # A second run of the same seed tells nothing more of how seeds differ.
        groups.setdefault((key, before[key, run.settings["seed"]]), []).append(run)
        before[key, run.settings["seed"]] += 1
    return [*groups.values()]


def differences(groups: Sequence[Group]) -> dict[str, list[Any]]:
    """What differs between groups: by dotted name of the setting its value in each, ``None`` where there is none.

    Besides settings these are ``commit`` and ``version`` of the code, and the seeds where they are not the same.
    """
    facts = [{**_facts(group[0]), "seed": sorted(run.settings["seed"] for run in group)} for group in groups]
    names = dict.fromkeys(name for each in facts for name in each)
    values = {name: [each.get(name) for each in facts] for name in names}
    return {name: some for name, some in values.items() if any(value != some[0] for value in some)}


def label_of(group: Group) -> str:
    """The folders as a shell would write them: ``runs/letter-seed{0,1,2}``."""
    paths = [str(run.path) for run in group]
    if len(paths) == 1:
        return paths[0]
    same = itertools.takewhile(lambda letters: len({*letters}) == 1, zip(*paths, strict=False))
    shared = "".join(letters[0] for letters in same).rstrip("0123456789")
    return f"{shared}{{{','.join(path.removeprefix(shared) for path in paths)}}}"


def scores_of(run: FoundRun) -> dict[str, Interval]:
    """The final results with their intervals; NaN for what was not measured, or not yet."""
    final = (run.summary or {}).get("final", {})
    nothing = Interval(math.nan, math.nan, math.nan)
    return {
        name: interval_from_json(name, found) if (found := final.get(part)) else nothing
        for name, (_, part) in SCORES.items()
    }


def means_of(group: Group) -> dict[str, Interval] | None:
    """Means over seeds with Student's t intervals; ``None`` unless there are several and all have final results."""
    if len(group) == 1 or any(run.summary is None for run in group):
        return None
    estimates = {name: [scores_of(run)[name].estimate for run in group] for name in SCORES}
    return {
        name: Interval(math.nan, math.nan, math.nan) if any(map(math.isnan, some)) else mean_interval(some)
        for name, some in estimates.items()
    }


def _facts(run: FoundRun) -> dict[str, Any]:
    """Everything in which runs may differ but the seed."""
    code = {"commit": run.record["commit"], "version": run.record["versions"]["hrlspec"]}
    return {name: value for name, value in dotted(run.settings).items() if name != "seed"} | code


def _results(groups: Sequence[Group]) -> Table:
    table = plain_table(
        "Final results",
        ["run", "trained", *(title.replace(" ", "\n") for title, _ in SCORES.values())],
        "95 % intervals as recorded with each run; of means over seeds Student's t; steps of successful episodes",
    )
    _let_fold(table.columns[0])
    for group in groups:
        for run in group:
            trained = f"{run.env_steps:,}" + f"\n{run.state}" * (run.state != "finished")
            table.add_row(str(run.path), trained, *_cells(scores_of(run)))
        means = means_of(group)
        if means is not None:
            table.add_row(f"mean of {len(group)} seeds", "", *_cells(means), style="bold")
        table.add_section()
    return table


def _cells(scores: Mapping[str, Interval]) -> list[str]:
    """Estimates with their bounds below."""
    return [cell(interval).replace(" ", "\n") for interval in scores.values()]


def _settings(differing: Mapping[str, Sequence[Any]], labels: Sequence[str]) -> Table:
    """Each value of a setting once, with the groups that have it."""
    table = plain_table("Settings that differ", ["setting", "value", "runs"])
    for column in table.columns:
        column.justify = "left"
        _let_fold(column)
    for name, values in differing.items():
        groups: dict[str, list[str]] = {}
        for value, label in zip(values, labels, strict=True):
            groups.setdefault("-" if value is None else str(value), []).append(label)
        for number, (value, some) in enumerate(groups.items()):
            table.add_row("" if number else name, value, "\n".join(some))
    return table


def _let_fold(column: Column) -> None:
    """What is too long goes on in the next line."""
    column.no_wrap, column.overflow = False, "fold"


def _to_json(groups: Sequence[Group]) -> dict[str, Any]:
    return {
        "groups": [
            {
                "label": label_of(group),
                "mean": None if (means := means_of(group)) is None else scores_to_json(means),
                "runs": [
                    {
                        "run": str(run.path),
                        "seed": run.settings["seed"],
                        "state": run.state,
                        "env_steps": run.env_steps,
                        "final": None if run.summary is None else scores_to_json(scores_of(run)),
                    }
                    for run in group
                ],
            }
            for group in groups
        ],
        "differences": differences(groups),
    }


def scores_to_json(scores: Mapping[str, Interval]) -> dict[str, Any]:
    """Estimates and bounds by name, ``None`` where there are none."""
    return {key: value for name, score in scores.items() for key, value in interval_to_json(name, score).items()}
