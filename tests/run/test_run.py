"""``hrlspec.run.commands.run`` for real, on a tiny agent: what it leaves, and that nothing stops it for good."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache
from PIL import Image

import hrlspec
from hrlspec import checkpoint
from hrlspec.agent_files import read_agent
from hrlspec.checkpoint import state_hash
from hrlspec.run import plots, signals
from hrlspec.run.commands import evaluate, export, run
from hrlspec.run.errors import main_guard
from hrlspec.run.experiment import experiment_of
from hrlspec.run.folder import read_metrics, read_record
from hrlspec.run.learner import Learner
from hrlspec.run.progress import ProgressDisplay
from hrlspec.run.run_flags import experiments_of, parse_run
from hrlspec.spec import RUNNING, SATISFIED
from hrlspec.spec.dfa import from_json
from tests.run import tiny
from tests.run.made import rows

ROOT = Path(__file__).parents[2]
PATIENCE = 900  # seconds; a busy machine may need most of it to load the programs


@pytest.fixture(scope="module", autouse=True)
def compiled_programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A compilation cache that this process and those it starts share."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(tmp_path_factory.mktemp("jax"))
    before = (
        jax.config.values["jax_compilation_cache_dir"],
        jax.config.values["jax_persistent_cache_min_compile_time_secs"],
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", folder)
        patch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()  # it looks at its configuration once
        yield
    jax.config.update("jax_compilation_cache_dir", before[0])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before[1])
    compilation_cache.reset_cache()


def call(*argv: str) -> int:
    return main_guard(lambda: run.main(argv))


def final_hash(folder: Path) -> str:
    """Of the training state in the last checkpoint."""
    experiment = experiment_of(read_record(folder)["config"], str(folder))
    learner = Learner(experiment, experiment.preset)
    restored = checkpoint.load(folder / "checkpoints", learner.job().init())
    assert restored.step == tiny.TOTAL
    assert restored.skipped == ()
    return state_hash(restored.state)


def results(folder: Path) -> Any:
    return json.loads((folder / "summary.json").read_text())["final"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run."""
    folder = tmp_path_factory.mktemp("runs") / "lr[0.1] \\ any"  # every path works
    assert call(*tiny.arguments(folder)) == 0
    return folder


def test_more_devices_than_there_are_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    many = jax.device_count() + 1
    flags = ["--config.num-envs", str(8 * many), "--config.blocks", str(many), "--devices", str(many)]
    assert call(*tiny.arguments(tmp_path / "run", *flags)) == 2
    assert f"--devices is {many}, but JAX has {many - 1} (cpu)" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_what_a_run_leaves(finished: Path) -> None:
    record = read_record(finished)
    assert record["config"]["config"]["num_envs"] == 8
    assert record["config"]["config"]["total_steps"] == tiny.TOTAL
    assert [row["env_steps"] for row in read_metrics(finished)] == [400, 800, 960]
    for row in read_metrics(finished):
        expected = {"wall_s", "level", "eval/return_mean", "eval/success_rate", "eval/steps_mean", "eval/spl"}
        expected |= {"train/steps_per_s", "train/success_rate", "low/policy_loss", "high/transe_loss"}
        assert expected <= row.keys()
        assert 0 <= row["eval/success_rate"] <= 1
        assert row["level"] in (1, 2)
    summary = json.loads((finished / "summary.json").read_text())
    assert summary["env_steps"] == tiny.TOTAL
    suite = summary["final"]["suite"]
    assert suite["episodes"] == 20
    assert len(suite["per_task"]) == 2
    assert 0 <= suite["spl"] <= suite["success_rate"] <= 1
    assert (finished / "tensorboard").is_dir()
    assert checkpoint.steps(finished / "checkpoints")[-1] == tiny.TOTAL
    assert {"plots/curves.png", "plots/episode.gif", "plots/example_4.png", "plots/task_2.png"} <= set(
        summary["pictures"]
    )
    for picture in summary["pictures"]:
        with Image.open(finished / picture) as image:
            assert min(image.size) > 100


