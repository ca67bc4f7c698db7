"""The page that puts our agents beside what others have published."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.paper.panels import Run
from experiments.paper.records import Record
from experiments.published.comparisons import COMPARISONS, EPISODES, Comparison
from experiments.published.evaluations import Scores
from hrlspec.evaluation.stats import Interval, mean_interval
from hrlspec.presets.peers import go_on_for_ever, peer_formulas
from hrlspec.run.configuration import config_hash
from hrlspec.run.progress import duration

PUBLISHED = Path(__file__).with_name("published.csv")
"""Columns ``suite``, ``formula``, ``method``, ``metric``, ``value``, ``source``: the peers' own files, cited by row."""
WHOLE = "ALL"
"""What a formula begins with that stands for all of a suite."""
FIRST_HAND = ("DeepLTL", "StructLTL")
"""Methods of the author of all files that numbers are from."""

_ABOUT = f"""\
Written by `python -m experiments.peers` from the records beside it, which name commits and settings. Our agents are
trained with the settings of recipe `hrlspec` on random SPECTRL tasks, and act on each formula's automaton as the
package translates it. No formula was held out from training: one that SPECTRL can express as well, such as `!(red |
yellow) U (blue & F green)`, may occur among the random tasks. Settings were chosen on other tasks, except for two
that serve what the formulas below ask for: up to eight letters to avoid in letter12, and sub-tasks of several
propositions at once in flatworld.

Ours: {EPISODES} episodes for each formula and seed, each in its own layout, with sampled actions and sub-tasks.
Figures are means over seeds; brackets hold Student's t intervals (95 %), cut at the bounds of a rate. An episode
succeeds, or violates the formula (after which nothing can satisfy it), or leaves the arena, or runs out of time.
Steps are those of successful episodes. Rounds are accepting transitions within the horizon, with the parts of a
formula visited in the order that [the page on tasks](../../docs/tasks.md) gives, so that other visits do not count;
"none" is the share of episodes without a round. \\* some state has more paths to acceptance than fit into the tree
that the agent is shown; † some way on begins where nothing holds, which no sub-task asks for. A mean is over
formulas, and for steps over those with a success; where others have published only some of the formulas, another row
has the mean over these.

Theirs: success / steps / violated, as far as they are known, or rounds, in the order that their translator chose. All
of these numbers come from the peers' own files, which `experiments/published/published.csv` cites row by row; none
was measured here. ‡ second-hand: published not by the method's authors but by those of another method."""


class Published(NamedTuple):
    """What a method has on a formula, or on all of a suite (see `WHOLE`)."""

    suite: str
    formula: str
    method: str
    metric: str
    value: float
    source: str


def read_published(file: Path = PUBLISHED) -> list[Published]:
    """The peers' results."""
    with file.open(newline="", encoding="utf-8") as stream:
        return [
            Published(row["suite"], row["formula"], row["method"], row["metric"], float(row["value"]), row["source"])
            for row in csv.DictReader(stream)
        ]


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
            yield f"{EPISODES} episodes of each chain and seed. An agent that sees one sub-task at a time completes at"
            yield "most half of them for every k but 1."
            yield ""
            yield "| k | seeds | success | steps | optimum |"
            yield "|---|---|---|---|---|"
            yield from rows


def _of_suite(scores: Scores, comparison: Comparison, suite: str) -> list[Mapping[str, Any]]:
    return [found for (run, of), found in scores.items() if run.env == comparison.env and of == suite]


def _world(
    comparison: Comparison,
    records: Mapping[Run, Record],
    found: Mapping[str, Sequence[Mapping[str, Any]]],
    published: Sequence[Published],
) -> Iterator[str]:
    known = [record for run, record in records.items() if run.env == comparison.env]
    yield ""
    yield f"## {comparison.env}"
    yield ""
    yield f"{comparison.steps:,} environment steps a seed."
    if known:
        machines = " and ".join(sorted({str(record.circumstances["machine"]) for record in known}))
        seconds = float(np.mean([record.wall_s for record in known]))
        yield f"Training took {duration(seconds)} on average, compilation and evaluations included ({machines})."
    different = {config_hash({**record.settings, "seed": None}) for record in known}
    if len(different) > 1:
        yield f"**The runs are of {len(different)} different settings**, which their records tell."
    yield f"What differs: {comparison.differs}."
    for suite, some in found.items():
        yield ""
        yield f"### {suite}, {len(some)} {'seed' if len(some) == 1 else 'seeds'}"
        yield ""
        yield f"Formulas: {_source(suite)}."
        rows = [row for row in published if row.suite == suite]
        if not rows:
            yield "For these nobody's results are known here."
        yield ""
        yield from _table(go_on_for_ever(suite), some, rows)


def _source(suite: str) -> str:
    """Where the formulas are from, and what is left out."""
    (source,) = [line for line in peer_formulas(suite).splitlines() if line.startswith("# source: ")]
    return source.removeprefix("# source: ")


_OfFormula = Mapping[str, Any]
"""Our scores on a formula with one seed."""


class _Column(NamedTuple):
    """One of ours: its name, what it shows (``None`` where there is no such number), and how."""

    name: str
    value: Callable[[_OfFormula], float | None]
    digits: int = 3
    bounds: tuple[float, float] | None = None


