"""The comparison with published results: what is known, what is missing, and the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from experiments.paper.records import Record
from experiments.peers import main
from experiments.published.comparisons import COMPARISONS
from experiments.published.evaluations import FILE, Evaluation, read_evaluations
from experiments.published.report import page, read_published
from hrlspec.presets import preset
from hrlspec.presets.peers import peer_formulas, peer_suites
from hrlspec.run.errors import UserError
from hrlspec.spec import bare_lines


def scored(suite: str, success: float, steps: float | None) -> dict[str, Any]:
    """What an evaluation says where each formula has the same success."""
    formulas = [" ".join(line.split()) for line in bare_lines(peer_formulas(suite)) if line.strip()]
    row = {"success_rate": success, "violation_rate": 0.25, "steps_mean": steps, "rounds_mean": 10 * success}
    return {"per_formula": [{"formula": formula, **row} for formula in formulas]}


def record(wall_s: float) -> Record:
    return Record(settings={}, circumstances={}, env_steps=1, wall_s=wall_s, curve={}, final={})


def test_every_suite_is_there() -> None:
    for comparison in COMPARISONS.values():
        world = preset(comparison.env)
        assert set(comparison.suites) <= {*peer_suites(), *world.suite_names}
        assert [run.seed for run in comparison.runs(3)] == [0, 1, 2]


def test_published_results_are_of_formulas_that_are_there() -> None:
    known = {suite: {" ".join(line.split()) for line in bare_lines(peer_formulas(suite))} for suite in peer_suites()}
    for suite, formula in read_published():
        assert suite in known
        assert formula in known[suite] | {"MEAN"}
    assert read_published()["deepltl/letter_finite", "MEAN"]["DeepLTL"]["success_rate"] == 0.9892


def test_page() -> None:
    comparison, suite = COMPARISONS["letter12"], "deepltl/letter_finite"
    runs = comparison.runs(3)
    rates = zip(runs, (0.9, 1.0, 0.95), strict=True)
    scores = {Evaluation(run, suite): scored(suite, success, 8.0) for run, success in rates}
    scores[Evaluation(runs[0], "deepltl/letter_infinite")] = scored("deepltl/letter_infinite", 0.5, None)
    lines = list(page({run: record(60.0) for run in runs}, scores))
    # Three seeds: mean 0.95, standard error 0.05 / sqrt(3), Student's t with two degrees of freedom 4.303.
    low, high = 0.95 - 4.3027 * 0.05 / 3**0.5, 0.95 + 4.3027 * 0.05 / 3**0.5
    (row,) = [line for line in lines if line.startswith("| `F (a & (!b U c)) & F d`")]
    assert row.startswith(f"| `F (a & (!b U c)) & F d` | 0.950 [{low:.3f}, {high:.3f}] | 8.0 |")
    (mean,) = [line for line in lines if line.startswith("| mean | 0.95")]
    assert "0.989 / 10.1" in mean
    assert any(line.startswith("| `GF (e & (!a U f))` | 5.00 | 0.250 |") for line in lines)
    assert any("`((a \\| b \\| c \\| d) => " in line for line in lines)
    assert not any("flatworld" in line for line in lines[3:])


def test_page_of_chains() -> None:
    runs = COMPARISONS["conveyor-simple-4"].runs(2)
    found = {"success_rate": 1.0, "steps_mean": 4.5, "optimal_steps_mean": 4.0}
    lines = list(page({}, {Evaluation(run, "dag"): found for run in runs}))
    assert "| 4 | 2 | 1.000 [1.000, 1.000] | 4.5 | 4 |" in lines


def test_known_evaluations(tmp_path: Path) -> None:
    first, second = (Evaluation(run, "deepltl/letter_finite") for run in COMPARISONS["letter12"].runs(2))
    assert read_evaluations([first], tmp_path) == {}
    line = {"run": first.run.name, "asked_steps": first.run.total_steps, "suite": first.suite, "scores": {"a": 1}}
    other = line | {"asked_steps": 5, "scores": {"a": 2}}
    (tmp_path / FILE).write_text(f"{json.dumps(line)}\n{json.dumps(other)}\n")
    assert read_evaluations([first, second], tmp_path) == {first: {"a": 1}}


@pytest.mark.parametrize("text", ["{", "[]", '{"run": "a"}', '{"run": "a", "asked_steps": 1, "suite": "s"}'])
def test_damaged_evaluations(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE).write_text(text + "\n")
    with pytest.raises(UserError, match="line 1: no evaluation"):
        read_evaluations([], tmp_path)


def test_dry_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--only", "letter12", "conveyor-2", "--seeds", "2", "--dry-run", "--out", str(tmp_path)])
    out, err = capsys.readouterr()
    assert err == "10 evaluations, 10 of them missing, and 4 runs for them\n"
    assert [line.split()[4] for line in out.splitlines()] == ["letter12", "letter12", "conveyor-2", "conveyor-2"]
    assert "--evaluation.final test" in out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (("--only", "letter"), "there is no such world"),
        (("--seeds", "0"), "expected at least 1"),
        (("--jobs", "0"), "at least 1"),
    ],
)
def test_bad_input(argv: tuple[str, ...], said: str) -> None:
    with pytest.raises(UserError, match=said):
        main(argv)
