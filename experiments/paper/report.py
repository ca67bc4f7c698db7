"""Figures with 95 % bands and the page of results, drawn from the records of runs alone."""

from __future__ import annotations

import collections
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.paper.claims import (
    LEVEL,
    Records,
    family,
    final_return,
    findings,
    mean_return,
    over_seeds,
    runs_to_decide,
    steps_to_most,
)
from experiments.paper.panels import (
    FIRST_TRIAL_SEED,
    PANELS,
    TRAJECTORIES,
    TRIAL_SEEDS,
    TUNING,
    Curve,
    Panel,
    Run,
    in_recipe,
)
from experiments.paper.records import Record
from hrlspec.evaluation.stats import interquartile_mean
from hrlspec.presets import RECIPES
from hrlspec.run.curves import band
from hrlspec.run.figures import save
from hrlspec.run.progress import duration

_ABOUT = """\
Written by `python -m experiments.reproduce` from the records in `results/paper`, each of which names the flags that
made it. Returns are undiscounted means over 2,000 episodes of 200 unseen tasks (at the end) or 100 episodes of 10
(along the curves), with sampled actions and no shield. Steps are those of successful episodes. "Of optimum" is the
share of the best way's return where an exact planner knows it (suite `branches`), "first choice" the share of first
sub-tasks that are among the best in tasks where the choice matters, and "contested" is contested choice, 0.5 for an
agent that always takes the nearest instance. The ratio divides the steps after which ours has reached 90 % of its
curve's last value by the steps after which the method has reached 90 % of its own. Figures are interquartile means
over seeds (training times: means) with stratified bootstrap intervals (95 %); bands are Student's t intervals. All
methods run through the same loop, with the same curriculum and, except for No-ER, with relabelling. Recipe `paper`
collects with the shield, for Option as well; LTL2Action has no sub-task and therefore nothing to shield. Recipe
`hrlspec` has no shield. The records are of [older code](#code) and of the first draw of the suites, on whose tasks
settings were also chosen; validation and test tasks have since been redrawn as separate suites. Training times, in
minutes and seconds, are of runs side by side, one on each core, including compilation and evaluations; a few include
a pause or other programs on the same machine."""
_ABOUT_CLAIMS = """\
Claims compare means over seeds: of the curve's mean where the claim is about learning, of the final return where it
is about the end. The difference comes with Welch's 95 % interval; the share is the probability that a run of one
method beats a run of the other, with a bootstrap interval. p is that of the two-sided exact permutation test,
corrected by Holm's method over all claims in all panels under all recipes: {family} tests, including those whose runs
are still missing. A claim is decided, one way or the other, where the corrected p is below {level}. That takes
{enough} runs on either side: with fewer, p cannot become small enough, however far apart the runs are. Recipe
`planner` is compared with the baselines under recipe `paper`, of which it is a variant. Experiments that look for the
reasons why a claim does not hold or is undecided are listed in [decisions](decisions.md#where-claims-do-not-hold)."""


def write_report(panels: Sequence[Panel], records: Mapping[Run, Record], figures: Path, report: Path) -> Iterator[Path]:
    """Draws the given panels as far as they have records, writes the page of all, and yields the files one by one.

    Args:
        panels: what to draw.
        records: of the runs that are finished.
        figures: folder for the PNG files.
        report: the page (Markdown).
    """
    by_panel, tuning = (
        {panel: found for panel in some.values() if (found := _of_panel(panel, records))} for some in (PANELS, TUNING)
    )
    figures.mkdir(parents=True, exist_ok=True)
    for panel, found in by_panel.items():
        if panel in panels:
            yield _draw(panel, found, figures / f"{panel.name}.png")
    report.parent.mkdir(parents=True, exist_ok=True)
    page = _page(by_panel, Path(os.path.relpath(figures, report.parent)), report)
    report.write_text("\n".join([*page, *_times(by_panel), *_sources(records), *_tuning(tuning)]) + "\n")
    yield report


