"""Result tables: right numbers, and nothing wraps in a terminal of 80 columns."""

from __future__ import annotations

import dataclasses
import io

import pytest
from rich.console import Console

from hrlspec.evaluation import (
    Aggregate,
    ChoiceResult,
    FirstChoiceResult,
    FormulaScore,
    LtlResult,
    ReturnResult,
    Score,
    SuiteResult,
    TaskScore,
)
from hrlspec.evaluation.stats import Interval
from hrlspec.run.console import PlainConsole
from hrlspec.run.learner import FinalResults
from hrlspec.run.tables import aggregate_table, cell, final_tables, ltl_table, suite_table

NAN = float("nan")


def score(success: float, *, spl: bool = True, over: str = "tasks") -> Score:
    return Score(
        episodes=1000,
        intervals_over=over,
        success_rate=Interval(success, success - 0.1, 1.0),
        violation_rate=Interval(0.012, 0.0, 0.1),
        return_mean=Interval(success, -0.123, 1.2),
        steps_mean=Interval(12.345, 11.111, 13.9) if success else Interval(NAN, NAN, NAN),
        spl=Interval(0.5, NAN, NAN) if spl else None,
        optimal_steps_mean=10.0 if spl else None,
        myopic_success_rate=0.9 if spl else None,
        myopic_spl=0.8 if spl else None,
    )


def result(*, spl: bool = True) -> SuiteResult:
    per_task = tuple(TaskScore(f"achieve {name}", 2, score(0.75, spl=spl)) for name in "ab")
    depths = {4: score(0.0, spl=spl), 2: score(1.0, spl=spl)}
    return SuiteResult("dag", False, True, 3, score(0.983, spl=spl), depths, per_task)


def lines(table: object) -> list[str]:
    stream = io.StringIO()
    Console(file=stream, width=80).print(table)
    found = [line.rstrip() for line in stream.getvalue().splitlines()]
    assert all("…" not in line for line in found)
    return found


def test_a_suite() -> None:
    found = lines(suite_table(result()))
    assert "Unseen tasks: dag (2 tasks, 1,000 episodes)" in found[0]
    (row,) = [line.split() for line in found if line.strip().startswith("all ")]
    assert row == ["all", "0.983", "[.88,1.00]", "0.983", "[-.13,1.20]", "12.3", "[11.1,13.9]", "0.500"]
    (failed,) = [line.split() for line in found if line.strip().startswith("depth 4")]
    assert failed[5:] == ["[-.13,1.20]", "-", "0.500"]
    text = " ".join(" ".join(found).split())
    for remark in ("sampled actions", "shield on", "violated: 0.012", "3 cases", "over optimum: 1.23", "SPL 0.800"):
        assert remark in text


def test_it_says_what_intervals_are_over() -> None:
    many = result()
    some = dataclasses.replace(many, per_depth={2: score(0.5), 3: score(0.5, over="episodes")})
    few = dataclasses.replace(some, total=score(0.5, over="episodes"))
    texts = [" ".join(" ".join(lines(suite_table(each))).split()) for each in (many, some, few)]
    assert [("intervals over tasks" in text, "* over the episodes, given" in text) for text in texts] == [
        (True, False),
        (True, True),
        (False, False),
    ]
    assert "depth 3* " in texts[1]
    assert "95 % intervals over the episodes, given these tasks;" in texts[2]


def test_names_are_shown_as_they_are() -> None:
    stream = io.StringIO()
    PlainConsole(file=stream, width=80).print(suite_table(dataclasses.replace(result(), suite="[bold red]x[/] :eye:")))
    assert "Unseen tasks: [bold red]x[/] :eye: (2 tasks" in stream.getvalue()


@pytest.mark.parametrize(
    ("interval", "shown"),
    [
        (Interval(0.999, 0.9964, 0.9997), "0.999 [.99,1.00]"),
        (Interval(0.29, 0.29, 0.29), "0.290 [.29,.29]"),  # 100 times that is 28.999999999999996
        (Interval(-0.004, -0.011, -0.002), "-0.004 [-.02,.00]"),
        (Interval(31.25, 31.21, 31.29), "31.2 [31.2,31.3]"),
    ],
)
def test_bounds_are_rounded_outwards(interval: Interval, shown: str) -> None:
    assert cell(interval) == shown


def test_bounds_lose_their_leading_zero_alone() -> None:
    total = dataclasses.replace(score(0.5), steps_mean=Interval(9.925, 9.56, 10.29))
    assert "[9.56,10.29]" in "".join(lines(suite_table(dataclasses.replace(result(), total=total))))


def test_without_an_exact_solver_there_is_no_spl() -> None:
    assert "SPL" not in "\n".join(lines(suite_table(result(spl=False))))


def test_what_a_run_ends_with() -> None:
    choice = ChoiceResult(False, 400, *[Interval(0.9, 0.85, 0.95)] * 3, failures=0.01)
    returns = ReturnResult(
        "branches", False, 100, 5, "tasks", Interval(0.95, 0.9, 1.0), Interval(1, 1, 1), 0.5, 0.75, {}
    )
    first = FirstChoiceResult("dag", False, 900, 5, "steps", Interval(0.92, 0.9, 0.94), 0.45)
    everything = FinalResults(result(), choice, returns, first)
    text = "\n".join("\n".join(lines(table)) for table in final_tables(everything))
    assert "0.920 [.90,.94]" in text
    assert "Contested choice (400 layouts)" in text
    assert "0.900 [.85,.95]" in text
    assert "0.950 [.90,1.00]" in text
    assert "0.750" in text
    assert len(final_tables(FinalResults(result(), None, None, None))) == 1


@pytest.mark.parametrize("iqm", [None, Interval(0.97, 0.96, 0.98)])
def test_several_seeds(iqm: Interval | None) -> None:
    found = "\n".join(lines(aggregate_table("name", {"spl": Aggregate(3, Interval(0.96, 0.9, 1.02), iqm)})))
    assert "0.960 [.90,1.02]" in found
    assert ("0.970" in found) == (iqm is not None)


def test_formulas_in_ltl() -> None:
    """Marks say what the agent was not shown; of tasks for ever rounds count."""
    rate, few, none = Interval(0.9, 0.8, 0.95), Interval(0.05, 0, 0.1), Interval(NAN, NAN, NAN)
    scores = tuple(
        FormulaScore(text, 5, cut, silent, rate, few, few, Interval(12.5, 12, 13), Interval(2.5, 2, 3), few)
        for text, cut, silent in (("F a", False, False), ("F b", True, False), ("F c", False, True))
    )
    finite, forever = (
        "\n".join(lines(ltl_table(LtlResult("some", forever, False, 512, scores)))) for forever in (False, True)
    )
    assert "F b*" in finite
    assert "F c†" in finite
    assert "0.900 [.80,.95]" in finite
    assert "rounds" not in finite
    assert "ended by the environment" in " ".join(finite.split())
    kept = tuple(dataclasses.replace(score, ended_rate=Interval(0, 0, 0.1)) for score in scores)
    assert "ended by" not in "\n".join(lines(ltl_table(LtlResult("some", False, False, 512, kept))))
    assert "2.500 [2.00,3.00]" in forever
    assert "success" not in forever
    assert LtlResult("some", True, False, 512, scores).to_json()["success_rate"] is None
    nothing = dataclasses.replace(scores[0], success_rate=Interval(0, 0, 0.1), steps_mean=none)
    assert "-" in "\n".join(lines(ltl_table(LtlResult("none", False, True, 512, (nothing,)))))
