"""The comparison with published results: what is known, what is missing, and the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from experiments import peers
from experiments.paper.making import made
from experiments.paper.records import Record, add_record
from experiments.peers import main
from experiments.published import evaluations
from experiments.published.comparisons import COMPARISONS, EPISODES
from experiments.published.evaluations import FILE, Evaluation, flags_of, read_evaluations
from experiments.published.report import WHOLE, page, read_published
from hrlspec.presets import preset
from hrlspec.presets.peers import peer_formulas, peer_suites
from hrlspec.run.commands.evaluate import EvaluateFlags
from hrlspec.run.configuration import config_hash
from hrlspec.run.errors import UserError
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import FORMAT
from hrlspec.spec import bare_lines


def scored(suite: str, success: float, steps: float | None) -> dict[str, Any]:
    """What an evaluation says where each formula has the same success."""
    formulas = [" ".join(line.split()) for line in bare_lines(peer_formulas(suite)) if line.strip()]
    row = {"success_rate": success, "violation_rate": 0.04, "ended_rate": 0.01, "steps_mean": steps}
    row |= {"rounds_mean": 10 * success, "no_round_rate": 0.5}
    marks = {"cut": False, "silent": False}
    return {"per_formula": [{"formula": formula, **marks, **row} for formula in formulas]}


def record(wall_s: float, **settings: object) -> Record:
    return Record(settings, {"machine": "a small one"}, env_steps=1, wall_s=wall_s, curve={}, final={})


def test_every_suite_is_there() -> None:
    for comparison in COMPARISONS.values():
        world = preset(comparison.env)
        assert set(comparison.suites) <= {*peer_suites(), *world.suite_names}
        assert [run.seed for run in comparison.runs(3)] == [0, 1, 2]


def test_published_results_are_of_formulas_that_are_there() -> None:
    known = {suite: {" ".join(line.split()) for line in bare_lines(peer_formulas(suite))} for suite in peer_suites()}
    rows = read_published()
    for row in rows:
        assert row.formula in known[row.suite] or row.formula.startswith(WHOLE)
        assert row.source.startswith("mathiasj33/")  # who says what is second-hand
    assert len({row[:4] for row in rows}) == len(rows)
    assert {row.metric for row in rows if not 0 <= row.value <= 1} == {"steps_of_successes", "accepting_visits"}


def test_page() -> None:
    comparison, suite = COMPARISONS["letter12"], "deepltl/letter_finite"
    runs = comparison.runs(3)
    rates = zip(runs, (0.9, 1.0, 0.95), strict=True)
    scores = {Evaluation(run, suite): scored(suite, success, 8.0) for run, success in rates}
    scores[Evaluation(runs[0], "deepltl/letter_infinite")] = scored("deepltl/letter_infinite", 0.5, None)
    lines = list(page({run: record(60.0, seed=run.seed) for run in runs}, scores))
    # Three seeds: mean 0.95, standard error 0.05 / sqrt(3), Student's t with two degrees of freedom 4.303.
    # It ends above 1, where no rate is.
    low = 0.95 - 4.3027 * 0.05 / 3**0.5
    ours = f"0.950 [{low:.3f}, 1.000] | 8.0 | 0.030 | 0.010 | 0.010"
    (row,) = [line for line in lines if line.startswith("| `F (a & (!b U c)) & F d`")]
    assert row.startswith(f"| `F (a & (!b U c)) & F d` | {ours} |")
    (mean,) = [line for line in lines if line.startswith("| mean | 0.95")]
    assert mean.startswith(f"| mean | {ours} | 0.989 / 10.1 |")
    assert "| DeepLTL | GCRL-LTL ‡ | LTL2Action ‡ |" in next(line for line in lines if line.startswith("| formula"))
    assert any(line.startswith("| `GF (e & (!a U f))` | 5.00 | 0.500 | 0.030 | 0.010 |") for line in lines)
    assert any("`((a \\| b \\| c \\| d) => " in line for line in lines)
    assert "Training took 1:00 on average, compilation and evaluations included (a small one)." in lines
    assert not any(line.startswith("## flatworld") for line in lines)
    assert not any("different settings" in line for line in lines)
    mixed = {run: record(60.0, seed=run.seed, epochs=run.seed // 2) for run in runs}
    assert any("The runs are of 2 different settings" in line for line in page(mixed, scores))


def test_rows_of_means_are_over_the_same_formulas() -> None:
    """Theirs are of eight of ten formulas, ours too in that row; what one seed had on all ten stands apart."""
    suite = "jaxolotl/zone_nm_finite"
    (run,) = COMPARISONS["zone-nm-jaxolotl"].runs(1)
    scores = scored(suite, 0.9, 100.0)
    scores["per_formula"][8] |= {"success_rate": 0.4, "steps_mean": None, "cut": True, "silent": True}
    lines = list(page({}, {Evaluation(run, suite): scores}))
    table = {cells[0]: cells[1:] for line in lines if len(cells := line[2:-2].split(" | ")) > 1}
    ours, theirs = slice(0, 2), table["formula"].index("StructLTL")
    assert (table["mean"][ours], table["mean"][theirs]) == (["0.850", "100.0"], "")
    assert (table["mean of 8"][ours], table["mean of 8"][theirs]) == (["0.900", "100.0"], "0.954 / 181.8")
    assert table["theirs: ALL 10 (one seed, 512 episodes each)"][theirs] == "0.952"
    (marked,) = [name for name in table if name.endswith("\\*†")]
    assert table[marked][ours] == ["0.400", ""]
    assert table["`!(purple \\| yellow) U (red & F green)`"][theirs] == "0.943 / 156.8 / 0.031"


def test_page_says_which_formulas_are_elsewhere_or_left_out() -> None:
    suites = {suite: comparison for comparison in COMPARISONS.values() for suite in comparison.suites if "/" in suite}
    scores = {Evaluation(world.runs(1)[0], suite): scored(suite, 0.5, None) for suite, world in suites.items()}
    said = [line for line in page({}, scores) if line.startswith("Formulas: ")]
    elsewhere = [suite for suite, line in zip(suites, said, strict=True) if "ask to stay are" in line]
    assert elsewhere == ["jaxolotl/zone_nm_infinite", "deepltl/zone_infinite", "jaxolotl_blue/zone_nm_infinite"]


def test_page_of_chains() -> None:
    runs = COMPARISONS["conveyor-simple-4"].runs(2)
    found = {"success_rate": 1.0, "steps_mean": 4.5, "optimal_steps_mean": 4.0}
    lines = list(page({}, {Evaluation(run, "dag"): found for run in runs}))
    assert "| 4 | 2 | 1.000 [1.000, 1.000] | 4.5 | 4 |" in lines
    nothing = {"success_rate": 0.0, "steps_mean": None, "optimal_steps_mean": None}
    assert "| 4 | 1 | 0.000 |  |  |" in list(page({}, {Evaluation(runs[0], "dag"): nothing}))


def test_known_evaluations(tmp_path: Path) -> None:
    first, second = (Evaluation(run, "deepltl/letter_finite") for run in COMPARISONS["letter12"].runs(2))
    assert read_evaluations([first], tmp_path) == {}
    some, others = scored(first.suite, 0.5, None), scored(first.suite, 0.6, None)
    line = {"run": first.run.name, "asked_steps": first.run.total_steps, "suite": first.suite, "scores": some}
    other = line | {"asked_steps": 5, "scores": others}
    (tmp_path / FILE).write_text(f"{json.dumps(line)}\n{json.dumps(other)}\n")
    assert read_evaluations([first, second], tmp_path) == {first: some}


_LINE = {"run": "a", "asked_steps": 1, "suite": "dag"}


def test_evaluations_of_formulas_that_a_suite_had_before(tmp_path: Path) -> None:
    scores = scored("deepltl/letter_infinite", 0.5, None)
    line = _LINE | {"suite": "deepltl/letter_infinite", "scores": {"per_formula": scores["per_formula"][:1]}}
    (tmp_path / FILE).write_text(json.dumps(line) + "\n")
    with pytest.raises(UserError, match="deepltl/letter_infinite has other formulas now"):
        read_evaluations([], tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"run": "a"}',
        json.dumps(_LINE),
        json.dumps(_LINE | {"scores": {"success_rate": 1.0}}),
        json.dumps(_LINE | {"scores": 1}),
        json.dumps(_LINE | {"suite": "deepltl/letter_finite", "scores": {"per_formula": [{"formula": "F a"}]}}),
    ],
)
def test_damaged_evaluations(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE).write_text(text + "\n")
    with pytest.raises(UserError, match="line 1: no evaluation"):
        read_evaluations([], tmp_path)


def test_each_run_has_layouts_of_its_own(tmp_path: Path) -> None:
    runs = COMPARISONS["letter12"].runs()
    seeds = []
    for run in runs:
        flags = parse_flags(EvaluateFlags, flags_of(Evaluation(run, "deepltl/letter_finite"), tmp_path), program="")
        assert (flags.run, flags.protocol, flags.greedy, flags.json) == (tmp_path / run.name, "jaxolotl", False, True)
        seeds.append(flags.seed)
    assert len(set(seeds)) == len(runs)
    chains = flags_of(Evaluation(COMPARISONS["conveyor-2"].runs(1)[0], "dag"), tmp_path)
    assert parse_flags(EvaluateFlags, chains, program="").episodes == 2 * EPISODES


def test_an_evaluation_that_fails_costs_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first of three has no agent. Each line is there before the next evaluation is told of."""
    asked = [Evaluation(run, "deepltl/letter_finite") for run in COMPARISONS["letter12"].runs(3)]

    def scores(evaluation: Evaluation, *_: object) -> dict[str, Any]:
        if evaluation.run.seed == 0:
            raise UserError("its agent is gone")
        return scored(evaluation.suite, 0.5, None)

    monkeypatch.setattr(evaluations, "_scores", scores)
    left = evaluations.evaluate(asked, work=tmp_path, folder=tmp_path, jobs=1)
    done = {next(left)}
    assert set(read_evaluations(asked, tmp_path)) == done
    done.add(next(left))
    with pytest.raises(UserError, match="1 evaluation failed; its agent is gone; the same command tries again"):
        next(left)
    assert set(read_evaluations(asked, tmp_path)) == done == set(asked[1:])


