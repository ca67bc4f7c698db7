"""The exit status and the one line of every way a command line can end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hrlspec.checkpoint import CheckpointMissingError
from hrlspec.run.errors import Interrupted, UserError, main_guard

ROOT = Path(__file__).parents[2]


def raising(error: BaseException):
    def main() -> None:
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (UserError("no such\n  folder"), 2, "error: no such folder\n"),
        (CheckpointMissingError("no checkpoint in x"), 2, "error: no checkpoint in x\n"),
        (Interrupted("checkpoint of step 5 written"), 130, "interrupted: checkpoint of step 5 written\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_what_ends_in_one_line(
    error: BaseException, status: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main_guard(raising(error)) == status
    assert capsys.readouterr() == ("", line)


def test_a_bad_specification_ends_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    from hrlspec.spec import parse

    assert main_guard(lambda: print(parse("achieve a ;; b"))) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_success_is_silent(capsys: pytest.CaptureFixture[str]) -> None:
    assert main_guard(lambda: None) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("error", [ZeroDivisionError(), SystemExit(2)])
def test_bugs_and_exits_pass_through(error: BaseException) -> None:
    with pytest.raises(type(error)):
        main_guard(raising(error))


def test_the_handler_of_sigterm_comes_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    assert main_guard(lambda: os.kill(os.getpid(), signal.SIGTERM)) == 130
    assert signal.getsignal(signal.SIGTERM) is before


def run_script(body: str, pipe: str = "") -> subprocess.CompletedProcess[str]:
    script = f"import sys\nfrom hrlspec.run.errors import UserError, main_guard\n{body}\nsys.exit(main_guard(main))"
    command = ["bash", "-c", f'set -o pipefail; "{sys.executable}" -c "$1" {pipe}', "bash", script]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False)


def test_in_a_process_of_its_own() -> None:
    ended = run_script("def main(): raise UserError('bad')")
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", "error: bad\n")


def test_a_reader_that_leaves_early_is_no_error() -> None:
    ended = run_script("def main():\n    for i in range(100000): print(i)", "| head -n 1")
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "0\n", "")
