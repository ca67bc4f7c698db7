"""What is kept of runs, and how it is read again."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from experiments.paper.panels import NUM_SEEDS, PANELS, TUNING, Curve, Run
from experiments.paper.records import CURVE, add_record, read_records, record_file, record_of
from hrlspec.run.errors import UserError
from hrlspec.run.folder import open_run
from tests.experiments.made import record

RESULTS = Path(__file__).parents[2] / "results"
OURS = Curve("ours", "paper")
FIRST, SECOND = (Run("walk", 1, OURS, seed, 100) for seed in (0, 1))


def test_a_record_comes_back_as_it_was(tmp_path: Path) -> None:
    made = record([0.1, 1 / 3, 2e-17, 123456789.125], 0.1 + 0.2)
    assert read_records([FIRST], tmp_path / "new") == {}
    file = add_record(FIRST, made, tmp_path / "new")
    assert file == record_file(FIRST, tmp_path / "new") == tmp_path / "new" / "walk-paper.jsonl"
    assert read_records([FIRST, SECOND], tmp_path / "new") == {FIRST: made}
    assert "--env walk --method ours --recipe paper --reward-set 1 --seed 0 --total-steps 100" in file.read_text()


def test_a_record_is_of_one_number_of_steps_and_of_one_set_of_switches(tmp_path: Path) -> None:
    runs = [
        FIRST,
        dataclasses.replace(FIRST, total_steps=200),
        dataclasses.replace(FIRST, reward_set=2),
        dataclasses.replace(FIRST, curve=Curve("ours", "paper", ("--no-shield",))),
        dataclasses.replace(FIRST, curve=Curve("option", "paper")),
        dataclasses.replace(FIRST, curve=Curve("ours", "hrlspec")),
        dataclasses.replace(FIRST, env="zone"),
        SECOND,
    ]
    for i, run in enumerate(runs):
        assert list(read_records(runs, tmp_path)) == runs[:i]
        add_record(run, record([float(i)], 0.0), tmp_path)
    found = read_records(runs, tmp_path)
    assert [found[run].curve["eval/return_mean"] for run in runs] == [[float(i)] for i in range(len(runs))]
    assert len(list(tmp_path.iterdir())) == 3


def test_lines_are_added_and_what_is_shared_stands_once(tmp_path: Path) -> None:
    file = add_record(FIRST, record([0.5], 0.5), tmp_path)
    before = file.read_bytes()
    add_record(SECOND, record([0.6], 0.6, seed=1), tmp_path)
    other = dataclasses.replace(record([0.7], 0.7), settings={"env": "walk", "seed": 0, "config": {"discount": 0.8}})
    add_record(dataclasses.replace(FIRST, reward_set=2), other, tmp_path)
    assert file.read_bytes().startswith(before)
    kinds = [next(iter(json.loads(line))) for line in file.read_text().splitlines()]
    assert kinds == ["config", "source", "run", "run", "config", "run"]
    assert read_records([SECOND], tmp_path)[SECOND].settings["seed"] == 1


def test_a_record_is_never_replaced(tmp_path: Path) -> None:
    file = add_record(FIRST, record([0.5], 0.5), tmp_path)
    before = file.read_bytes()
    with pytest.raises(UserError, match="has a record of walk-ours-paper-set1-seed0 with 100 steps; delete its line"):
        add_record(FIRST, record([0.6], 0.6), tmp_path)
    assert file.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text[:-10], "line 3: .*; a run whose line is deleted is made again"),
        (lambda text: text + text.splitlines()[2] + "\n", "line 4: a second record of walk-ours-paper-set1-seed0"),
        (lambda text: text.replace("0.9", "0.8"), "line 1: the settings do not match their hash"),
        (lambda text: text.replace("0123abc", "4567def"), "line 2: the circumstances do not match their hash"),
        (lambda text: text.partition("\n")[2], "line 2: config [0-9a-f]{12} is missing"),
        (lambda text: text.replace('"wall_s"', '"wall"'), "line 3: wall_s is missing"),
        (lambda text: text + "[]\n", "line 4: "),
    ],
)
def test_a_damaged_file_is_said_by_line(damage: Callable[[str], str], message: str, tmp_path: Path) -> None:
    file = add_record(FIRST, record([0.5], 0.5), tmp_path)
    file.write_text(damage(file.read_text()))
    with pytest.raises(UserError, match=f"walk-paper.jsonl, {message}"):
        read_records([FIRST], tmp_path)


def test_what_is_kept_of_a_run_folder(tmp_path: Path) -> None:
    interval = {"success_rate": 0.5, "success_rate_interval": [0.25, 0.75]}
    suite = {**interval, "per_depth": {"2": interval, "3": {**interval, "success_rate": 1.0}}, "per_task": [1, 2, 3]}
    row = {**dict.fromkeys(CURVE, 0.25), "train/loss": 3.0}
    folder = tmp_path / "run"
    with open_run(folder, {"env": "walk", "seed": 3}, tensorboard=False) as run:
        run.append({**row, "env_steps": 50})
        assert record_of(folder) is None
        run.append({**row, "env_steps": 100, "eval/steps_mean": None})
        run.write_summary({"env_steps": 100, "wall_s": 2.5, "final": {"suite": suite, "contested_choice": None}})
    found = record_of(folder)
    assert found is not None
    assert found.settings == {"env": "walk", "seed": 3}
    assert found.circumstances.keys() == {"commit", "machine", "versions"}
    assert (found.env_steps, found.wall_s) == (100, 2.5)
    assert tuple(found.curve) == CURVE
    assert (found.curve["env_steps"], found.curve["eval/steps_mean"]) == ([50, 100], [0.25, None])
    by_depth = {"depth": [2, 3], "success_rate": [0.5, 1.0], "success_rate_interval": [[0.25, 0.75]] * 2}
    assert found.final == {"suite": {**interval, "per_depth": by_depth}, "contested_choice": None}
    add_record(FIRST, found, tmp_path)
    assert read_records([FIRST], tmp_path) == {FIRST: found}
    assert record_of(tmp_path / "none") is None


def test_all_kept_records_are_of_runs_of_the_panels() -> None:
    kept = read_records(
        [run for panel in (PANELS | TUNING).values() for run in panel.runs(NUM_SEEDS, None)], RESULTS / "paper"
    )
    lines = [(file.name, line) for file in (RESULTS / "paper").glob("*.jsonl") for line in lines_of(file)]
    assert len(kept) == sum("run" in line for _, line in lines) > 0
    hashes = [
        (name, kind, line[kind])
        for name, line in lines
        for kind in ("config", "source")
        if "run" not in line and kind in line
    ]
    assert len(set(hashes)) == len(hashes) > 0
    for run, found in kept.items():
        made = [found.settings[name] for name in ("env", "method", "recipe", "reward_set", "seed")]
        assert made == [run.env, run.curve.method, run.curve.recipe, run.reward_set, run.seed]
        assert {len(column) for column in found.curve.values()} == {20}
        # Later ones say how often the first choice was a best one, too.
        assert found.final.keys() - {"first_choice"} == {"suite", "contested_choice", "return_over_optimum"}


def test_every_summary_names_its_command() -> None:
    for line in lines_of(RESULTS / "summaries.jsonl"):
        assert "run" in line["command"] or "evaluate" in line["command"]
        scores = line["final"]["suite"] if "final" in line else line
        assert scores["success_rate_interval"][0] <= scores["success_rate"] <= scores["success_rate_interval"][1]


def lines_of(file: Path) -> list[dict[str, Any]]:
    """The objects of a file, at least one."""
    found = [json.loads(line) for line in file.read_text().splitlines()]
    assert found
    return found
