"""Whatever is wrong with the input of ``hrlspec.run.commands.evaluate``: one clear line, status 2, nothing written."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import pytest

from hrlspec import checkpoint
from hrlspec.run.commands import evaluate
from hrlspec.run.errors import main_guard
from hrlspec.run.folder import open_run
from hrlspec.run.run_flags import experiments_of, parse_run

ROOT = Path(__file__).parents[2]

BAD_FLAGS: list[tuple[Sequence[str], str]] = [
    ((), "--run"),
    (("--run", "run"), "expected exactly one of --spec, --spec-file, --ltl, --ltl-file, --hoa and --suite, found none"),
    (("--run", "run", "--spec", "achieve a", "--suite", "dag"), "found --spec and --suite"),
    (("--run", "nowhere", "--suite", "dag"), "nowhere is not a run folder"),
    (("--run", "file", "--suite", "dag"), "file"),
    (("--run", "damaged", "--suite", "dag"), "cannot read damaged"),
    (("--run", "run", "--suite", "dag"), "no checkpoint in run"),
    (("--run", "foreign", "--suite", "dag"), "holds another state"),
    (("--run", "foreign", "--suite", "dag", "--step", "5"), "no checkpoint of step 5"),
    (("--run", "run", "--suite", "cats"), "unknown suite 'cats' of 'letter'"),
    (("--run", "run", "--suite", "dag", "--draw", "way.gif"), "--draw way.gif: expected a file that ends in .png"),
    (("--run", "run", "--suite", "dag", "--draw", "folder.png"), "--draw folder.png: expected a file, found a folder"),
    (("--run", "run", "--suite", "dag", "--draw", "file/x.png"), "cannot write to file: "),
    (("--run", "run", "--spec", ""), "found no formula"),
    (("--run", "run", "--spec", "achieve"), "line 1, column 8"),
    (("--run", "run", "--spec", "achieve a ;; b"), "column 12"),
    (("--run", "run", "--spec", "achieve z"), "z"),
    (("--run", "run", "--spec", "achieve a ensuring not a"), "a"),
    (("--run", "run", "--spec", "(" * 5000 + "achieve a"), "line 1"),
    (("--run", "run", "--spec", "achieve a; " * 5000 + "achieve b"), "line 1"),
    (("--run", "run", "--spec", "achieve a; achieve b", "--max-nodes", "2"), "2"),
    (("--run", "run", "--spec", "\x00"), "line 1"),
    (("--run", "run", "--ltl", "F a", "--spec", "achieve a"), "found --spec and --ltl"),
    (("--run", "run", "--ltl", "F a", "--draw", "way.png"), "--draw takes tasks in SPECTRL"),
    (("--run", "run", "--suite", "genz/letter_finite", "--draw", "way.png"), "no proposition"),
    (("--run", "run", "--ltl", ""), "found no formula"),
    (("--run", "run", "--ltl", "F (a"), "--ltl, line 1, column 5"),
    (("--run", "run", "--ltl", "F a b"), "--ltl, line 1, column 5: found 'b'"),
    (("--run", "run", "--ltl", "F z"), "'z' is no proposition, expected some of a, b, c, d, e"),
    (("--run", "run", "--ltl", "a => b & c"), "line 1"),
    (("--run", "run", "--ltl", "F a"), "no checkpoint in run"),
    (("--run", "run", "--ltl", "FG a", "--forever"), "F G a asks to stay for ever"),
    (("--run", "run", "--suite", "dag", "--forever"), "--forever goes with --ltl, --ltl-file or --hoa"),
    (("--run", "run", "--ltl-file", "nothing.txt"), "cannot read nothing.txt: No such file"),
    (("--run", "run", "--ltl-file", "binary"), "binary: not UTF-8"),
    (("--run", "run", "--hoa", "nothing.hoa"), "cannot read nothing.hoa: No such file"),
    (("--run", "run", "--hoa", "wrong"), "wrong, line 1, column 1: found '#'"),
    (("--run", "run", "--hoa", "empty"), "empty, line 1, column 1: found '#'"),
    (("--run", "run", "--ltl-file", "empty"), "found no formula"),
    (("--run", "run", "--ltl-file", "wrong"), "wrong, line 2, column 9: "),
    (("--run", "run", "--suite", "jaxolotl/cats"), "unknown suite 'jaxolotl/cats'; published ones are: "),
    (("--run", "run", "--suite", "deepltl/flatworld_finite"), "is no proposition"),
    (("--run", "run", "--spec-file", "nothing.txt"), "cannot read nothing.txt: No such file"),
    (("--run", "run", "--spec-file", "."), "cannot read .: Is a directory"),
    (("--run", "run", "--spec-file", "binary"), "binary: not UTF-8"),
    (("--run", "run", "--spec-file", "empty"), "found no formula"),
    (("--run", "run", "--spec-file", "wrong"), "wrong, line 3, column 9: "),
    (("--run", "run", "--suite", "dag", "--episodes", "0"), "--episodes is 0"),
    (("--run", "run", "--suite", "dag", "--episodes", "many"), "--episodes"),
    (("--run", "run", "--suite", "dag", "--seed", "-3"), "--seed is -3"),
    (("--run", "run", "--suite", "dag", "--max-nodes", "1"), "--max-nodes is 1"),
    (("--run", "run", "--suite", "dag", "--step", "x"), "--step"),
    (("--run", "run", "--suite", "dag", "--verbose"), "Unrecognized options: --verbose"),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with run folders of several kinds of brokenness."""
    folder = tmp_path_factory.mktemp("place")
    for name in ("run", "foreign"):
        ((experiment, path),) = experiments_of(parse_run(["--out", str(folder / name)]))
        with open_run(path, experiment, tensorboard=False):
            pass
    checkpoint.save(folder / "foreign" / "checkpoints", 3, {"params": {"planner": jnp.zeros(2)}})
    (folder / "damaged").mkdir()
    (folder / "folder.png").mkdir()
    (folder / "damaged" / "config.json").write_text("{")
    (folder / "file").write_text("x")
    (folder / "binary").write_bytes(b"\xff\xfe\x00")
    (folder / "empty").write_text("# nothing\n\n")
    (folder / "wrong").write_text("# tasks\nachieve a\nachieve )\n")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.mark.parametrize(("flags", "message"), BAD_FLAGS, ids=[" ".join(flags)[:60] for flags, _ in BAD_FLAGS])
def test_bad_input(
    flags: Sequence[str],
    message: str,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(place)
    before = contents(place)
    assert main_guard(lambda: evaluate.main(flags)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert len(err) < 1000
    assert contents(place) == before


def test_bad_input_in_a_process_of_its_own(place: Path) -> None:
    command = [sys.executable, "-m", "experiments.evaluate", "--run", str(place / "run"), "--spec", "achieve a or"]
    ended = subprocess.run([*command, "--json"], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("error: --spec, line 1, column ")
    assert ended.stderr.count("\n") == 1
