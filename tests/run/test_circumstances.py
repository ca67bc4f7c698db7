"""Records say what ran, and not where on a machine it lay."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hrlspec.run.circumstances import circumstances

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
