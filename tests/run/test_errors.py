"""The exit status and the one line of every way a command line can end."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hrlspec.checkpoint import CheckpointMissingError
from hrlspec.run.errors import Interrupted, UserError, main_guard
from hrlspec.run.signals import SIGNALS

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
        (OSError(28, "No space left on device"), 1, "error: No space left on device\n"),
        (PermissionError(13, "Permission denied", "there"), 1, "error: there: Permission denied\n"),
        (Interrupted("checkpoint of step 5 written"), 130, "interrupted: checkpoint of step 5 written\n"),
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


@pytest.mark.parametrize("error", [ZeroDivisionError(), FileNotFoundError(2, "No such file"), SystemExit(2)])
def test_bugs_and_exits_pass_through(error: BaseException) -> None:
    with pytest.raises(type(error)):
        main_guard(raising(error))


@pytest.mark.parametrize("number", SIGNALS)
def test_handlers_come_back(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    assert main_guard(lambda: None) == 0
    assert signal.getsignal(number) is before


def run_script(body: str, pipe: str = "") -> subprocess.CompletedProcess[str]:
    imports = "import os, signal, sys, time\nfrom hrlspec.run.errors import UserError, main_guard"
    script = f"{imports}\n{body}\nsys.exit(main_guard(main))"
    command = ["bash", "-c", f'set -o pipefail; "{sys.executable}" -c "$1" {pipe}', "bash", script]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60, check=False)


def test_in_a_process_of_its_own() -> None:
    ended = run_script("def main(): raise UserError('bad')")
    assert (ended.returncode, ended.stdout, ended.stderr) == (2, "", "error: bad\n")


def test_a_signal_ends_it_at_once() -> None:
    """Also where KeyboardInterrupt would be swallowed, and before anything slow is imported."""
    body = """
class Deaf:
    def __del__(self): os.kill(os.getpid(), signal.SIGINT)
def main():
    assert "jax" not in sys.modules
    Deaf()
    time.sleep(100)
"""
    ended = run_script(body)
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "interrupted\n")


def test_a_reader_that_leaves_early_is_no_error() -> None:
    ended = run_script("def main():\n    for i in range(100000): print(i)", "| head -n 1")
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "0\n", "")


WORK = """
def main():
    for i in range(3):
        print('shown' * 4000)
        print('shown' * 4000, file=sys.stderr, flush=True)
    open(sys.argv[1], 'w').write('saved')
sys.argv[1:] = [r'FILE']
"""


@pytest.mark.parametrize(
    ("pipe", "status", "line"),
    [
        ("2>&1 | head -c 5 > /dev/null", 0, ""),
        (">&- 2>&-", 0, ""),
        ("2> /dev/full > /dev/null", 0, ""),
        ("> /dev/full 2> /dev/null", 1, ""),
        ("> /dev/full 2> >(tail -n 1 >&2)", 1, "error: cannot write to standard output: No space left on device\n"),
    ],
)
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="nothing to write to")
def test_what_cannot_be_shown_does_not_stop_what_saves(pipe: str, status: int, line: str, tmp_path: Path) -> None:
    file = tmp_path / "work"
    ended = run_script(WORK.replace("FILE", str(file)), pipe)
    assert (ended.returncode, ended.stderr) == (status, line)
    assert file.read_text() == "saved"


def test_a_file_does_not_take_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """What a library's C code writes to standard error would end in it."""
    file = tmp_path / "work"
    ended = run_script(f"def main():\n    with open(r'{file}', 'w'): os.write(2, b'noise')", "2>&-")
    assert ended.returncode == 0
    assert file.read_text() == ""


@pytest.mark.parametrize("encoding", ["ascii", pytest.param("cp1252", marks=pytest.mark.slow), "utf-8"])
def test_every_text_can_be_shown(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", encoding)
    body = r"""
def main():
    print('\u03bb \udcff \u2500')
    raise UserError('\u03bb')
"""
    ended = run_script(body)
    assert ended.returncode == 2
    if encoding == "utf-8":
        assert (ended.stdout, ended.stderr) == ("\u03bb \\udcff \u2500\n", "error: \u03bb\n")
    else:
        assert (ended.stdout, ended.stderr) == ("\\u03bb \\udcff \\u2500\n", "error: \\u03bb\n")
