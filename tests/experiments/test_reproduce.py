"""The paper's figures: what they are made of, how the runs are made, what is written of them."""

from __future__ import annotations

import dataclasses
import functools
import subprocess
import sys
from pathlib import Path
from typing import cast

import numpy as np
import pytest

import envs_jax
from experiments import reproduce
from experiments.paper import claims
from experiments.paper.claims import (
    CLAIMS,
    family,
    final_return,
    findings,
    mean_return,
    no_violations,
    runs_to_decide,
    steps_to_most,
)
from experiments.paper.panels import (
    BUDGETS,
    FIRST_TRIAL_SEED,
    NUM_SEEDS,
    PANELS,
    TRAJECTORY_TASKS,
    TRIAL_SEEDS,
    TRIED,
    TUNING,
    Curve,
    Panel,
    Run,
    trajectory_run,
)
from experiments.paper.records import CURVE, add_record, read_records, record_of
from experiments.paper.report import write_report
from hrlspec import compile_task, parse
from hrlspec.methods import ImplicitPlanner
from hrlspec.presets import RECIPES, Recipe, preset
from hrlspec.run import engines
from hrlspec.run.errors import Interrupted, UserError
from hrlspec.run.experiment import Experiment
from hrlspec.run.places import Place
from hrlspec.run.planned import PlannedRun
from hrlspec.run.run_flags import experiments_of, parse_run
from tests.experiments.earlier_settings import BEFORE, before, effective
from tests.experiments.made import record
from tests.run.tiny import TOTAL, arguments

KEPT = Path(__file__).parents[2] / "results" / "paper"


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the usual bootstrap samples, which are most of what a report takes."""
    for name in ("stratified_bootstrap", "probability_of_improvement"):
        monkeypatch.setattr(claims, name, functools.partial(getattr(claims, name), resamples=200))


@functools.cache
def _first(run: Run) -> Experiment:
    return experiments_of(parse_run(run.flags))[0][0]


def experiment_now(run: Run) -> Experiment:
    """What a run's flags mean; they are parsed once for all seeds of a split."""
    first = 0 if run.split == "test" else FIRST_TRIAL_SEED
    return dataclasses.replace(_first(dataclasses.replace(run, seed=first)), seed=run.seed)


def test_there_are_nine_panels_of_the_paper_and_one_of_techniques() -> None:
    kinds = [f"{env}-{kind}" for kind in ("set1", "set2", "ablation") for env in ("letter", "walk", "zone")]
    assert list(PANELS) == [*kinds, "letter-techniques"]
    for panel in PANELS.values():
        assert panel.reward_set == (1 if panel.name.endswith("set1") else 2)
        assert all(run.total_steps == BUDGETS[panel.env] for run in panel.runs(1, None))
        assert Curve("ours", "paper") in panel.curves
    for claim in CLAIMS:
        for name in claim.panels:
            for method, switches in (claim.better, claim.worse):
                assert Curve(method, "paper", switches) in PANELS[name].curves


def test_every_run_is_one_that_can_be_made_and_has_a_name_of_its_own() -> None:
    runs = {run for panel in (PANELS | TUNING).values() for run in panel.runs(1, None)}
    trials = sum(len(rates) for tried in TRIED.values() for rates in tried.values())
    assert len({run.name for run in runs}) == len(runs) == 56 + trials
    for run in runs:
        experiment = experiment_now(run)
        assert (experiment.env, experiment.method, experiment.recipe) == (run.env, run.curve.method, run.curve.recipe)
        assert (experiment.reward_set, experiment.config.total_steps) == (run.reward_set, run.total_steps)
    (plain, no_max, no_shield) = PANELS["letter-techniques"].runs(1, None)
    experiments = [experiment_now(run) for run in (plain, no_max, no_shield)]
    planners = [cast("ImplicitPlanner", experiment.method_settings.high) for experiment in experiments]
    assert [planner.max_operator for planner in planners] == [True, False, True]
    assert [experiment.config.shield.enabled for experiment in experiments] == [True, True, False]


def test_every_method_is_tuned_alike() -> None:
    for env, panel in zip(BUDGETS, TUNING.values(), strict=True):
        runs = panel.runs(TRIAL_SEEDS, None)
        tried: dict[tuple[Recipe, str], set[float]] = {}
        for run in runs:
            assert run.split == "validation"
            rate = experiment_now(run).config.low.optimiser.learning_rate
            tried.setdefault((run.curve.recipe, run.curve.method), set()).add(rate)
        assert len(tried) == 6
        assert all(rates == {*TRIED[env, recipe][method]} for (recipe, method), rates in tried.items())
        panels = [other for name, other in PANELS.items() if name.startswith(env)]
        assert not {run.seed for run in runs} & {run.seed for other in panels for run in other.runs(NUM_SEEDS, None)}


