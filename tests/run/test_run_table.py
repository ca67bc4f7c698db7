"""How far many runs are, as it is shown."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from hrlspec.run import run_table
from hrlspec.run.console import PlainConsole
from hrlspec.run.folder import open_run, read_record
from hrlspec.run.planned import PlannedRun
from hrlspec.run.run_table import RunTable
from tests.run.made import make_run


@pytest.fixture
def runs(tmp_path: Path) -> list[PlannedRun]:
    """One with two evaluations, one that has none yet, two that have not begun."""
    some = [PlannedRun(f"a{seed}", (), tmp_path / f"a{seed}", 1000) for seed in range(4)]
    make_run(some[0].folder, "--seed", "0", success=(0.25, 0.5))
    make_run(some[1].folder, "--seed", "1")
    return some


def shown(table: RunTable) -> str:
    """The table as a terminal would show it."""
    console = PlainConsole(file=io.StringIO(), width=100)
    with console.capture() as capture:
        console.print(table.table())
    return capture.get()


def rows(table: RunTable) -> dict[str, list[str]]:
    words = [line.split() for line in shown(table).splitlines()]
    return {word[0]: word[1:] for word in words if len(word) == 6 and word[0].startswith("a")}


def test_each_run_is_a_row(runs: list[PlannedRun], monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    table = RunTable(runs, PlainConsole(file=io.StringIO(), height=40))
    assert rows(table)["a0"] == ["waiting", "200", "1,000", "0.500", "2:00"]
    assert rows(table)["a2"] == ["waiting", "0", "1,000", "-", "-"]
    with open_run(runs[1].folder, read_record(runs[1].folder)["config"], resume=True, tensorboard=False) as run:
        run.rewind(-1)
        run.append({"env_steps": 300, "wall_s": 5.0, "eval/success_rate": 0.75})
        clock[0] = run_table.LINE_SECONDS
        table.update()
        assert rows(table)["a1"] == ["running", "300", "1,000", "0.750", "0:05"]
    table.ended(runs[0], "finished")
    table.ended(runs[3], "failed")
    assert (rows(table)["a0"][0], rows(table)["a3"][0]) == ("finished", "failed")
    # 300 steps in a minute, and 3,500 to go.
    line = "1 finished, 1 running, 1 waiting, 1 failed; 500/4,000 steps, 5 steps/s, 11:40 left"
    assert table.line() == line
    assert line in " ".join(shown(table).split())


def test_where_there_is_little_room_it_is_for_those_that_run(runs: list[PlannedRun]) -> None:
    with open_run(runs[1].folder, read_record(runs[1].folder)["config"], resume=True, tensorboard=False):
        table = RunTable(runs, PlainConsole(file=io.StringIO(), height=10))
        assert [*rows(table)] == ["a1"]


def test_lines_and_a_table_that_goes_away(runs: list[PlannedRun], monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    plain, terminal = io.StringIO(), io.StringIO()
    consoles = PlainConsole(file=plain), PlainConsole(file=terminal, force_terminal=True, width=100, height=40)
    for console in consoles:
        with RunTable(runs, console) as table:
            table.update()  # a moment ago
            clock[0] += run_table.LINE_SECONDS
            table.update()
            table.ended(runs[0], "finished")
    assert plain.getvalue() == "4 waiting; 200/4,000 steps\ndone: a0, trained in 2:00\n"
    assert "waiting" in terminal.getvalue()
    assert "\x1b[" in terminal.getvalue()  # the cursor moves
