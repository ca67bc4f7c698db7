"""``hrlspec compare``: what is told of several runs is what they recorded, and of settings only what differs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from hrlspec.evaluation.stats import mean_interval
from hrlspec.run import curves
from hrlspec.run.commands import compare
from hrlspec.run.errors import main_guard
from hrlspec.run.listing import look_at
from tests.run.made import make_run


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seeds, the first twice, and one run with another setting that is not finished."""
    place = tmp_path_factory.mktemp("place")
    for seed, final in enumerate((0.7, 0.8, 0.9)):
        make_run(place / f"a{seed}", "--seed", str(seed), success=(0.1, 0.2 + 0.1 * seed), final=final)
    make_run(place / "again", "--seed", "0", success=(0.1, 0.2), final=0.7)
    make_run(place / "b", "--config.low.clip", "0.3", success=(0.4,))
    (place / "broken").mkdir()
    (place / "broken" / "config.json").write_text("{")
    (place / "empty").mkdir()
    return place


def compared(capsys: pytest.CaptureFixture[str], *argv: str) -> dict[str, Any]:
    assert main_guard(lambda: compare.main([*argv, "--json"])) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_runs_that_differ_in_their_seed_alone_are_a_group(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    found = compared(capsys, "a0", "b", "a2", "a1", "a0")
    together, other = found["groups"]
    assert (together["label"], other["label"]) == ("a{0,2,1}", "b")
    assert [(run["run"], run["seed"]) for run in together["runs"]] == [("a0", 0), ("a2", 2), ("a1", 1)]
    known = ("success_rate", "return_mean", "steps_mean")
    assert together["runs"][0]["final"] == {
        **dict.fromkeys(known, 0.7),
        **{f"{name}_interval": [0.7 - 0.05, 0.7 + 0.05] for name in known},
        "spl": None,
        "spl_interval": None,
        "contested_choice": None,
        "contested_choice_interval": None,
        "first_choice": 0.75,
        "first_choice_interval": None,
    }
    mean, low, high = mean_interval([0.7, 0.9, 0.8])
    assert together["mean"]["success_rate"] == pytest.approx(mean)
    assert together["mean"]["success_rate_interval"] == pytest.approx([low, high])
    assert together["mean"]["spl"] is None
    assert (other["mean"], other["runs"][0]["final"], other["runs"][0]["state"]) == (None, None, "stopped")
    assert found["differences"] == {"config.low.clip": [0.2, 0.3], "seed": [[0, 1, 2], [0]]}


def test_a_run_made_again_is_no_further_seed(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [look_at(place / name) for name in ("a0", "again", "a1")]
    assert [[run.path.name for run in group] for group in compare.groups_of(runs)] == [["a0", "a1"], ["again"]]


def test_other_code_is_another_group(place: Path, tmp_path: Path) -> None:
    runs = [look_at(place / name) for name in ("a0", "a1")]
    older = look_at(place / "a1")
    older = type(older)(**{**vars(older), "record": {**older.record, "commit": "0123abc"}})
    groups = compare.groups_of([runs[0], older])
    assert len(compare.groups_of(runs)) == 1
    assert compare.differences(groups) == {"commit": [runs[0].record["commit"], "0123abc"], "seed": [[0], [1]]}


def test_labels_are_what_a_shell_would_write(place: Path, tmp_path: Path) -> None:
    def label(*names: str) -> str:
        run = look_at(place / "a0")
        return compare.label_of([type(run)(**{**vars(run), "path": Path(name)}) for name in names])

    assert label("runs/x") == "runs/x"
    assert label("runs/seed1", "runs/seed10") == "runs/seed{1,10}"
    assert label("x/seed0", "y/seed0") == "{x/seed0,y/seed0}"


def test_what_is_printed(place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(place)
    assert main_guard(lambda: compare.main(["a0", "a1", "b"])) == 0
    out = capsys.readouterr().out
    lines = [line.split() for line in out.splitlines()]
    assert ["a0", "200", "0.700", "0.700", "0.700", "-", "-", "0.750"] in lines
    assert ["[.65,.75]"] * 3 in lines
    assert ["b", "100", *"------"] in lines
    assert ["mean", "of", "2", "seeds", "0.750", "0.750", "0.750", "-", "-", "0.750"] in lines
    assert ["config.low.clip", "0.2", "a{0,1}"] in lines
    assert ["0.3", "b"] in lines
    assert main_guard(lambda: compare.main(["a0", "a1"])) == 0
    assert "differ" not in capsys.readouterr().out  # in nothing but the seed


def test_the_picture(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[dict[str, Any]] = []
    draw = curves.learning_curves

    def spy(some: Any, file: Path) -> Path:
        shown.append(some)
        return draw(some, file)

    monkeypatch.chdir(place)
    monkeypatch.setattr(curves, "learning_curves", spy)
    file = tmp_path / "new" / "x.png"
    compared(capsys, "a0", "a1", "b", "--out", str(file))
    assert {label: [len(rows) for rows in runs] for label, runs in shown[0].items()} == {"a{0,1}": [2, 2], "b": [1]}
    with Image.open(file) as image:
        assert min(image.size) > 400


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ((), "run folders, found none"),
        (("a0", "nowhere"), "there is no folder nowhere"),
        (("a0", "a0/config.json"), "there is no folder a0/config.json"),
        (("a0", "empty"), "empty is not a run folder"),
        (("a0", "broken"), "cannot read broken/config.json"),
        (("a0", "--out", "x.pdf"), "--out x.pdf: expected a file that ends in .png or .svg"),
        (("a0", "--out", "empty.png/x.png"), "cannot write to empty.png"),
    ],
)
def test_bad_input(
    flags: Sequence[str],
    message: str,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (place / "empty.png").write_text("")
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    assert main_guard(lambda: compare.main(flags)) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert message in err
    assert sorted(place.rglob("*")) == before