@pytest.mark.parametrize("panel", TUNING.values(), ids=lambda panel: panel.env)
def test_presets_have_the_rates_that_tuning_chose(panel: Panel) -> None:
    """Where all of a method's trials are kept; and none of the outer rates."""
    trials: dict[tuple[Recipe, str], dict[float, list[float]]] = {}
    for run, kept in read_records(panel.runs(TRIAL_SEEDS, None), KEPT).items():
        rate = experiment_now(run).config.low.optimiser.learning_rate
        score = mean_return(kept) + final_return(kept)
        trials.setdefault((run.curve.recipe, run.curve.method), {}).setdefault(rate, []).append(score)
    for (recipe, method), scores in trials.items():
        rates = TRIED[panel.env, recipe][method]
        if sum(map(len, scores.values())) == TRIAL_SEEDS * len(rates):
            best = max(scores, key=lambda rate: np.mean(scores[rate]))
            assert min(rates) < best < max(rates)
            assert preset(panel.env).settings(method, recipe, 2)[0].low.optimiser.learning_rate == best


def test_kept_records_are_of_what_their_flags_mean_today() -> None:
    """Whoever changes a preset makes the runs with it anew and deletes the records for that, or says what changed."""
    kept = read_records([run for panel in (PANELS | TUNING).values() for run in panel.runs(NUM_SEEDS, None)], KEPT)
    assert kept
    for run, found in kept.items():
        now = dataclasses.asdict(experiment_now(run))
        assert effective(found.settings) == effective(now), run.name
        for name, value in before(found.settings).items():
            assert value in (*BEFORE[name], before(now)[name]), f"{run.name}: {name}"


def test_the_tasks_of_the_trajectories_are_tasks() -> None:
    names = envs_jax.make("walk").propositions
    trees = [compile_task(parse(text), names, max_nodes=16) for text in TRAJECTORY_TASKS]
    assert len({int(tree.depth.max()) for tree in trees}) > 1
    assert trajectory_run(None) in PANELS["walk-set1"].runs(1, None)


def test_scores_of_a_record() -> None:
    some = record([0.1, 0.5, 0.7, 0.75, 0.8], final=0.78, violations=0.25)
    assert final_return(some) == 0.78
    assert mean_return(some) == pytest.approx(0.57)
    assert no_violations(some) == -0.25
    assert steps_to_most(some) == 400  # 0.9 of 0.8 is 0.72
    assert steps_to_most(record([0.0, 0.0], 0.0)) == 100


def test_the_family_is_every_claim_wherever_its_curves_are() -> None:
    tests = family()
    assert {test.claim for test in tests} == {*CLAIMS}
    assert {test.recipe for test in tests} == {*RECIPES}
    for test in tests:
        assert len({*test.sides}) == 2
        assert {*test.sides} <= {*PANELS[test.panel].curves}
    assert len(tests) == 6 * 4 * 3 + 3 * 4 * 2 + 2
    against = {test.sides for test in tests if test.recipe == "planner"}
    ours = Curve("ours", "planner")
    others = [Curve(method, "paper") for method in ("ltl2action", "option")]
    assert against == {*((ours, other) for other in others), (others[1], ours)}


def test_findings() -> None:
    rng = np.random.default_rng(0)

    def verdicts(ours: float, option: float, seeds: int = 8) -> dict[str, str]:
        means = {Curve("ours", "paper"): ours, Curve("option", "paper"): option}
        some = {c: [record([0.5], final=m + 0.01 * rng.normal()) for _ in range(seeds)] for c, m in means.items()}
        return {test.claim.text: found.verdict for test, found in findings({"walk-set2": some}).items()}

    better, faster = "Ours ends with a better return than Option", "Ours learns faster than Option"
    assert verdicts(0.9, 0.5) == {better: "holds", faster: "undecided"}
    assert verdicts(0.5, 0.9)[better] == "does not hold"
    assert verdicts(0.7, 0.7)[better] == "undecided"
    # Of as many tests as there are fewer seeds cannot decide any.
    assert runs_to_decide() == 8
    assert verdicts(0.9, 0.5, seeds=7)[better] == "undecided"
    assert verdicts(0.9, 0.5, seeds=1) == {}