def test_what_an_evaluation_said_last(tmp_path: Path) -> None:
    asked = Evaluation(COMPARISONS["letter12"].runs(1)[0], "deepltl/letter_finite")
    what = r"1 evaluation failed; letter12.*seed0 on deepltl/letter_finite \(status 2\): error: .* is not a run folder"
    with pytest.raises(UserError, match=what):
        list(evaluations.evaluate([asked], work=tmp_path, folder=tmp_path, jobs=1))
    assert not list(tmp_path.iterdir())


def finished(folder: Path, steps: int) -> None:
    """A run folder as it is left, as far as it is read."""
    folder.mkdir(parents=True)
    settings = {"seed": 0, "config": {"total_steps": steps}}
    about = {"format": FORMAT, "config": settings, "config_hash": config_hash(settings)}
    about |= {"commit": "0123abc", "machine": "a small one", "versions": {}}
    (folder / "config.json").write_text(json.dumps(about))
    (folder / "summary.json").write_text(json.dumps({"env_steps": steps, "wall_s": 1.0, "final": {}}))


@pytest.mark.parametrize(("longer", "recorded", "to_make"), [(0, True, 0), (0, False, 1), (-1, True, 1), (1, True, 1)])
def test_only_the_run_that_is_asked_for_counts_as_made(
    longer: int, recorded: bool, to_make: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not one of another length; and one whose record is missing is recorded by calling it again."""
    (run,) = COMPARISONS["conveyor-2"].runs(1)
    work = tmp_path / "runs"
    if recorded:
        finished(tmp_path / run.name, run.total_steps)
        made_before = made(run, tmp_path)
        assert made_before is not None
        add_record(run, made_before, tmp_path)
    finished(work / run.name, run.total_steps + longer)
    main(["--only", "conveyor-2", "--seeds", "1", "--dry-run", "--out", str(tmp_path), "--work", str(work)])
    out, err = capsys.readouterr()
    assert err == f"1 evaluations, 1 of them missing, and {to_make} runs for them\n"
    assert len(out.splitlines()) == to_make


def test_from_finished_runs_to_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known is not evaluated again; of a run of another length nothing is said."""
    (run,) = COMPARISONS["conveyor-2"].runs(1)
    finished(tmp_path / "runs" / run.name, run.total_steps)
    record = made(run, tmp_path / "runs")
    assert record is not None
    add_record(run, record, tmp_path)
    found = {"success_rate": 1.0, "steps_mean": 11.0, "optimal_steps_mean": 11.0}
    monkeypatch.setattr(evaluations, "_scores", lambda *_: found)
    flags = ["--only", "conveyor-2", "--seeds", "1", "--out", str(tmp_path), "--jobs", "1"]
    main(flags)
    assert "| 2 | 1 | 1.000 | 11.0 | 11 |" in (tmp_path / "peers.md").read_text()
    monkeypatch.setattr(evaluations, "_scores", lambda *_: pytest.fail("evaluated again"))
    main(flags)
    finished(tmp_path / "longer" / run.name, run.total_steps + 1)
    (tmp_path / FILE).unlink()
    monkeypatch.setattr(peers, "make", lambda *_, **__: None)
    with pytest.raises(UserError, match="holds another run of that name than the one of 500,000 steps"):
        main([*flags, "--work", str(tmp_path / "longer")])
    assert not (tmp_path / FILE).exists()


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
