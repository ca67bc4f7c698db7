"""What terminals, shells and installations do to the commands: everything is said in one line that can be read."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hrlspec.run.cli import main
from hrlspec.run.errors import UserError
from hrlspec.run.platform import prepare

ROOT = Path(__file__).parents[2]


def hrlspec(*argv: str | Path, **environ: str) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "hrlspec.run.cli", *argv]
    return subprocess.run(command, env=os.environ | environ, cwd=ROOT, capture_output=True, timeout=300, check=False)


@pytest.mark.parametrize("encoding", ["ascii", pytest.param("cp1252", marks=pytest.mark.slow)])
def test_help_is_readable(encoding: str) -> None:
    ended = hrlspec("run", "--help", TERM="dumb", PYTHONIOENCODING=encoding)
    assert (ended.returncode, ended.stderr) == (0, b"")
    assert b"--total-steps" in ended.stdout
    assert b"\\" not in ended.stdout  # how a character is written that the encoding lacks
    assert ended.stdout.isascii()


def test_a_device_that_is_not_there(tmp_path: Path) -> None:
    ended = hrlspec("run", "--out", tmp_path / "run", JAX_PLATFORMS="moon")
    assert (ended.returncode, ended.stdout) == (2, b"")
    assert ended.stderr.startswith(b"error: JAX finds no device to compute on with JAX_PLATFORMS=moon; without it JAX")
    assert ended.stderr.count(b"\n") == 1
    assert not (tmp_path / "run").exists()


def without(monkeypatch: pytest.MonkeyPatch, *names: str, anew: str) -> None:
    """Hides libraries from a module that imports them."""
    for name in names:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, anew, raising=False)


@pytest.mark.parametrize("argv", ["demo rooms --out here", "evaluate --run nowhere --suite dag --draw here/x.png"])
def test_without_the_drawing_library(
    argv: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    without(monkeypatch, "matplotlib", "matplotlib.figure", anew="hrlspec.run.plots")
    assert main(argv.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith('error: no pictures without the extra "plot": pip install "hrlspec[plot]" (')
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_drawing_library_refuses_its_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import_module = importlib.import_module

    def refused(name: str) -> Any:
        if name == "hrlspec.run.plots":
            raise ValueError("Key backend: 'moon' is not a valid value")
        return import_module(name)

    monkeypatch.setattr(importlib, "import_module", refused)
    assert main(["demo", "rooms", "--out", str(tmp_path / "here")]) == 2
    assert capsys.readouterr() == ("", "error: no picture: ValueError: Key backend: 'moon' is not a valid value\n")
    assert not list(tmp_path.iterdir())


def test_without_the_physics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setattr("hrlspec.run.platform.prepare", lambda **options: None)
    assert main(["run", "--env", "zone", "--out", str(tmp_path / "here")]) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", "error: Zone's physics needs MuJoCo and MJX: pip install 'hrlspec[zone]'\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["hrlspec.gymnasium", "envs_jax.adapters.gymnasium", "envs_jax.adapters.brax"])
def test_without_the_libraries_of_others(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "gymnasium", "brax", "brax.envs.base", anew=name)
    monkeypatch.delitem(sys.modules, "envs_jax.adapters.gymnasium", raising=False)
    with pytest.raises(ImportError, match=r'the extra "adapters": pip install "hrlspec\[adapters\]"'):
        importlib.import_module(name)


def test_a_backend_that_fails_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> Any:
        raise AssertionError

    monkeypatch.setattr("hrlspec.run.platform.jax.devices", fail)
    monkeypatch.setattr("hrlspec.run.platform.jax.config.update", lambda *args: None)
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    with pytest.raises(UserError, match=r"^JAX finds no device to compute on \(AssertionError"):
        prepare()
