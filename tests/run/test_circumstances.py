"""Records say what ran, and not where on a machine it lay."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hrlspec.run import circumstances as module
from hrlspec.run.circumstances import circumstances, current_commit

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("program", "said"),
    [
        (ROOT / "benchmarks" / "seeds.py", "benchmarks/seeds.py"),
        (Path("/anywhere/bin/hrlspec"), "hrlspec"),
        (Path("-c"), "-c"),
    ],
)
def test_the_command_names_no_place(program: Path, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [str(program), "--env", "walk"])
    assert circumstances()["command"] == [said, "--env", "walk"]


def test_records_that_a_command_adds_are_no_change_of_the_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, record, page, other = (
        tmp_path / name for name in ("hrlspec/run/source.py", "results/a.jsonl", "docs/results.md", "docs/a.md")
    )
    for file in (source, record, page, other):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("before")
    who = ("-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
    for command in (["init", "-q"], ["add", "."], [*who, "commit", "-qm", "first"]):
        subprocess.run(["git", "-C", str(tmp_path), *command], check=True)
    monkeypatch.setattr(module, "__file__", str(source))
    commit = current_commit()
    assert commit is not None
    for file, said in ((record, commit), (page, commit), (other, f"{commit}+changes"), (source, f"{commit}+changes")):
        file.write_text("after")
        assert current_commit() == said
        file.write_text("before")
