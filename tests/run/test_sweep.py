"""``hrlspec sweep``: what is made, resumed and left alone, what is refused, and what comes of it."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from hrlspec.evaluation.stats import mean_interval
from hrlspec.run import engines, extras
from hrlspec.run.commands import sweep
from hrlspec.run.errors import Interrupted, main_guard
from hrlspec.run.places import Place
from hrlspec.run.planned import PlannedRun
from tests.run.made import make_run

GRID = ["--grid", "config.discount=0.9,0.95"]
SHARED = ["--total-steps", "1000", "--config.num-steps", "8"]  # one iteration of 1,024 steps, as `make_run` has it


class Fake:
    """An engine that makes runs at once, in this process.

    Args:
        fails: names of runs that fail.
        stops: after so many runs somebody asks to stop.
    """

    def __init__(self, *fails: str) -> None:
        self.fails = fails
        self.begun: list[tuple[str, bool]] = []
        self._ended: list[tuple[PlannedRun, str | None]] = []

    def __enter__(self) -> Fake:
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def submit(self, run: PlannedRun) -> None:
        self.begun.append((run.name, "--resume" in run.arguments))
        if run.name in self.fails:
            run.folder.parent.mkdir(parents=True, exist_ok=True)
            run.log.write_text("reading\nerror: no luck\n\n")
            self._ended.append((run, "status 1"))
            return
        if not run.folder.exists():
            make_run(run.folder, *run.flags, success=(0.5,), final=success_of(run.name))
        self._ended.append((run, None))

    def ended(self) -> Sequence[tuple[PlannedRun, str | None]]:
        done, self._ended = self._ended, []
        return done


def success_of(name: str) -> float:
    """What the agent of a run of that name achieves."""
    return 0.5 + 0.1 * int(name[-1]) + 0.05 * ("0.95" in name)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Fake:
    engine = Fake()
    monkeypatch.setattr(sweep, "engine_of", lambda flags: engine)
    monkeypatch.setattr(engines, "POLL_SECONDS", 0.0)
    return engine


def call(*argv: str) -> int:
    return main_guard(lambda: sweep.main(argv))


def test_every_combination_is_made_and_nothing_twice(
    fake: Fake, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "s")]
    cell = tmp_path / "s" / "discount=0.9"
    made = make_run(cell / "seed0", *SHARED, "--config.discount", "0.9", success=(0.5,), final=0.5)
    make_run(cell / "seed1", *SHARED, "--config.discount", "0.9", "--seed", "1")
    kept = (made / "config.json").stat().st_mtime_ns
    assert call(*out, *GRID, "--seeds", "0-2", "--max-runs", "1", "--json", "--", *SHARED) == 0
    first = json.loads(capsys.readouterr().out)
    assert [one["seeds"] for one in first["cells"]] == [[0], [0]]
    assert first["cells"][0]["mean"]["success_rate"] == 0.5
    assert first["cells"][0]["mean"]["success_rate_interval"] is None  # one seed has no interval
    (cell / "seed1" / "summary.json").write_text((made / "summary.json").read_text().replace("0.5", "0.6"))
    assert call(*out, *GRID, "--seeds", "0-2", "--", *SHARED) == 0
    # Seed by seed; seed 0 of both was finished. What somebody else has finished meanwhile is left alone.
    assert fake.begun == [
        ("discount=0.95/seed0", False),
        ("discount=0.95/seed1", False),
        ("discount=0.9/seed2", False),
        ("discount=0.95/seed2", False),
    ]
    assert (made / "config.json").stat().st_mtime_ns == kept
    out_, err = capsys.readouterr()
    assert "2 cells, 6 runs, 3 of them missing" in err
    assert "done: discount=0.9/seed2, trained in 1:00" in err
    rows = list(csv.DictReader((tmp_path / "s" / "results.csv").read_text().splitlines()))
    expected = mean_interval([0.55, 0.65, 0.75])
    assert [row["discount"] for row in rows] == ["0.9", "0.95"]
    assert [float(rows[1][f"success_rate{part}"]) for part in ("", "_low", "_high")] == pytest.approx(expected)
    assert rows[1]["spl"] == ""
    written = json.loads((tmp_path / "s" / "results.json").read_text())
    assert written["cells"][1]["settings"] == {"discount": "0.95"}
    assert written["cells"][1]["mean"]["success_rate_interval"] == pytest.approx([*expected[1:]])
    assert "0.650" in out_


def test_what_was_stopped_is_resumed(fake: Fake, tmp_path: Path) -> None:
    make_run(tmp_path / "seed3", *SHARED, "--seed", "3")
    assert call("--out", str(tmp_path), "--seeds", "3,4", "--", *SHARED) == 0
    assert fake.begun == [("seed3", True), ("seed4", False)]


def test_who_fails_is_named_and_the_others_go_on(
    fake: Fake, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fake.fails = ("discount=0.9/seed0",)
    with pytest.raises(SystemExit, match=r"1 run failed, the first is discount=0.9/seed0; the same command") as stop:
        call("--out", str(tmp_path), *GRID, "--seeds", "0-1", "--", *SHARED)
    assert isinstance(stop.value.code, str)  # which is status 1
    log = tmp_path / "discount=0.9" / "seed0.log"
    out, err = capsys.readouterr()
    assert f"failed: discount=0.9/seed0 (status 1): error: no luck; all it said is in {log}\n" in err
    assert len(fake.begun) == 4
    assert "1 of 2" in out


def test_a_dry_run_begins_nothing(fake: Fake, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "s"
    assert call("--out", str(out), *GRID, "--seeds", "0-1", "--max-runs", "3", "--dry-run", "--", *SHARED) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == (
        f"hrlspec run {' '.join(SHARED)} --config.discount 0.95 --seed 0 --out {out / 'discount=0.95' / 'seed0'}"
    )
    assert (len(lines), fake.begun, out.exists()) == (3, [], False)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("--grid config.num_envs=64,-1", "num_envs=-1: --config.num-envs is -1, expected at least 1"),
        ("--grid config.num_env=64", "num_env=64: Unrecognized options: --config.num_env"),
        ("--grid recipe=paper,none", "recipe=none: invalid choice 'none' for argument '--recipe'"),
        ("--grid env=letter,lettr", "env=lettr: unknown environment 'lettr'"),
        ("--grid method.high.max_operator=true --grid method=ours,option", "method=option: "),
        ("--grid devices=3 -- --config.blocks 2", "devices=3: --devices is 3, expected a divisor of 2"),
        ("-- --nonsense", "Unrecognized options: --nonsense"),
        ("--nonsense", "Unrecognized options: --nonsense"),
        ("--seeds x", "--seeds x: expected numbers and ranges"),
        ("--max-runs 0", "--max-runs is 0, expected at least 1"),
        ("--jobs 0", "--jobs is 0, expected at least 1"),
        ("--cores-per-run 2", "--cores-per-run is 2, expected to stand beside --ray"),
        ("--ray local --jobs 2", "--jobs is 2, expected none beside --ray"),
        ("--ray local --gpus-per-run 1.5", "--gpus-per-run is 1.5, expected a part of one, or a whole number"),
        ("-- --from no-such-agent", "no-such-agent"),
    ],
)
def test_refusals(argv: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line, and nothing is written, even where other combinations would do."""
    assert call("--out", str(tmp_path / "s"), *argv.split()) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_folders_are_looked_at_first(fake: Fake, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One holds another run, which the flags would change."""
    make_run(tmp_path / "discount=0.95" / "seed0", *SHARED, "--config.discount", "0.95", "--config.low.clip", "0.3")
    assert call("--out", str(tmp_path), *GRID, "--", *SHARED) == 2
    assert "was begun with config.low.clip = 0.3" in capsys.readouterr().err
    file = tmp_path / "file"
    file.write_text("")
    assert call("--out", str(file), *GRID) == 2
    assert not fake.begun


def test_without_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert call("--out", str(tmp_path / "s"), "--ray", "local") == 2
    assert capsys.readouterr().err == 'error: --ray needs the extra "ray": pip install "hrlspec[ray]"\n'
    with pytest.raises(extras.UserError):
        extras.check_ray()
    assert not list(tmp_path.iterdir())


STUB = """
import os, pathlib, signal, sys, time
folder, others = pathlib.Path(sys.argv[1]), int(sys.argv[2])
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
signal.alarm(120)
folder.mkdir(parents=True, exist_ok=True)
begun = folder / "begun"
if begun.exists():
    sys.exit(0)
begun.touch()
if folder.name == "seed1":
    while len(list(folder.parent.glob("*/begun"))) < others:
        time.sleep(0.01)
    os.kill(os.getppid(), signal.SIGINT)
signal.sigwait([signal.SIGTERM])
(folder / "saved").touch()
sys.exit(130)
"""
"""A run that waits to be asked to stop, and has Ctrl-C pressed once all have begun; the second time it ends."""


def test_ctrl_c_stops_in_order_and_the_same_runs_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [PlannedRun(f"seed{seed}", (), tmp_path / f"seed{seed}", 100) for seed in range(3)]

    def start(run: PlannedRun, place: Place) -> subprocess.Popen[bytes]:
        return place.start([sys.executable, "-c", STUB, str(run.folder), "2"], start_new_session=True)

    monkeypatch.setattr(engines, "start_run", start)
    monkeypatch.setattr(engines, "POLL_SECONDS", 0.05)
    console: Any = sweep.PlainConsole(stderr=True)
    with pytest.raises(Interrupted, match="by SIGINT; the runs are saved in their folders, the same command goes on"):
        engines.carry_out(runs, engines.LocalEngine(2), console)
    assert [(run.folder / "saved").exists() for run in runs] == [True, True, False]
    (runs[2].folder).mkdir()
    (runs[2].folder / "begun").touch()
    finished: list[str] = []
    assert engines.carry_out(runs, engines.LocalEngine(2), console, lambda run: finished.append(run.name)) == []
    assert sorted(finished) == ["seed0", "seed1", "seed2"]