def test_the_report_is_drawn_from_records_alone_and_always_the_same(tmp_path: Path) -> None:
    panel = PANELS["letter-techniques"]
    records = {run: record([0.1 * run.seed, 0.5], 0.5 + 0.1 * run.seed) for run in panel.runs(3, None)}
    unknown = next(run for run in records if run.curve.switches == ("--no-shield",))
    final = records[unknown].final
    unscored = {**final, "suite": {**final["suite"], "spl": None}, "contested_choice": None}
    records[unknown] = dataclasses.replace(records[unknown], final=unscored)
    contents = []
    for name in ("one", "two"):
        place = tmp_path / name
        files = list(write_report([panel, PANELS["walk-set1"]], records, place / "figures", place / "docs" / "page.md"))
        assert [file.name for file in files] == ["letter-techniques.png", "page.md"]
        contents.append([file.read_bytes() for file in files])
    assert contents[0] == contents[1]
    page = contents[0][1].decode()
    assert "](../figures/letter-techniques.png)" in page
    assert "| ours without max operator (paper) | 3 | 0.600 [0.500, 0.700] | 0.600 | 50 | 0.600 | 0.600 |" in page
    assert "| ours without shield (paper) | 3 | 0.600 [0.500, 0.700] | 0.600 | 50 |  |  |" in page
    assert "first choice |" not in page  # of no record
    assert "| letter-set2 | 3 runs, 3:00 |  |  |" in page  # ours is there, too
    assert "| letter-techniques | 6 runs, 6:00 |  |  |" in page
    assert "| The max operator helps | letter-techniques | paper | 0.000 [" in page
    assert "| letter | paper | `0123abc` (9) |" in page
    assert "walk-set1" not in page


def test_the_report_tells_the_trials(tmp_path: Path) -> None:
    panel = TUNING["zone-tuning"]
    records = {run: record([0.5], 0.25) for run in panel.runs(1, None)[:2]}
    (page,) = write_report([], records, tmp_path, tmp_path / "page.md")
    assert "| zone | ours learning rate 0.0007 (paper) | 1 | 0.500 | 0.250 |" in page.read_text()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--only letter-set3", "there is no such figure, expected some of: letter-set1, walk-set1"),
        ("--seeds 0", "--seeds is 0"),
        ("--steps -1", "--steps is -1"),
        ("--jobs 0", "--jobs is 0"),
        ("--gpus-per-run 0.5", "--gpus-per-run is 0.5, expected to stand beside --ray"),
        ("--recipes secret", "there is no such recipe"),
        ("--nonsense", "Unrecognized options: --nonsense"),
    ],
)
def test_bad_input(flags: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=message):
        reproduce.main(flags.split())
    assert not list(tmp_path.iterdir())


def test_elsewhere_it_writes_where_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where everything looks like a checkout."""
    page = tmp_path / "docs" / "results.md"
    for file in (page, tmp_path / "results" / "paper" / "mine", tmp_path / "experiments" / "reproduce.py"):
        file.parent.mkdir(parents=True)
        file.write_text("mine")
    monkeypatch.chdir(tmp_path)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")}
    with pytest.raises(UserError, match=r"is not the checkout .* or give --out"):
        reproduce.main(["--draw-only"])
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")} == before
    add_record(PANELS["walk-set1"].runs(1, None)[0], record([0.5], 0.5), Path("here"))
    reproduce.main(["--draw-only", "--out", "here"])
    made = {file for file in tmp_path.rglob("*") if file not in before}
    assert {file.relative_to(tmp_path).parts[0] for file in made} == {"here"}
    assert "| walk-set1 | 1 runs" in (tmp_path / "here" / "results.md").read_text()
    assert page.read_text() == "mine"


def test_the_drawing_library_is_asked_for_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.delitem(sys.modules, "hrlspec.run.plots", raising=False)
    monkeypatch.setattr(reproduce, "make", lambda *args, **kwargs: pytest.fail("a run was made"))
    with pytest.raises(UserError, match=r'no pictures without the extra "plot": pip install "hrlspec\[plot\]"'):
        reproduce.main(["--out", str(tmp_path)])
    assert not list(tmp_path.iterdir())


def test_a_dry_run_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    panel = PANELS["walk-set1"]
    done = panel.runs(1, None)[0]
    add_record(done, record([0.5], 0.5), tmp_path)
    reproduce.main(["--only", "walk-set1", "--seeds", "2", "--dry-run", "--out", str(tmp_path)])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 13
    assert not any("--method ours --recipe paper --reward-set 1 --seed 0" in line for line in lines)


def test_what_is_there_can_be_drawn_without_what_is_missing(tmp_path: Path) -> None:
    for run in PANELS["walk-set1"].runs(1, None)[:2]:
        add_record(run, record([0.5], 0.5), tmp_path)
    page = tmp_path / "page.md"
    reproduce.main(["--draw-only", "--out", str(tmp_path), "--report", str(page), "--work", str(tmp_path / "work")])
    assert "| ltl2action (paper) | 1 | 0.500" in page.read_text()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["page.md", "walk-paper.jsonl", "walk-set1.png"]


STOPPED = """
import os, pathlib, signal, sys, time
from hrlspec.run.folder import open_run
folder, row = pathlib.Path(sys.argv[1]), dict.fromkeys(sys.argv[3:], 0.5)
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
signal.alarm(300)  # it never outlives its test
settings = {"seed": 0, "config": {"total_steps": 1_500_000}}
with open_run(folder, settings, resume=sys.argv[2] == "resume", tensorboard=False) as run:
    if run.resumed:
        run.rewind(50)
        run.append({**row, "env_steps": 100})
        run.write_summary({"env_steps": 100, "wall_s": 1.0, "final": {"suite": {"return_mean": 0.5}}})
    else:
        run.append({**row, "env_steps": 50})
        if "no-max-operator" in folder.name:
            while len(list(folder.parent.glob("*/metrics.jsonl"))) < 2:
                time.sleep(0.01)
            os.kill(os.getppid(), signal.SIGTERM)
        signal.sigwait([signal.SIGTERM])
        sys.exit(130)
