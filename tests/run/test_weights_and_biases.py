"""Weights & Biases is told what TensorBoard is, in one run however often it is resumed, and never in the way."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from hrlspec.run.commands import run as command
from hrlspec.run.errors import UserError, main_guard
from hrlspec.run.folder import open_run, read_metrics

ROOT = Path(__file__).parents[2]


class Told:
    """One run of `FakeWandb`."""

    def __init__(self, options: dict[str, Any]) -> None:
        self.options, self.rows = options, list[dict[str, float]]()
        self.axis: tuple[str, str] | None = None
        self.exit_code: int | None = None

    def define_metric(self, name: str, step_metric: str) -> None:
        self.axis = name, step_metric

    def log(self, row: dict[str, float]) -> None:
        self.rows.append(row)

    def finish(self, exit_code: int) -> None:
        self.exit_code = exit_code


class FakeWandb(ModuleType):
    """As much of the library as is used."""

    def __init__(self) -> None:
        super().__init__("wandb")
        self.runs: list[Told] = []
        self.Settings = dict

    def init(self, **options: Any) -> Told:
        self.runs.append(Told(options))
        return self.runs[-1]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeWandb:
    module = FakeWandb()
    monkeypatch.setitem(sys.modules, "wandb", module)
    monkeypatch.delitem(sys.modules, "hrlspec.run.weights_and_biases", raising=False)
    return module


def test_rows_and_final_results_are_told(tmp_path: Path, fake: FakeWandb) -> None:
    config = {"seed": 3, "config": {"total_steps": 20}}
    with open_run(tmp_path / "some run", config, tensorboard=False, wandb="hrl") as run:
        run.append({"env_steps": 10, "eval/success_rate": 0.5, "eval/spl": float("nan"), "method": "ours"})
        final = {
            "suite": {"success_rate": 0.75, "shield": False, "per_depth": {"2": {"spl": 0.5}}, "per_task": [{"a": 1}]}
        }
        run.tell(20, {"final": final})
    (told,) = fake.runs
    assert told.options["project"] == "hrl"
    assert told.options["name"] == "some run"
    assert told.options["config"] == config
    assert told.options["dir"] == str(tmp_path / "some run")
    assert told.axis == ("*", "env_steps")
    assert told.rows == [
        {"env_steps": 10, "eval/success_rate": 0.5},
        {"env_steps": 20, "final/suite/success_rate": 0.75, "final/suite/per_depth/2/spl": 0.5},
    ]
    assert told.exit_code == 0


def test_a_resumed_run_goes_on_in_the_same(tmp_path: Path, fake: FakeWandb) -> None:
    with contextlib.suppress(KeyboardInterrupt), open_run(tmp_path, {}, tensorboard=False, wandb="hrl") as run:
        run.append({"env_steps": 10})
        raise KeyboardInterrupt
    for project in ("hrl", None):
        with open_run(tmp_path, {}, resume=True, tensorboard=False, wandb=project) as run:
            run.rewind(10)
            run.append({"env_steps": 20})
    first, second = fake.runs
    assert first.options["id"] == second.options["id"] == json.loads((tmp_path / "wandb.json").read_text())["id"]
    assert second.options["resume"] == "allow"
    assert (first.exit_code, second.exit_code) == (1, 0)
    with (
        open_run(tmp_path, {}, resume=True, tensorboard=False, wandb="other") as run,
        pytest.raises(UserError, match="is told to the W&B project hrl, not other: resume with --wandb hrl"),
    ):
        run.rewind(20)
    (tmp_path / "wandb.json").write_text("{")
    with (
        open_run(tmp_path, {}, resume=True, tensorboard=False, wandb="hrl") as run,
        pytest.raises(UserError, match=r"cannot read .*wandb.json: JSONDecodeError"),
    ):
        run.rewind(20)
    assert len(fake.runs) == 2


def test_runs_have_ids_of_their_own(tmp_path: Path, fake: FakeWandb) -> None:
    for name in "ab":
        with open_run(tmp_path / name, {}, tensorboard=False, wandb="hrl"):
            pass
    assert len({told.options["id"] for told in fake.runs}) == 2


def test_what_fails_stops_nothing(tmp_path: Path, fake: FakeWandb, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Told, *args: object, **options: object) -> None:
        raise ConnectionError

    monkeypatch.setattr(Told, "log", fail)
    monkeypatch.setattr(Told, "finish", fail)
    with open_run(tmp_path, {}, tensorboard=False, wandb="hrl") as run:
        run.append({"env_steps": 1})
    assert read_metrics(tmp_path) == [{"env_steps": 1}]


def test_what_cannot_begin_leaves_nothing(tmp_path: Path, fake: FakeWandb, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**options: object) -> None:
        raise RuntimeError("No API key\nconfigured")

    monkeypatch.setattr(fake, "init", refuse)
    with (
        pytest.raises(UserError, match="Weights & Biases does not begin: RuntimeError: No API key configured"),
        open_run(tmp_path / "run", {}, wandb="hrl"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_without_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor with a folder of that name, as W&B leaves them, which Python takes for a module."""
    folder = ModuleType("wandb")
    folder.__file__ = None
    for module in (None, folder):
        monkeypatch.setitem(sys.modules, "wandb", module)
        assert main_guard(lambda: command.main(["--wandb", "hrl", "--out", str(tmp_path / "run")])) == 2
        expected = 'error: --wandb needs the extra "wandb": pip install "hrlspec[wandb]"\n'
        assert capsys.readouterr() == ("", expected)
    assert list(tmp_path.iterdir()) == []


def test_nothing_of_it_is_imported_unless_asked_for(tmp_path: Path) -> None:
    code = """
import sys
from hrlspec.run.folder import open_run
with open_run(sys.argv[1], {}) as run:
    run.append({"env_steps": 1})
print([name for name in sys.modules if "wandb" in name or "weights" in name])
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


@pytest.mark.slow
def test_the_library_itself_offline(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    code = """
import os, sys
os.environ |= {"WANDB_MODE": "offline", "WANDB_SILENT": "true"}
from hrlspec.run.folder import open_run
resume = sys.argv[2] == "resume"
with open_run(sys.argv[1], {"seed": 7}, resume=resume, wandb="hrl") as run:
    if resume:
        run.rewind(1)
    run.append({"env_steps": 2 if resume else 1, "eval/success_rate": 0.5})
"""
    for how in ("begin", "resume"):
        command = [sys.executable, "-c", code, str(tmp_path / "run"), how]
        subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    id_ = json.loads((tmp_path / "run" / "wandb.json").read_text())["id"]
    files = sorted((tmp_path / "run" / "wandb").glob(f"offline-run-*-{id_}/run-{id_}.wandb"))
    assert len(files) == 2
    for file in files:
        assert b"eval/success_rate" in file.read_bytes()
