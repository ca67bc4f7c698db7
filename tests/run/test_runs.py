"""``hrlspec runs``: every run folder is a row, whatever state it is in, and looking changes nothing."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from hrlspec import checkpoint
from hrlspec.run import folder as folders
from hrlspec.run.commands import runs
from hrlspec.run.errors import main_guard
from hrlspec.run.folder import is_being_written, open_run, read_record
from hrlspec.run.listing import look_at, runs_below
from tests.run.made import make_run


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of all states but running."""
    place = tmp_path_factory.mktemp("place")
    make_run(place / "done2", "--seed", "2", success=(0.5, 0.75), final=0.9)
    make_run(place / "deeper" / "done10", "--seed", "10", "--env", "walk", success=(0.5, 0.25), final=0.8)
    make_run(place / "begun", "--method", "option")
    checkpoint.save(make_run(place / "stopped", success=(0.125,)) / "checkpoints", 160, {"x": 0})
    damaged = make_run(place / "damaged", success=(0.5, 0.5))
    (damaged / "metrics.jsonl").write_text('{"env_steps": 100}\nnonsense\n{"env_steps": 300}\n')
    (place / "no-record").mkdir()
    (place / "no-record" / "metrics.jsonl").write_text("")
    (place / ".hidden").symlink_to(place / "done2")
    (place / "deeper" / "round").symlink_to(place)
    return place


def listed(capsys: pytest.CaptureFixture[str], *argv: str) -> list[dict[str, Any]]:
    assert main_guard(lambda: runs.main([*argv, "--json"])) == 0
    found: list[dict[str, Any]] = json.loads(capsys.readouterr().out)["runs"]
    return found


def states(place: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.lstat().st_mtime_ns, path.lstat().st_size) for path in place.rglob("*")}


def test_each_run_is_a_row(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = states(place)
    found = {Path(row["run"]).name: row for row in listed(capsys, str(place))}
    assert states(place) == before
    commit = read_record(place / "done2")["commit"]
    assert found["done2"] == {
        "run": str(place / "done2"),
        "env": "letter",
        "method": "ours",
        "recipe": "hrlspec",
        "reward_set": 1,
        "seed": 2,
        "state": "finished",
        "env_steps": 200,
        "total_steps": 1000,
        "success_rate": 0.75,
        "wall_s": 120.0,
        "commit": commit,
        "damage": None,
    }
    assert {name: (row["state"], row["env_steps"], row["success_rate"]) for name, row in found.items()} == {
        "done2": ("finished", 200, 0.75),
        "done10": ("finished", 200, 0.25),
        "begun": ("stopped", 0, None),
        "stopped": ("stopped", 160, 0.125),  # its checkpoint is newer than its row
        "damaged": ("damaged", 0, None),
        "no-record": ("damaged", 0, None),
    }
    assert "line 2: not a row" in found["damaged"]["damage"]
    assert found["damaged"]["env"] == "letter"  # what can be read is told
    assert "there is no config.json" in found["no-record"]["damage"]


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ((), "begun damaged done10 done2 no-record stopped"),
        (("--sort", "success_rate"), "stopped done10 done2 begun damaged no-record"),
        (("--sort", "success_rate", "--descending"), "done2 done10 stopped begun damaged no-record"),
        (("--sort", "seed", "--descending"), "done10 done2 begun damaged stopped no-record"),
        (("--sort", "state"), "damaged no-record done10 done2 begun stopped"),
    ],
)
def test_rows_are_sorted(flags: Sequence[str], expected: str, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [Path(row["run"]).name for row in listed(capsys, str(place), *flags)] == expected.split()


def test_seed_10_comes_after_seed_9(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed in (10, 9):
        (tmp_path / f"seed{seed}").mkdir()
        (tmp_path / f"seed{seed}" / "config.json").write_text("{")
    assert [Path(row["run"]).name for row in listed(capsys, str(tmp_path))] == ["seed9", "seed10"]


def test_the_table_says_what_is_damaged(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main_guard(lambda: runs.main([str(place), str(place / "done2")])) == 0
    out = capsys.readouterr().out
    assert out.count("done2") == 1
    for text in ("0.750", "2:00", "1,000", "line 2: not a row", str(read_record(place / "done2")["commit"])[:4]):
        assert text in out, text


def test_without_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert main_guard(lambda: runs.main([])) == 2
    assert capsys.readouterr().err == "error: there is no folder runs: say where the runs are, hrlspec runs FOLDER\n"
    (tmp_path / "runs").mkdir()
    assert main_guard(lambda: runs.main([])) == 0
    assert capsys.readouterr().out == "no runs in runs\n"
    assert listed(capsys) == []


def test_a_run_in_progress(tmp_path: Path) -> None:
    path = make_run(tmp_path / "run", success=(0.5,), final=0.5)
    record = read_record(path)["config"]
    assert look_at(path).state == "finished"
    with open_run(path, record, resume=True, tensorboard=False) as run:
        run.rewind(100)
        for step in (200, 300):
            assert look_at(path).state == "running"
            run.append({"env_steps": step})
        with (path / "metrics.jsonl").open("a") as file:
            file.write('{"env_steps": 400, "ev')  # half a row
        assert look_at(path).env_steps == 300
    assert look_at(path).state == "finished"
    assert list(runs_below(path)) == [path]


@pytest.mark.skipif(os.name == "nt", reason="there are no such locks")
def test_who_looks_keeps_nobody_from_beginning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither for the instant that looking takes, nor when many look at a time."""
    import fcntl

    path = make_run(tmp_path / "run")
    monkeypatch.setattr(folders, "_LOCK_TRIES", 1000)
    with (path / ".lock").open() as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        assert not is_being_written(path)  # others who look are no writers
        timer = threading.Timer(0.1, looking.close)
        timer.start()
        with open_run(path, read_record(path)["config"], resume=True, tensorboard=False):
            assert is_being_written(path)
        timer.join()
    stop = threading.Event()

    def look() -> None:
        while not stop.is_set():
            is_being_written(path)
            time.sleep(0.001)

    looking_on = threading.Thread(target=look)
    looking_on.start()
    try:
        for _ in range(5):
            with open_run(path, read_record(path)["config"], resume=True, tensorboard=False):
                pass
    finally:
        stop.set()
        looking_on.join()
