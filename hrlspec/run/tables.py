"""Results as tables for the terminal."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence

from rich import box
from rich.table import Table

from hrlspec.evaluation import Aggregate, LtlResult, SuiteResult
from hrlspec.evaluation.results import OVER_EPISODES, OVER_TASKS
from hrlspec.evaluation.stats import Interval
from hrlspec.run.console import counted
from hrlspec.run.learner import FinalResults

_NAMES = {
    "success_rate": "success",
    "return_mean": "return",
    "steps_mean": "steps",
    "spl": "SPL",
}


def suite_table(result: SuiteResult) -> Table:
    """Success, return, steps and SPL with intervals, in all and per depth; fits into 80 columns."""
    total, names = result.total, [name for name in _NAMES if name != "spl" or result.total.spl is not None]
    few = total.intervals_over == OVER_EPISODES
    remarks = [
        "greedy actions" if result.greedy else "sampled actions",
        *(["shield on"] if result.shield else []),
        "95 % intervals over the episodes, given these tasks" if few else "95 % intervals over tasks",
        "steps of successful episodes",
        f"violated: {total.violation_rate.estimate:.3f}",
    ]
    if not few and any(score.intervals_over == OVER_EPISODES for score in result.per_depth.values()):
        remarks.append("* over the episodes, given these tasks")
    if result.excluded:
        remarks.append(f"{result.excluded} cases that nothing can satisfy in time were left out")
    if total.optimal_steps_mean:
        remarks.append(f"steps over optimum: {total.steps_mean.estimate / total.optimal_steps_mean:.3f}")
    if total.myopic_spl is not None:
        remarks.append(f"nearest goal first: success {total.myopic_success_rate:.3f}, SPL {total.myopic_spl:.3f}")
    table = plain_table(
        f"Unseen tasks: {result.suite} ({counted(len(result.per_task), 'task')}, {counted(total.episodes, 'episode')})",
        ["tasks", *(_NAMES[name] for name in names)],
        "; ".join(remarks),
    )
    for depth, score in sorted(result.per_depth.items()):
        mark = "" if few or score.intervals_over == OVER_TASKS else "*"
        table.add_row(f"depth {depth}{mark}", *(cell(getattr(score, name)) for name in names))
    table.add_section()
    table.add_row("all", *(cell(getattr(total, name)) for name in names), style="bold")
    return table


def ltl_table(result: LtlResult) -> Table:
    """Success, violations and steps of each formula, and their means."""
    remarks = ["greedy actions" if result.greedy else "sampled actions", "95 % intervals over episodes"]
    remarks.append("rounds within the horizon" if result.forever else "steps of successful episodes")
    if any(score.ended_rate.estimate > 0 for score in result.per_formula):
        remarks.append("violated, or ended by the environment")
    if any(score.cut for score in result.per_formula):
        remarks.append("* some paths to acceptance were left out, for a tree was too small")
    if any(score.silent for score in result.per_formula):
        remarks.append("† some way on begins where nothing holds, which no sub-task asks for")
    formulas, episodes = counted(len(result.per_formula), "formula"), counted(result.episodes, "episode")
    table = plain_table(
        f"{result.suite} ({formulas}, {episodes} of each)",
        ["formula", "rounds", "violated"] if result.forever else ["formula", "success", "violated", "steps"],
        "; ".join(remarks),
    )
    table.columns[0].no_wrap = False
    for score in result.per_formula:
        mark = "*" * score.cut + "†" * score.silent
        violated = f"{score.violation_rate.estimate:.3f}"
        finite = cell(score.success_rate), violated, cell(score.steps_mean)
        table.add_row(score.formula + mark, *((cell(score.rounds_mean), violated) if result.forever else finite))
    table.add_section()
    finite = f"{result.success_rate:.3f}", "", f"{result.steps_mean:.1f}"
    table.add_row("mean", *((f"{result.rounds_mean:.2f}",) if result.forever else finite), style="bold")
    return table


def final_tables(results: FinalResults) -> list[Table]:
    """Everything a run ends with."""
    tables = [suite_table(results.suite)]
    if results.first_choice is not None:
        first = results.first_choice
        table = plain_table(
            f"First choice where it matters ({first.episodes} cases)",
            ["best first sub-task", "chance"],
            f"best by {first.by}; the decision itself is counted, whatever comes of it",
        )
        table.add_row(cell(first.rate), f"{first.chance:.3f}")
        tables.append(table)
    if results.choice is not None:
        choice = results.choice
        table = plain_table(
            f"Contested choice ({choice.episodes} layouts)",
            ["right choices", "nearest is wrong", "nearest is right", "failures"],
            "always the nearest instance, or always another, scores 0.5; failures count as wrong",
        )
        table.add_row(cell(choice.score), cell(choice.contested), cell(choice.controls), f"{choice.failures:.3f}")
        tables.append(table)
    if results.returns is not None:
        returns = results.returns
        table = plain_table(
            f"Return over optimum where the branch matters ({returns.episodes} cases)",
            ["agent", "random branch", "longest branch"],
        )
        table.add_row(cell(returns.ratio), f"{returns.random_branch:.3f}", f"{returns.longest_branch:.3f}")
        tables.append(table)
    return tables


def aggregate_table(name: str, aggregates: Mapping[str, Aggregate]) -> Table:
    """Several seeds put together."""
    table = plain_table(
        name,
        ["unseen tasks", "seeds", "mean over seeds", "interquartile mean"],
        "95 % intervals; the interquartile mean's is a bootstrap over seeds",
    )
    for key, title in _NAMES.items():
        if key in aggregates:
            value = aggregates[key]
            table.add_row(title, str(value.runs), cell(value.mean), cell(value.iqm))
    return table


def plain_table(title: str, columns: Sequence[str], caption: str | None = None) -> Table:
    """An empty table with a line below its head; the first column is flush left, the others right."""
    table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    for i, column in enumerate(columns):
        table.add_column(column, justify="right" if i else "left", no_wrap=True)
    return table


def cell(interval: Interval | None) -> str:
    """The estimate and its bounds, such as ``0.983 [.97,.99]``, rounded outwards: the estimate is never outside."""
    if interval is None or math.isnan(interval.estimate):
        return "-"
    large = abs(interval.estimate) >= 10
    estimate = f"{interval.estimate:.{1 if large else 3}f}"
    if math.isnan(interval.low):
        return estimate
    digits = 1 if large else 2
    bounds = [_rounded(interval.low, digits, math.floor), _rounded(interval.high, digits, math.ceil)]
    low, high = bounds if large else [re.sub(r"^(-?)0\.", r"\1.", bound) for bound in bounds]
    return f"{estimate} [{low},{high}]"


def _rounded(bound: float, digits: int, outwards: Callable[[float], int]) -> str:
    """A bound with so many digits; what is a rounding error of the number itself moves it nowhere."""
    return f"{outwards(round(bound * 10**digits, 6)) / 10**digits:.{digits}f}"