"""
"""A run that has the program above it stopped, once both of two runs are half done; resumed, it finishes."""


def test_what_is_stopped_goes_on_and_what_fails_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs: stopped on the way, then ended by the same command; a third one that fails."""
    where = ["--out", str(tmp_path / "out"), "--work", str(tmp_path / "work"), "--report", str(tmp_path / "page.md")]
    flags = ["--only", "letter-techniques", "--recipes", "paper", "--seeds", "1", "--jobs", "2", *where]
    started: list[str] = []

    def start(run: PlannedRun, place: Place) -> subprocess.Popen[bytes]:
        started.append(run.name)
        code = "raise SystemExit(2)" if "no-shield" in run.name else STOPPED
        how = "resume" if "--resume" in run.arguments else "begin"
        return place.start([sys.executable, "-c", code, str(run.folder), how, *CURVE])

    monkeypatch.setattr(engines, "start_run", start)
    monkeypatch.setattr(engines, "POLL_SECONDS", 0.1)
    with pytest.raises(Interrupted, match="the same command goes on"):
        reproduce.main(flags)
    assert len(started) == 2
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit, match="1 run failed, the first is letter-ours-paper-set2-no-shield-seed0"):
        reproduce.main(flags)
    runs = PANELS["letter-techniques"].runs(1, None)
    kept = read_records(runs, tmp_path / "out")
    assert [run.curve.switches for run in kept] == [(), ("--no-max-operator",)]
    assert [record.curve["env_steps"] for record in kept.values()] == [[50, 100]] * 2
    # What is done is not done again.
    before = len(started)
    monkeypatch.setattr(subprocess, "Popen", lambda *args, **kwargs: pytest.fail("started again"))
    panel = dataclasses.replace(PANELS["letter-techniques"], curves=tuple(run.curve for run in kept))
    monkeypatch.setitem(reproduce.PANELS, "letter-techniques", panel)
    reproduce.main(flags)
    assert len(started) == before
    assert "letter-techniques" in (tmp_path / "page.md").read_text()


@pytest.mark.slow
def test_a_real_run_leaves_a_record(tmp_path: Path) -> None:
    """A tiny one, by the command that makes the others."""
    run = Run("letter", 1, Curve("ours", "hrlspec"), 0, TOTAL)
    subprocess.run([sys.executable, "-m", "experiments.run", *arguments(tmp_path / run.name)], check=True)
    found = record_of(tmp_path / run.name)
    assert found is not None
    assert found.curve["env_steps"][-1] == found.env_steps == TOTAL
    assert None not in found.curve["train/violations"]
    by_depth = found.final["suite"]["per_depth"]
    assert len(by_depth["depth"]) == len(by_depth["success_rate_interval"]) > 0
    assert 0 <= final_return(found) <= 1
    add_record(run, found, tmp_path)
    assert read_records([run], tmp_path) == {run: found}