def _of_panel(panel: Panel, records: Mapping[Run, Record]) -> dict[Curve, list[Record]]:
    found: dict[Curve, list[Record]] = {}
    for run, record in records.items():
        if (run.env, run.reward_set) == (panel.env, panel.reward_set) and run.curve in panel.curves:
            found.setdefault(run.curve, []).append(record)
    return {curve: found[curve] for curve in panel.curves if curve in found}


def _draw(panel: Panel, records: Records, file: Path) -> Path:
    """One axis for each recipe that has curves."""
    recipes = [recipe for recipe in RECIPES if any(curve.recipe == recipe for curve in records)]
    drawn = {
        recipe: [curve for curve in panel.curves if curve == in_recipe(curve.method, recipe, curve.switches)]
        for recipe in recipes
    }
    figure = Figure(figsize=(0.5 + 4.5 * len(recipes), 3.6), layout="constrained")
    axes: Any = figure.subplots(1, len(recipes), squeeze=False, sharey=True)
    for ax, recipe in zip(axes[0], recipes, strict=True):
        # A method has one colour, whatever else is there yet.
        for colour, curve in enumerate(drawn[recipe]):
            if curve in records:
                steps, returns = _curve(records[curve])
                label = f"{curve.label.rpartition(' (')[0]} ({len(records[curve])})"
                band(ax, steps, returns, color=f"C{colour}", label=label)
        ax.set_title(f"{panel.title}, recipe {recipe}", fontsize=10)
        ax.set_xlabel("million environment steps", fontsize=9)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    axes[0, 0].set_ylabel("average return on unseen tasks", fontsize=9)
    return save(figure, file)


def _curve(records: Sequence[Record]) -> tuple[np.ndarray, np.ndarray]:
    """Environment steps ``[N]`` and returns ``[S, N]``, as far as all runs go."""
    length = min(len(record.curve["env_steps"]) for record in records)
    returns = np.array([record.curve["eval/return_mean"][:length] for record in records])
    return np.array(records[0].curve["env_steps"][:length]), returns


def _page(by_panel: Mapping[Panel, Records], figures: Path, report: Path) -> Iterator[str]:
    yield "# Results"
    yield ""
    yield _ABOUT
    yield ""
    yield "## The paper's claims"
    yield ""
    yield _ABOUT_CLAIMS.format(family=len(family()), level=LEVEL, enough=runs_to_decide())
    yield ""
    yield "| claim | panel | recipe | difference | share | p | corrected | seeds | verdict |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for test, found in findings({panel.name: records for panel, records in by_panel.items()}).items():
        what = f"{test.claim.text} | {test.panel} | {test.recipe} | {found.difference} | {found.improvement}"
        seeds = " and ".join(map(str, found.seeds))
        yield f"| {what} | {found.p_value:.2g} | {found.corrected:.2g} | {seeds} | {found.verdict} |"
    for panel, records in by_panel.items():
        yield ""
        yield f"## {panel.title}"
        yield ""
        yield f"![{panel.title}]({(figures / panel.name).as_posix()}.png)"
        yield ""
        yield from _table(records)
    if (report.parent / figures / f"{TRAJECTORIES}.png").exists():
        yield ""
        yield "## Walk, trajectories"
        yield ""
        yield "A trained agent (recipe hrlspec, seed 0) on six tasks; reached is outlined, avoided is hatched."
        yield ""
        yield f"![Trajectories]({(figures / TRAJECTORIES).as_posix()}.png)"


def _times(by_panel: Mapping[Panel, Records]) -> Iterator[str]:
    """What the runs took; those of a curve in two panels count in the first."""
    yield ""
    yield "## Time"
    yield ""
    yield "Training of all runs, one after the other, each on one core; two cores side by side take half of it. A curve"
    yield "that is in several panels counts in the first."
    yield ""
    yield f"| panel | {' | '.join(f'recipe {recipe}' for recipe in RECIPES)} |"
    yield "|---" * (1 + len(RECIPES)) + "|"
    counted: set[tuple[str, int, Curve]] = set()
    for panel, records in by_panel.items():
        cells = []
        for recipe in RECIPES:
            curves = [curve for curve in records if curve.recipe == recipe]
            new = [curve for curve in curves if (panel.env, panel.reward_set, curve) not in counted]
            runs = [record.wall_s for curve in new for record in records[curve]]
            cells.append(f"{len(runs)} runs, {duration(sum(runs))}" if runs else "")
            counted |= {(panel.env, panel.reward_set, curve) for curve in new}
        yield f"| {panel.name} | {' | '.join(cells)} |"


