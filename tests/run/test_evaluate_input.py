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
from tests.run.made import contents

ROOT = Path(__file__).parents[2]

# Of each of four propositions none, one, or both are seen.
MANY = " & ".join(f"F ({name} & X F {name})" for name in "abcd")
BAD_FLAGS: list[tuple[Sequence[str], str]] = [
    ((), "--run"),
    (
        ("--run", "run"),
        "expected exactly one of --spec, --spec-file, --ltl, --ltl-file, --hoa, --dfa and --suite, found ",
    ),
    (("--run", "run", "--spec", "achieve a", "--suite", "dag"), "found --spec and --suite"),
    (("--run", "nowhere", "--suite", "dag"), "nowhere is not a run folder"),
    (("--run", "file", "--suite", "dag"), "file"),
    (("--run", "damaged", "--suite", "dag"), "cannot read damaged"),
    (("--run", "run", "--suite", "dag"), "no checkpoint in run"),
    (("--run", "foreign", "--suite", "dag"), "holds another state"),
    (("--run", "foreign", "--suite", "dag", "--step", "5"), "no checkpoint of step 5"),
    (("--run", "run", "--suite", "cats"), "unknown suite 'cats' of 'letter'"),
    (
        ("--run", "run", "--suite", "dag", "--draw", "way.pdf"),
        "--draw way.pdf: expected a file that ends in .png, .svg, .gif or .mp4",
    ),
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
    (("--run", "run", "--ltl", "GF (a & G b)", "--forever"), "G F (a & G b) is none of what is read for ever"),
    (("--run", "run", "--suite", "dag", "--forever"), "--forever goes with --ltl, --ltl-file or --hoa"),
    (("--run", "run", "--suite", "dag", "--protocol", "jaxolotl"), "--protocol jaxolotl is for formulas"),
    (("--run", "run", "--ltl", "F a", "--protocol", "deepltl", "--greedy"), "--protocol deepltl says how many"),
    (("--run", "run", "--ltl", "F a", "--protocol", "deepltl", "--episodes", "9"), "--protocol deepltl says how many"),
    (("--run", "run", "--ltl-file", "nothing.txt"), "cannot read nothing.txt: No such file"),
    (("--run", "run", "--ltl-file", "binary"), "binary: not UTF-8"),
    (("--run", "run", "--hoa", "nothing.hoa"), "cannot read nothing.hoa: No such file"),
    (("--run", "run", "--hoa", "wrong"), "wrong, line 1, column 1: found '#'"),
    (("--run", "run", "--hoa", "empty"), "empty, line 1, column 1: found '#'"),
    (("--run", "run", "--dfa", "nothing.json"), "cannot read nothing.json: No such file"),
    (("--run", "run", "--dfa", "wrong"), "wrong, line 1, column 1: no JSON"),
    (("--run", "run", "--dfa", "binary"), "binary: not UTF-8"),
    (("--run", "run", "--dfa", "wrong", "--forever"), "--forever goes with --ltl, --ltl-file or --hoa"),
    (("--run", "run", "--dfa", "wrong", "--hoa", "wrong"), "found --hoa and --dfa"),
    (("--run", "run", "--suite", "dag", "--semantics", "exact"), "--semantics exact goes with --spec or --spec-file"),
    (("--run", "run", "--ltl", "F a", "--semantics", "exact"), "--semantics exact goes with --spec or --spec-file"),
    (("--run", "run", "--spec", "achieve a", "--semantics", "loose"), "--semantics"),
    (
        ("--run", "run", "--spec", "achieve a", "--semantics", "exact", "--draw", "w.png"),
        "--automaton draws one of these",
    ),
    (("--run", "run", "--spec-file", "wrong", "--semantics", "exact"), "wrong, line 3, column 9: "),
    (("--run", "run", "--spec-file", "empty", "--semantics", "exact"), "found no formula"),
    (("--run", "run", "--spec", "achieve a", "--semantics", "exact"), "no checkpoint in run"),
    (("--run", "run", "--ltl", "F a", "--automaton", "task.txt"), "ends in .dot, .hoa, .json, .png or .svg"),
    (("--run", "run", "--ltl", "F a", "--automaton", "folder.png"), "--automaton folder.png: expected a file, found a"),
    (("--run", "run", "--ltl", "F a", "--automaton", "file/x.dot"), "cannot write to file: "),
    (("--run", "run", "--ltl", "F a", "--automaton", "x.dot"), "no checkpoint in run"),
    (("--run", "run", "--spec", "achieve a", "--automaton", "x.dot"), "no checkpoint in run"),
    (("--run", "run", "--suite", "dag", "--automaton", "x.dot"), "--automaton takes one task, found 200"),
    (
        ("--run", "run", "--ltl", "GF a", "--forever", "--automaton", "x.json"),
        "a dictionary holds no task that goes on",
    ),
    (
        ("--run", "run", "--ltl", MANY, "--automaton", "x.png"),
        "the automaton has 81 states, a picture shows 40",
    ),
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


def test_videos_need_their_library(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # as if it was not installed
    monkeypatch.chdir(place)
    assert main_guard(lambda: evaluate.main(["--run", "run", "--suite", "dag", "--draw", "way.mp4"])) == 2
    expected = 'error: videos (.mp4) need the extra "video": pip install "hrlspec[video]"\n'
    assert capsys.readouterr().err == expected


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


HOA = """HOA: v1 States: 2 Start: 0 AP: 2 "a" "b" Acceptance: 1 Inf(0) --BODY--
State: 0 [!0] 0 [0] 1
State: 1 [t] 1 {0} --END--"""
DFA = """[{"0": [false, {"a": 1, "b": 0, "c": 0, "d": 0, "e": 0}],
"1": [true, {"a": 1, "b": 1, "c": 1, "d": 1, "e": 1}]}, 0]"""
WRONG_TASKS = [
    # Formulas: what is not one, what is read in two ways, what is too large.
    ("--ltl", "a &", "line 1, column 4: found the end of the text"),
    ("--ltl", "F (a", "line 1, column 5: found the end of the text"),
    ("--ltl", "a)", "line 1, column 2: found ')'"),
    ("--ltl", "a U b U c", "column 7: 'U' beside 'U' is read in two ways; use parentheses"),
    ("--ltl", "a -> b -> c", "use parentheses"),
    ("--ltl", "a U", "found the end of the text"),
    ("--ltl", "F a; F b", "column 4: found ';'"),
    ("--ltl", "achieve a", "column 9: found 'a'"),
    ("--ltl", "F 3", "found '3'"),
    ("--ltl", "!" * 300 + "a", "nested more than 200 deep"),
    ("--ltl", "F a" + " " * 20_000, "at most 20,000 are read"),
    ("--ltl", "F A", "'A' is no proposition"),
    ("--spec", "achieve a ensuring", "line 1, column 19: found the end of the text"),
    ("--spec", "F a", "line 1, column 1: found 'F'"),
    # Automata in HOA: text, states, acceptance, and labels beside those of the world.
    ("--hoa", HOA.replace("v1", "v3"), "line 1, column 6: found 'v3'"),
    ("--hoa", HOA.replace("Start: 0", "Start: 9"), "found no state 9"),
    ("--hoa", HOA.replace("[0] 1", "[0] 5"), "found no state 5"),
    ("--hoa", HOA.replace("[0] 1", "[t] 1"), "the automaton leaves choices, which are for tasks that go on for ever"),
    ("--hoa", HOA.replace('"b"', '"bee"'), "'bee' is no proposition, expected some of a, b, c, d, e"),
    ("--hoa", HOA.replace("AP: 2", "AP: 3"), "expected the name of a proposition"),
    ("--hoa", HOA.replace("[0]", "[2]"), "line 2, column 18: found '2', expected a label"),
    ("--hoa", HOA.replace("1 Inf(0)", "1 Fin(0)"), "found the acceptance 1 Fin ( 0 ), expected Büchi"),
    ("--hoa", HOA.replace("--END--", ""), "expected '--END--'"),
    ("--hoa", HOA + HOA, "expected the end of the text: one automaton"),
    ("--hoa", DFA, "line 1, column 6: found ':', expected a word of the HOA format"),
    # Dictionaries: JSON, states, whether they accept, letters.
    ("--dfa", HOA, "line 1, column 1: no JSON"),
    ("--dfa", DFA[:-1], "no JSON"),
    ("--dfa", "[" * 50_000, "nested too deep"),
    ("--dfa", "{}", "expected a list of two"),
    ("--dfa", "[{}, 0]", "found no state '0', with which it starts"),
    ("--dfa", DFA.replace("}, 0]", "}, 7]"), "found no state '7', with which it starts"),
    ("--dfa", DFA.replace('"1":', '"0":'), "'0' is there twice"),
    ("--dfa", DFA.replace('"a": 1, "b": 0', '"a": 4, "b": 0'), "found no state '4', to which 'a' leads from state '0'"),
    ("--dfa", DFA.replace("true", '"yes"'), "state '1' has the label 'yes', expected true or false"),
    ("--dfa", DFA.replace("[true, ", "["), "state '1': expected a list of two"),
    ("--dfa", DFA.replace("}, 0]", "}, null]"), "a state is a whole number or a text, found None"),
    # Sets of propositions.
    ("--dfa", DFA.replace('"e": 0', '"z": 0'), "letter 'z': 'z' is no proposition, expected some of a, b, c, d, e"),
    ("--dfa", DFA.replace('"e": 0', '"5": 0'), "letter '5': 5 is no proposition"),
    ("--dfa", DFA.replace('"e": 0', '"a&&b": 0'), "letter 'a&&b': '' is no proposition"),
    ("--dfa", DFA.replace('"e": 0', '"a|b": 0'), "letter 'a|b': 'a|b' is no proposition"),
    ("--dfa", DFA.replace(', "e": 0', ""), "state '0' has no letter for {e}, which can hold"),
    ("--dfa", DFA.replace('"e": 0', '"e": 0, "4": 0'), "state '0' has two letters for what '4' says"),
]


@pytest.mark.parametrize(("flag", "task", "message"), WRONG_TASKS, ids=range(len(WRONG_TASKS)))
def test_tasks_that_are_refused(
    flag: str, task: str, message: str, place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a file the message names it."""
    file = tmp_path / "task"
    before = contents(place)
    if flag in ("--hoa", "--dfa"):
        file.write_text(task, encoding="utf-8")
    flags = ["--run", str(place / "run"), flag, str(file) if file.exists() else task]
    flags += ["--automaton", str(tmp_path / "written.dot")]
    assert main_guard(lambda: evaluate.main(flags)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: task" if file.exists() else f"error: {flag}, ")
    assert err.count("\n") == 1
    assert message in err
    assert len(err) < 300
    assert contents(place) == before
    assert not (tmp_path / "written.dot").exists()


def test_bad_input_in_a_process_of_its_own(place: Path) -> None:
    command = [sys.executable, "-m", "experiments.evaluate", "--run", str(place / "run"), "--spec", "achieve a or"]
    ended = subprocess.run([*command, "--json"], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("error: --spec, line 1, column ")
    assert ended.stderr.count("\n") == 1
