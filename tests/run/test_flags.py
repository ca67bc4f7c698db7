"""Mistakes on a command line: one line each, whatever the terminal, about flags and not about classes."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hrlspec.config import Checked, ConfigError, OptimiserConfig, evolve, setting
from hrlspec.run.errors import UserError
from hrlspec.run.flags import in_flags, parse_flags
from hrlspec.run.run_flags import RunFlags

ROOT = Path(__file__).parents[2]


@dataclasses.dataclass(frozen=True)
class Flags(Checked):
    """What to do."""

    how_often: int = setting(1, least=1)
    put_it: Path = Path("here")
    optimiser: OptimiserConfig = dataclasses.field(default_factory=OptimiserConfig)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("--how-often 0", "--how-often is 0, expected at least 1 (see it --help)"),
        ("--optimiser.epochs 0", "--optimiser.epochs is 0, expected at least 1 (see it --help)"),
        ("--optimiser.epochs", "Missing value for argument '--optimiser.epochs'. Expected 1 values. (see it --help)"),
        ("--never", "Unrecognized options: --never (see it --help)"),
    ],
)
def test_what_is_wrong(argv: str, message: str) -> None:
    with pytest.raises(UserError) as error:
        parse_flags(Flags, argv.split(), program="it")
    assert str(error.value) == message


@pytest.mark.parametrize("place", ["gs://bucket/runs", "s3:", "s3:bucket", "hdfs://host/runs", "https://host/x"])
def test_places_elsewhere_are_refused_by_name(place: str) -> None:
    with pytest.raises(UserError) as error:
        parse_flags(Flags, ["--put-it", place], program="it")
    assert str(error.value).startswith(f"--put-it is {Path(place)}, expected a path on this machine; ")


@pytest.mark.parametrize("place", ["/gs:/x", "lr:0.1/x", "a:b", "gs", "C:/x", ":", "runs/gs://x"])
def test_names_with_colons_are_paths(place: str) -> None:
    assert parse_flags(Flags, ["--put-it", place], program="it").put_it == Path(place)


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_the_terminal_does_not_matter(encoding: str) -> None:
    """In ASCII the parser's messages have no frame."""
    command = [sys.executable, "-m", "experiments.suites", "--cheque"]
    ended = subprocess.run(
        command,
        env=os.environ | {"PYTHONIOENCODING": encoding},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith("error: Unrecognized options: --cheque")
    assert ended.stderr.endswith("(see python -m experiments.suites --help)\n")
    assert "──" not in ended.stderr
    assert "--- " not in ended.stderr


def test_help_begins_with_what_it_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        parse_flags(Flags, ["--help"], program="it", about="Something else.")
    assert not stop.value.code
    assert "Something else." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"total_steps": 0}, "--config.total-steps is 0"),
        ({"curriculum.levels": 40}, "--config.curriculum.max-nodes is 16"),
        # Both levels have such settings, so that nothing is said of which one it is.
        ({"low.clip": -1}, "PPOConfig.clip is -1"),
    ],
)
def test_settings_changed_after_parsing(change: dict[str, float], expected: str) -> None:
    with pytest.raises(ConfigError) as error:
        evolve(RunFlags().config, change)
    assert in_flags(error.value, RunFlags()).startswith(expected)


def test_other_messages_stay() -> None:
    for message in ("the moon is full", "Moon.phase is 9"):
        assert in_flags(ConfigError(message), RunFlags()) == message