_VIOLATED = _Column("violated", lambda row: row["violation_rate"] - row["ended_rate"])
_LEFT = _Column("left", lambda row: row["ended_rate"])
_FINITE = (
    _Column("success", lambda row: row["success_rate"], bounds=(0, 1)),
    _Column("steps", lambda row: row["steps_mean"], digits=1),
    _VIOLATED,
    _LEFT,
    _Column("out of time", lambda row: 1 - row["success_rate"] - row["violation_rate"]),
)
_FOREVER = (
    _Column("rounds", lambda row: row["rounds_mean"], digits=2, bounds=(0, math.inf)),
    _Column("none", lambda row: row["no_round_rate"]),
    _VIOLATED,
    _LEFT,
)

_Theirs = Mapping[str, Mapping[str, float]]
"""What a method has, by formula and metric."""


def _table(forever: bool, some: Sequence[Mapping[str, Any]], published: Sequence[Published]) -> Iterator[str]:
    columns = _FOREVER if forever else _FINITE
    metrics = ("accepting_visits",) if forever else ("success_rate", "steps_of_successes", "violation_rate")
    theirs = dict[str, dict[str, dict[str, float]]]()
    for one in published:
        theirs.setdefault(one.method, {}).setdefault(one.formula, {})[one.metric] = one.value
    heads = [method if method in FIRST_HAND else f"{method} ‡" for method in theirs]
    ours = [{row["formula"]: row for row in scores["per_formula"]} for scores in some]
    yield f"| {' | '.join(['formula', *(column.name for column in columns), *heads])} |"
    yield "|---" * (1 + len(columns) + len(heads)) + "|"

    def row(shown: str, formulas: Sequence[str], theirs: Sequence[Mapping[str, float]]) -> str:
        cells = [_cell(column, ours, formulas) for column in columns]
        return f"| {' | '.join([shown, *cells, *(_published_cell(found, metrics) for found in theirs)])} |"

    for formula, facts in ours[0].items():
        marks = "\\*" * facts["cut"] + "†" * facts["silent"]
        shown = "`" + formula.replace("|", "\\|") + "`" + marks
        yield row(shown, [formula], [found.get(formula, {}) for found in theirs.values()])
    for formulas in _sets(list(ours[0]), list(theirs.values())):
        shown = "mean" if len(formulas) == len(ours[0]) else f"mean of {len(formulas)}"
        yield row(shown, formulas, [_mean(found, formulas, metrics) for found in theirs.values()])
    for whole in dict.fromkeys(one.formula for one in published if one.formula.startswith(WHOLE)):
        yield row(f"theirs: {whole}", [], [found.get(whole, {}) for found in theirs.values()])


def _sets(formulas: Sequence[str], theirs: Sequence[_Theirs]) -> list[tuple[str, ...]]:
    """All formulas, and those that somebody has published, if these are several; the largest set first."""
    sets = {tuple(formula for formula in formulas if formula in found) for found in theirs}
    return sorted({tuple(formulas), *(some for some in sets if len(some) > 1)}, key=len, reverse=True)


def _cell(column: _Column, ours: Sequence[Mapping[str, _OfFormula]], formulas: Sequence[str]) -> str:
    """The mean over seeds of the means over formulas."""
    values = [[column.value(of_seed[formula]) for formula in formulas] for of_seed in ours]
    known = [[value for value in of_seed if value is not None] for of_seed in values]
    interval = mean_interval([float(np.mean(of_seed)) for of_seed in known if of_seed])
    return _shown(interval, column.digits, column.bounds)


def _mean(found: _Theirs, formulas: Sequence[str], metrics: Sequence[str]) -> Mapping[str, float]:
    """Over formulas, nothing unless all of them are there; of steps over those with a success."""
    if any(formula not in found for formula in formulas):
        return {}
    values = {metric: [found[some][metric] for some in formulas if metric in found[some]] for metric in metrics}
    return {
        metric: float(np.mean(some))
        for metric, some in values.items()
        if len(some) == len(formulas) or (some and metric == "steps_of_successes")
    }


def _published_cell(theirs: Mapping[str, float], metrics: Sequence[str]) -> str:
    digits = {"steps_of_successes": 1, "accepting_visits": 2}
    return " / ".join(f"{theirs[metric]:.{digits.get(metric, 3)}f}" for metric in metrics if metric in theirs)


def _chain(comparison: Comparison, scores: Scores) -> Iterator[str]:
    found = _of_suite(scores, comparison, "dag")
    if found:
        success, steps, optimum = (
            mean_interval([some[name] for some in found if some[name] is not None])
            for name in ("success_rate", "steps_mean", "optimal_steps_mean")
        )
        cells = [_shown(success, 3, (0, 1)), _shown(steps, 1, None), _shown(optimum, 0, None)]
        yield f"| {' | '.join([comparison.env.rpartition('-')[2], str(len(found)), *cells])} |"


def _shown(interval: Interval, digits: int, bounds: tuple[float, float] | None) -> str:
    """The estimate, with its interval if what it lies between is given; nothing where there is none."""
    if math.isnan(interval.estimate):
        return ""
    estimate = f"{round(interval.estimate, digits) + 0:.{digits}f}"  # no -0.000
    if bounds is None or math.isnan(interval.low):
        return estimate
    low, high = (f"{min(max(bound, bounds[0]), bounds[1]):.{digits}f}" for bound in interval[1:])
    return f"{estimate} [{low}, {high}]"
