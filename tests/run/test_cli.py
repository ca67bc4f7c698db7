"""The console command: its sub-commands, the modules that do the same, and what it says when it cannot go on."""

from __future__ import annotations

import runpy
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hrlspec.run import cli
from hrlspec.run.cli import COMMANDS, main
from hrlspec.version import __version__

ROOT = Path(__file__).parents[2]


def test_help_lists_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    for name, about in COMMANDS.items():
        assert f"{name} " in out
        assert about in out


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"hrlspec {__version__}\n"


def test_as_a_module(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hrlspec.run.cli", "reproduce"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert len(ended.stderr.splitlines()) == 1
    assert "checkout" in ended.stderr


@pytest.mark.parametrize("argv", [[], ["fly"], ["--fly"]])
def test_anything_else_is_refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == (
        f"error: expected a command, one of {', '.join(COMMANDS)}, found {''.join(argv)!r} (see hrlspec --help)\n"
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_sub_commands_call_themselves_by_their_name(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)  # a checkout, which one of them needs
    assert main([name, "--no-such-flag"]) == 2
    assert capsys.readouterr().err.endswith(f"(see hrlspec {name} --help)\n")
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert not stop.value.code
    assert capsys.readouterr().out.startswith(f"usage: hrlspec {name} ")


@pytest.mark.parametrize("name", COMMANDS)
def test_so_do_the_modules(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", [name, "--no-such-flag"])
    monkeypatch.delitem(sys.modules, f"experiments.{name}", raising=False)  # else there is a warning
    before = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit) as stop:
            runpy.run_module(f"experiments.{name}", run_name="__main__")
    finally:
        signal.signal(signal.SIGINT, before)
    assert stop.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.endswith(f"(see python -m experiments.{name} --help)\n")


def test_reproduce_needs_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: reproduce works on the records and pages of a checkout of hrlspec")
    assert err.count("\n") == 1


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    import_module = cli.importlib.import_module

    def missing(name: str) -> Any:
        if name == "hrlspec.run.commands.run":
            raise ModuleNotFoundError("No module named 'tyro'", name="tyro")
        return import_module(name)

    monkeypatch.setattr(cli.importlib, "import_module", missing)
    assert main(["run"]) == 2
    assert capsys.readouterr().err == ('error: the commands need the extra "cli": pip install "hrlspec[cli]"\n')
    assert main(["--help"]) == 0