def test_a_finished_run_is_left_alone(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {file: file.stat().st_mtime_ns for file in finished.rglob("*")}
    assert call(*tiny.arguments(finished)) == 2
    assert "holds a run already" in capsys.readouterr().err
    assert call(*tiny.arguments(finished, "--resume", "--seed", "1")) == 2
    assert "begun with seed = 0, not 1" in capsys.readouterr().err
    assert call(*tiny.arguments(finished, "--resume", "--total-steps", str(tiny.TOTAL - 1))) == 2
    assert f"begun with --total-steps {tiny.TOTAL}: give more, or the same" in capsys.readouterr().err
    assert call(*tiny.arguments(finished, "--resume", "--config.total-steps", "9999")) == 0
    assert "is finished" in capsys.readouterr().out  # --total-steps prevails
    assert call(*tiny.arguments(finished, "--resume")) == 0
    assert "is finished" in capsys.readouterr().out
    assert {file: file.stat().st_mtime_ns for file in finished.rglob("*")} == before


@pytest.mark.slow
def test_a_finished_run_becomes_longer(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "longer"
    shutil.copytree(finished, folder)
    longer = tiny.TOTAL + 1  # one iteration more
    assert call(*tiny.arguments(folder, "--resume", "--total-steps", str(longer))) == 0
    err = capsys.readouterr().err
    assert f"continuing after {tiny.TOTAL:,} steps, now to {longer:,} instead of {tiny.TOTAL:,}; what changes " in err
    assert "--config.low.entropy from 0.004 to 0.00523, " in err  # 0.02 to 0.004, 12/13 of the way
    assert "--config.low.optimiser.learning-rate from 0 to 5.38e-05, " in err
    assert "--method.high.ppo.optimiser.learning-rate from 0 to 2.31e-05\n" in err
    before, after = rows(finished), rows(folder)
    assert after[: len(before)] == before
    assert [row["env_steps"] for row in after[len(before) :]] == [tiny.TOTAL + tiny.STEPS]
    assert json.loads((folder / "summary.json").read_text())["env_steps"] == tiny.TOTAL + tiny.STEPS
    assert (folder / f"summary-{tiny.TOTAL}.json").read_bytes() == (finished / "summary.json").read_bytes()
    assert read_record(folder)["earlier"][0]["changed"] == {"config.total_steps": tiny.TOTAL}
    assert call(*tiny.arguments(folder, "--resume")) == 2
    assert f"begun with --total-steps {longer}: give more, or the same" in capsys.readouterr().err


@contextmanager
def running(folder: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    """A run in a process of its own, which is gone when the context ends, whatever happens."""
    command = [sys.executable, "-m", "experiments.run", *tiny.arguments(folder, "--checkpoint-minutes", "0", *more)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for_step(folder: Path, least: int, process: subprocess.Popen[str]) -> None:
    end = time.monotonic() + PATIENCE
    while not any(step >= least for step in checkpoint.steps(folder / "checkpoints")):
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < end
        time.sleep(0.005)


def flip_a_bit(folder: Path) -> None:
    """In the arrays of the newest checkpoint."""
    newest = sorted((folder / "checkpoints").glob("step_*"))[-1]
    file = max((newest / "arrays").rglob("*"), key=lambda path: path.stat().st_size if path.is_file() else -1)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 16
    file.write_bytes(content)


def test_terminated_killed_and_damaged_it_ends_as_if_left_in_peace(
    finished: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "run"
    with running(folder) as process:
        wait_for_step(folder, 1, process)
        process.send_signal(signal.SIGTERM)
        said = process.communicate(timeout=PATIENCE)[1].strip().splitlines()[-1]
        assert process.returncode == 130
    assert said.startswith("interrupted: SIGTERM after ")
    stopped = checkpoint.steps(folder / "checkpoints")[-1]
    assert f"SIGTERM after {stopped} of {tiny.TOTAL} environment steps" in said
    assert stopped < tiny.TOTAL - 2 * tiny.STEPS

    with running(folder, "--resume") as process:
        wait_for_step(folder, stopped + 2 * tiny.STEPS, process)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL

    flip_a_bit(folder)
    assert call(*tiny.arguments(folder, "--resume")) == 0
    assert "does not match its SHA-256; falling back to step" in caplog.text
    assert final_hash(folder) == final_hash(finished)
    assert rows(folder) == rows(finished)
    assert results(folder) == results(finished)


def test_a_signal_during_the_final_evaluation(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "run"
    said: list[str] = []

    def interrupted(self: Learner, params: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        raise ConnectionAbortedError  # the process would be gone

    monkeypatch.setattr(signals, "_end", said.append)
    monkeypatch.setattr(Learner, "final_results", interrupted)
    with pytest.raises(ConnectionAbortedError):
        call(*tiny.arguments(folder))
    assert said == [f"during the final evaluation; training is saved in {folder}, --resume ends it"]
    assert not (folder / "summary.json").exists()
    monkeypatch.undo()
    assert call(*tiny.arguments(folder, "--resume")) == 0
    assert rows(folder) == rows(finished)
    assert results(folder) == results(finished)


@pytest.mark.slow
def test_several_seeds_skip_what_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = tiny.arguments(tmp_path, "--num-seeds", "2", "--seed", "3", "--no-parallel-seeds")
    advance, calls = ProgressDisplay.advance, 0

    def stop_in_the_second_run(self: ProgressDisplay, env_steps: int, metrics: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == tiny.ITERATIONS + 4:
            os.kill(os.getpid(), signal.SIGTERM)
        advance(self, env_steps, metrics)

    monkeypatch.setattr(ProgressDisplay, "advance", stop_in_the_second_run)
    assert call(*flags) == 130
    assert (tmp_path / "seed3" / "summary.json").exists()
    assert not (tmp_path / "seed4" / "summary.json").exists()
    monkeypatch.undo()
    capsys.readouterr()
    assert call(*flags) == 2
    assert "seed3 holds a run already" in capsys.readouterr().err
    assert call(*flags, "--resume") == 0
    out = capsys.readouterr().out
    assert "seed3 is finished" in out
    assert "seeds 3 to 4" in out
    assert "interquartile mean" in out
    assert results(tmp_path / "seed3") != results(tmp_path / "seed4")


@pytest.mark.slow
def test_seeds_side_by_side_are_stopped_and_go_on_alone_and_together(
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Each is what it is alone but for rounding, and from the second evaluation on nothing is compiled for them."""
    flags = tiny.arguments(tmp_path / "both", "--num-seeds", "2", "--parallel-seeds", "--checkpoint-minutes", "0")
    advance, row, calls = ProgressDisplay.advance, ProgressDisplay.row, 0

    def stop_in_the_fourth(self: ProgressDisplay, env_steps: int, metrics: Any) -> None:
        nonlocal calls
        calls += 1
        if calls == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        advance(self, env_steps, metrics)

    with monkeypatch.context() as patch:
        patch.setattr(ProgressDisplay, "advance", stop_in_the_fourth)
        assert call(*flags) == 130
    assert f"in each of {tmp_path}/both/seed0 to {tmp_path}/both/seed1, --resume" in capsys.readouterr().err
    folders = [tmp_path / "both" / f"seed{seed}" for seed in (0, 1)]
    stopped = [checkpoint.steps(folder / "checkpoints")[-1] for folder in folders]
    assert stopped[0] == stopped[1] < 400

    shutil.copytree(folders[0], tmp_path / "alone")
    assert call(*tiny.arguments(tmp_path / "alone", "--resume")) == 0

    def log_from_now_on(self: ProgressDisplay, some: Any) -> None:
        row(self, some)
        jax.config.update("jax_log_compiles", True)

    def log_no_longer(self: Learner, params: Any) -> Any:
        jax.config.update("jax_log_compiles", False)
        return final_results(self, params)

    final_results = Learner.final_results
    caplog.clear()
    with monkeypatch.context() as patch:
        patch.setattr(ProgressDisplay, "row", log_from_now_on)
        patch.setattr(Learner, "final_results", log_no_longer)
        assert call(*flags, "--resume") == 0
    assert [said for said in caplog.messages if "ompil" in said] == []
    assert "seeds 0 to 1" in capsys.readouterr().out
    for folder in (folders[0], tmp_path / "alone"):
        for mine, its in zip(rows(folder), rows(finished), strict=True):
            assert mine == pytest.approx(its, rel=1e-2, abs=1e-3)
    assert results(folders[0]) != results(folders[1])
    assert call(*flags, "--resume") == 0
    assert "seed1 is finished" in capsys.readouterr().out


def test_parameters_that_are_not_finite_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    iterate, advance, skipped = Learner._iterate, ProgressDisplay.advance, []

    def poisoned(self: Learner, state: Any, index: int) -> Any:
        if index == 2:
            state = state.replace(params=jax.tree.map(lambda x: x * jnp.nan, state.params))
        return iterate(self, state, index)

    def watch(self: ProgressDisplay, env_steps: int, metrics: Any) -> None:
        skipped.append(metrics["low/skipped"])
        advance(self, env_steps, metrics)

    monkeypatch.setattr(Learner, "_iterate", poisoned)
    monkeypatch.setattr(ProgressDisplay, "advance", watch)
    with pytest.raises(SystemExit) as stop:  # a message instead of a number: printed, and status 1
        call(*tiny.arguments(tmp_path / "run"))
    assert str(stop.value).startswith("error: parameters are not finite at environment step 400; nothing was saved")
    assert skipped == [0, 0, 1, 1, 1]
    assert not (tmp_path / "run" / "checkpoints").exists()


# An agent from such a run, evaluated. Two trees of 9 to 16 nodes and 20 episodes: the program is compiled already.
LARGE = "achieve a; achieve b; achieve c; (achieve d or achieve e); achieve b; achieve a; achieve c"


def test_evaluate_prints_one_json_object(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    specs = tmp_path / "tasks.txt"
    specs.write_text(f"# two tasks\n{LARGE}\n\nachieve a # the first letter\n")
    flags = ["--run", str(finished), "--spec-file", str(specs), "--episodes", "20", "--json"]
    assert main_guard(lambda: evaluate.main(flags)) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert out.count("\n") == 1
    report = json.loads(out, parse_constant=pytest.fail)
    expected = {"success_rate", "return_mean", "steps_mean", "spl", "episodes", "per_task", "run", "checkpoint_step"}
    assert expected | {"success_rate_interval", "spl_interval"} <= report.keys()
    assert report["episodes"] == 20
    assert report["checkpoint_step"] == tiny.TOTAL
    assert [task["task"] for task in report["per_task"]] == [LARGE, "achieve a"]
    assert [task["episodes"] for task in report["per_task"]] == [10, 10]
    assert main_guard(lambda: evaluate.main(flags)) == 0
    assert json.loads(capsys.readouterr().out) == report  # seeded
    assert main_guard(lambda: evaluate.main([*flags, "--seed", "1"])) == 0
    assert json.loads(capsys.readouterr().out)["per_task"] != report["per_task"]


def test_what_cannot_be_drawn_costs_one_line(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The results are there; a run whose pictures are missing without a reason is ended again."""

    def no_latex(*args: Any) -> Any:
        raise RuntimeError("latex could not be found:\n[/] see the log")

    folder = tmp_path / "run [bold red]"
    shutil.copytree(finished, folder)
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").write_text(json.dumps({name: summary[name] for name in summary if name != "pictures"}))
    monkeypatch.setattr(plots, "examples", no_latex)
    monkeypatch.setattr(plots, "episodes_of", no_latex)
    assert call(*tiny.arguments(folder, "--resume")) == 0
    said = "no picture: RuntimeError: latex could not be found: [/] see the log"
    assert capsys.readouterr().out.splitlines()[-2:] == [said, f"results, curves and pictures: {folder}"]
    assert json.loads((folder / "summary.json").read_text()) == summary | {"pictures": ["plots/curves.png"]}
    flags = ["--run", str(folder), "--spec", LARGE, "--episodes", "20", "--json", "--draw", str(tmp_path / "x.png")]
    assert main_guard(lambda: evaluate.main(flags)) == 2
    out, err = capsys.readouterr()
    assert json.loads(out)["episodes"] == 20
    assert err == f"error: {said}\n"


def test_an_automaton_is_written_and_read_again(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What no tree says, in every form; read again it is the same task, and goes the same way."""

    def report(*flags: str) -> dict[str, Any]:
        given = ["--run", str(finished), *flags, "--episodes", "20", "--json"]
        assert main_guard(lambda: evaluate.main(given)) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        (scores,) = found["per_formula"]
        return scores

    dot, svg, hoa, dfa = (tmp_path / "new" / f"task.{form}" for form in ("dot", "svg", "hoa", "json"))
    spec = "achieve a; ((achieve b; achieve d) ensuring not c)"
    first = report("--spec", spec, "--semantics", "exact", "--automaton", str(hoa))
    assert (first["formula"], first["automaton_states"]) == (spec, 4)
    for flag, given, file in (("--hoa", hoa, dfa), ("--dfa", dfa, dot), ("--dfa", dfa, svg)):
        assert report(flag, str(given), "--automaton", str(file)) == first | {"formula": given.name}
    assert '  2 -> 1 [label="c"]\n' in dot.read_text()
    assert svg.read_text().startswith("<?xml")


def test_the_automaton_of_a_tree_is_written_beside_its_results(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--run", str(finished), "--spec", LARGE, "--episodes", "20", "--json"]
    assert main_guard(lambda: evaluate.main([*flags, "--automaton", str(tmp_path / "task.json")])) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 20
    automaton = from_json((tmp_path / "task.json").read_text(), "abcde", [set(), *"abcde"])
    assert automaton.run("aabceebac") == SATISFIED
    assert automaton.run("abceba") == RUNNING


def test_evaluate_prints_a_table(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--run", str(finished), "--spec", LARGE, "--episodes", "20", "--step", str(tiny.TOTAL)]
    assert main_guard(lambda: evaluate.main(flags)) == 0
    out = capsys.readouterr().out
    assert "depth 7" in out
    assert "SPL" in out
    assert all(len(line) <= 100 and "…" not in line for line in out.splitlines())


def test_a_damaged_checkpoint_is_not_evaluated_silently(
    finished: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    newest = sorted((finished / "checkpoints").glob("step_*"))[-1]
    manifest = newest / "manifest.json"
    intact = manifest.read_bytes()
    manifest.write_bytes(intact.replace(b"float32", b"float64", 1))
    try:
        flags = ["--run", str(finished), "--spec", LARGE, "--step", str(tiny.TOTAL)]
        assert main_guard(lambda: evaluate.main(flags)) == 2
        assert "is damaged" in capsys.readouterr().err
    finally:
        manifest.write_bytes(intact)
    del caplog


# Environments and methods of somebody else's, in a module in the current directory.
WORLD = """
import dataclasses
from envs_jax.rooms.world import Rooms
from hrlspec.methods import ImplicitPlanner, Ours

def three_rooms():
    return Rooms(horizon=40)

@dataclasses.dataclass(frozen=True)
class Patient(Ours):
    name = "patient"
    about = "ours, with a setting of its own"
    patience: int = 3

PATIENT = Patient(high=dataclasses.replace(ImplicitPlanner(), transe_margin=2.0))
"""


@pytest.mark.slow
def test_an_environment_and_a_method_of_somebody_elses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Trained, evaluated and drawn without being registered; its tasks are those in the folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)  # and forgotten again
    (tmp_path / "a_world.py").write_text(WORLD)
    named = ("--env", "a_world:three_rooms", "--method", "a_world:PATIENT", "--method.patience", "5")
    flags = tiny.arguments(Path("run"), *named)
    assert call(*flags) == 0, capsys.readouterr().err
    config = read_record("run")["config"]
    assert config["method_settings"]["patience"] == 5
    assert config["method_settings"]["high"]["transe_margin"] == 2.0
    experiment = experiment_of(config, "run")
    assert type(experiment.method_settings).__name__ == "Patient"
    assert experiment.name == "a_world.three_rooms-a_world.PATIENT-hrlspec-set1-seed0"
    summary = json.loads(Path("run/summary.json").read_text())
    tasks = [task["task"] for task in summary["final"]["suite"]["per_task"]]
    assert tasks == [line for line in Path("run/tasks/dag.txt").read_text().splitlines() if line[0] != "#"]
    assert "plots/episode.gif" in summary["pictures"]
    # The tasks are read from the folder, whatever would be drawn now.
    Path("run/tasks/dag.txt").write_text("achieve blue; achieve red; achieve blue\n")
    capsys.readouterr()
    assert main_guard(lambda: evaluate.main(["--run", "run", "--suite", "dag", "--episodes", "20", "--json"])) == 0
    (task,) = json.loads(capsys.readouterr().out)["per_task"]
    assert task["task"] == "achieve blue; achieve red; achieve blue"
    Path("run/summary.json").unlink()
    assert call(*flags, "--resume") == 0
    assert "(1 task, 10 episodes)" in capsys.readouterr().out
    Path("run/tasks/dag.txt").write_bytes(b"\xff")
    Path("run/summary.json").unlink()
    assert call(*flags, "--resume") == 2
    assert "no test tasks in run/tasks/dag.txt" in capsys.readouterr().err


# The same agent as a file.


@pytest.fixture(scope="module")
def exported(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("exported") / "it.safetensors"
    flags = ["--run", str(finished), "--out", str(file), "--tasks", "2"]
    assert main_guard(lambda: export.main(flags)) == 0
    return file


def test_what_an_export_says(finished: Path, exported: Path) -> None:
    card, record = json.loads(exported.with_suffix(".json").read_text()), read_record(finished)
    assert card["config"] == record["config"]
    assert card["env_steps"] == tiny.TOTAL
    assert card["trained"] == {"commit": record["commit"], "versions": record["versions"]}
    assert card["results"].keys() == card["success_at_least"].keys() == {"dag", "branches", "deeper", "wider"}
    for suite, score in card["results"].items():
        assert score["episodes"] == 20
        assert 0 <= score["success_rate_interval"][0] - card["success_at_least"][suite] < 1e-3


@pytest.mark.parametrize("tasks", [("--spec", LARGE), ("--ltl", "F a")])
def test_an_exported_agent_acts_as_the_run_does(
    tasks: tuple[str, str], finished: Path, exported: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """To the bit: parameters, actions, and so all scores."""
    trained = hrlspec.pretrained(exported)
    state = checkpoint.load(finished / "checkpoints", {"params": trained.params}, partial=True).state
    assert state_hash(state["params"]) == state_hash(trained.params)
    reports = []
    for agent in (["--run", str(finished)], ["--pretrained", str(exported)]):
        assert main_guard(lambda agent=agent: evaluate.main([*agent, *tasks, "--episodes", "20", "--json"])) == 0
        reports.append(json.loads(capsys.readouterr().out))
    assert (reports[0].pop("run"), reports[0].pop("checkpoint_step")) == (str(finished), tiny.TOTAL)
    assert (reports[1].pop("pretrained"), reports[1].pop("env_steps")) == (str(exported), tiny.TOTAL)
    assert reports[0] == reports[1]


def test_training_begins_with_an_exported_agent(exported: Path, tmp_path: Path) -> None:
    """Everything but the parameters is fresh."""
    ((experiment, _),) = experiments_of(parse_run(tiny.arguments(tmp_path / "run", "--from", str(exported))))
    given = hrlspec.pretrained(exported).params
    fresh = Learner(experiment, experiment.preset).job().init()
    begun = Learner(experiment, experiment.preset, params=given).job().init()
    assert state_hash({name: begun.params[name] for name in given}) == state_hash(given)
    assert state_hash(begun.replace(params=fresh.params)) == state_hash(fresh)
    assert state_hash(begun.params["reach_critic"]) == state_hash(fresh.params["reach_critic"])
    assert jax.tree.map(lambda x: x.sharding, begun) == jax.tree.map(lambda x: x.sharding, fresh)


@pytest.mark.slow
def test_training_goes_on_from_an_exported_agent(
    finished: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run that goes on needs the same parameters to begin from."""
    folder, file = tmp_path / "run", read_agent(exported)
    flags = tiny.arguments(folder, "--from", str(exported))
    assert call(*flags) == 0
    assert read_record(folder)["config"]["begun_from"] == file.card.sha256
    assert rows(folder) != rows(finished)
    capsys.readouterr()
    assert call(*tiny.arguments(folder, "--resume")) == 2
    assert f"begun with begun_from = '{file.card.sha256}', not None" in capsys.readouterr().err
    assert call(*flags, "--resume") == 0
    assert "is finished" in capsys.readouterr().out