def _sources(records: Mapping[Run, Record]) -> Iterator[str]:
    """Which code the runs were made with."""
    commits: dict[tuple[str, str], collections.Counter[str]] = {}
    for run, record in records.items():
        known, _, changes = str(record.circumstances["commit"]).partition("+")
        where = commits.setdefault((run.env, run.curve.recipe), collections.Counter())
        where[f"`{known[:7]}`" + (" and changes" if changes else "")] += 1
    yield ""
    yield "## Code"
    yield ""
    yield "The commits that the runs were made with, and how many of them; some had changes that were not committed."
    yield ""
    yield "| environment | recipe | commits |"
    yield "|---|---|---|"
    for (env, recipe), counted in commits.items():
        yield f"| {env} | {recipe} | {', '.join(f'{commit} ({runs})' for commit, runs in counted.items())} |"


def _tuning(trials: Mapping[Panel, Records]) -> Iterator[str]:
    """What was tried for each method, and what came of it."""
    if not trials:
        return
    yield ""
    yield "## Tuning"
    yield ""
    yield f"Every method had the same trials: {TRIAL_SEEDS} runs for each learning rate of the low level, seeds from"
    yield f"{FIRST_TRIAL_SEED} on, reward set 2, tasks for validation. The one with the largest sum of both columns,"
    yield "means over seeds, is the preset."
    yield ""
    yield "| environment | trial | seeds | mean of the curve | final return |"
    yield "|---|---|---|---|---|"
    for panel, records in trials.items():
        for curve, some in records.items():
            learning, final = (np.mean([score(record) for record in some]) for score in (mean_return, final_return))
            yield f"| {panel.env} | {curve.label} | {len(some)} | {learning:.3f} | {final:.3f} |"


def _table(records: Records) -> Iterator[str]:
    """A line for each curve; the ratio is of ours' steps to its own. Scores that are known of none are left out."""
    ours = {recipe: records.get(Curve("ours", recipe)) for recipe in RECIPES}
    fastest = {recipe: over_seeds(steps_to_most, some).estimate for recipe, some in ours.items() if some}
    scores = {curve: _scores(some) for curve, some in records.items()}
    known = [name for name in next(iter(scores.values())) if any(some[name] for some in scores.values())]
    columns = ("curve", "seeds", "final return", *known, "mean of the curve", "steps to 90 %", "ratio", "training")
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    for curve, some in records.items():
        steps = over_seeds(steps_to_most, some).estimate
        ratio = f"{fastest[curve.recipe] / steps:.2f}" if curve.recipe in fastest else ""
        wall = duration(float(np.mean([record.wall_s for record in some])))
        final = " | ".join([str(over_seeds(final_return, some)), *(scores[curve][name] for name in known)])
        learning = f"{over_seeds(mean_return, some)} | {steps:,.0f} | {ratio} | {wall}"
        yield f"| {curve.label} | {len(some)} | {final} | {learning} |"


def _scores(records: Sequence[Record]) -> dict[str, str]:
    """Those at the end, by their column; empty where they are not known."""
    suite, first, contested, optimum = (
        [record.final.get(name) or {} for record in records]
        for name in ("suite", "first_choice", "contested_choice", "return_over_optimum")
    )
    return {
        "success": _mean(suite, "success_rate"),
        "steps": _mean(suite, "steps_mean", ".0f"),
        "SPL": _mean(suite, "spl"),
        "first choice": _mean(first, "first_choice"),
        "contested": _mean(contested, "contested_choice"),
        "of optimum": _mean(optimum, "return_over_optimum"),
    }


def _mean(results: Sequence[Mapping[str, Any]], name: str, how: str = ".3f") -> str:
    """Interquartile mean; nothing where it is not known, as SPL is in Zone, whose optimum nobody knows."""
    values = [result.get(name) for result in results]
    return "" if None in values else format(interquartile_mean(np.array(values, float)), how)
