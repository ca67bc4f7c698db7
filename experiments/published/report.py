"""The page that puts our agents beside what others have published."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.paper.panels import Run
from experiments.paper.records import Record
from experiments.published.comparisons import COMPARISONS, EPISODES, Comparison
from experiments.published.evaluations import Scores
from hrlspec.evaluation.stats import Interval, mean_interval
from hrlspec.presets.peers import go_on_for_ever
from hrlspec.run.progress import duration

PUBLISHED = Path(__file__).with_name("published.csv")
"""Columns ``suite``, ``formula``, ``method``, ``metric``, ``value``, ``source``: the peers' own files, cited by row."""

_ABOUT = f"""\
Written by `python -m experiments.peers` from the records beside it. Ours is trained with the settings of recipe
`hrlspec` on random tasks in SPECTRL, none of which is a formula below unless a line says otherwise, and acts on each
formula's automaton as the package translates it: {EPISODES} episodes of each formula and seed, actions sampled, layouts
drawn anew. Success is the mean over seeds with Student's t interval (95 %); steps are those of successful episodes;
rounds are accepting transitions within the horizon, one round after another in the order that
[the page on tasks](../../docs/tasks.md) gives, so that other visits do not count. Published numbers are from the peers'
own files, `experiments/published/published.csv` names them row by row; they were not run here."""


def page(records: Mapping[Run, Record], scores: Scores) -> Iterator[str]:
    """The lines of the page (Markdown), with the worlds that have an evaluation."""
    published = read_published()
    yield "# Beside published results"
    yield ""
    yield _ABOUT
    chains = dict[str, list[str]]()
    for comparison in COMPARISONS.values():
        if comparison.suites == ("dag",):
            series = comparison.env.rpartition("-")[0]
            chains.setdefault(series, []).extend(_chain(comparison, scores))
            continue
        found = {suite: _of_suite(scores, comparison, suite) for suite in comparison.suites}
        if any(found.values()):
            yield from _world(comparison, records, {suite: some for suite, some in found.items() if some}, published)
    for series, rows in chains.items():
        if rows:
            yield ""
            yield f"## {series}-k"
            yield ""
            yield f"The first move decides which of two chains can be completed; {COMPARISONS[series + '-1'].differs}."
            yield "An agent that sees one sub-task at a time has 0.5 for every k but 1."
            yield ""
            yield "| k | seeds | success | steps | optimum |"
            yield "|---|---|---|---|---|"
            yield from rows


Published = Mapping[tuple[str, str], Mapping[str, Mapping[str, float]]]
"""By suite and formula: what each method has, by metric. The formula of means over a suite is ``MEAN``."""


def read_published(file: Path = PUBLISHED) -> Published:
    """The peers' results."""
    found: dict[tuple[str, str], dict[str, dict[str, float]]] = {}
    with file.open(newline="", encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            formula = "MEAN" if row["formula"].startswith(("MEAN", "ALL")) else row["formula"]
            methods = found.setdefault((row["suite"], formula), {})
            # Means over seeds come before what one seed had.
            methods.setdefault(row["method"], {}).setdefault(row["metric"], float(row["value"]))
    return found


def _of_suite(scores: Scores, comparison: Comparison, suite: str) -> list[Mapping[str, Any]]:
    return [found for (run, of), found in scores.items() if run.env == comparison.env and of == suite]


def _world(
    comparison: Comparison,
    records: Mapping[Run, Record],
    found: Mapping[str, Sequence[Mapping[str, Any]]],
    published: Published,
) -> Iterator[str]:
    seconds = [record.wall_s for run, record in records.items() if run.env == comparison.env]
    yield ""
    yield f"## {comparison.env}"
    yield ""
    yield f"{comparison.steps:,} environment steps a seed, {duration(float(np.mean(seconds)))} on one core of two."
    yield f"What differs: {comparison.differs}."
    for suite, some in found.items():
        yield ""
        yield f"### {suite}, {len(some)} {'seed' if len(some) == 1 else 'seeds'}"
        yield ""
        yield from _table(suite, some, published)


def _table(suite: str, some: Sequence[Mapping[str, Any]], published: Published) -> Iterator[str]:
    forever = go_on_for_ever(suite)
    metric = "accepting_visits" if forever else "success_rate"
    methods = list(dict.fromkeys(method for (of, _), row in published.items() if of == suite for method in row))
    columns = ["formula", *(["rounds", "violated"] if forever else ["success", "steps"]), *methods]
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    names = [row["formula"] for row in some[0]["per_formula"]]
    for number, formula in enumerate((*names, "MEAN")):
        ours = _ours(some, number if formula != "MEAN" else None, forever)
        theirs = published.get((suite, formula), {})
        cells = [_cell(theirs.get(method, {}), metric) for method in methods]
        shown = "mean" if formula == "MEAN" else "`" + formula.replace("|", "\\|") + "`"
        yield f"| {' | '.join([shown, *ours, *cells])} |"


def _ours(some: Sequence[Mapping[str, Any]], number: int | None, forever: bool) -> list[str]:
    """Our two cells for a formula, or for all of them."""

    def over_seeds(name: str) -> Interval:
        rows = [scores["per_formula"] if number is None else [scores["per_formula"][number]] for scores in some]
        values = [[row[name] for row in of_seed if row[name] is not None] for of_seed in rows]
        return mean_interval([float(np.mean(seed)) for seed in values if seed])

    if forever:
        return [_with_bounds(over_seeds("rounds_mean"), 2), f"{over_seeds('violation_rate').estimate:.3f}"]
    return [_with_bounds(over_seeds("success_rate"), 3), f"{over_seeds('steps_mean').estimate:.1f}"]


def _chain(comparison: Comparison, scores: Scores) -> Iterator[str]:
    found = _of_suite(scores, comparison, "dag")
    if found:
        success = _with_bounds(mean_interval([some["success_rate"] for some in found]), 3)
        steps = [some["steps_mean"] for some in found if some["steps_mean"] is not None]
        optimum = f"{found[0]['optimal_steps_mean']:.0f}"
        k = comparison.env.rpartition("-")[2]
        yield f"| {k} | {len(found)} | {success} | {np.mean(steps) if steps else math.nan:.1f} | {optimum} |"


def _with_bounds(interval: Interval, digits: int) -> str:
    estimate = f"{interval.estimate:.{digits}f}"
    if math.isnan(interval.low):
        return estimate
    return f"{estimate} [{interval.low:.{digits}f}, {interval.high:.{digits}f}]"


def _cell(theirs: Mapping[str, float], metric: str) -> str:
    if metric not in theirs:
        return ""
    steps = theirs.get("steps_of_successes")
    shown = f"{theirs[metric]:.{2 if metric == 'accepting_visits' else 3}f}"
    return f"{shown} / {steps:.1f}" if steps is not None else shown
