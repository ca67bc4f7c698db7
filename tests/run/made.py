"""Run folders that nobody trained, and what is in folders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hrlspec.run.folder import open_run, read_metrics
from hrlspec.run.run_flags import experiments_of, parse_run


def make_run(folder: Path, *flags: str, success: Sequence[float] = (), final: float | None = None) -> Path:
    """A run with an evaluation every 100 steps.

    Args:
        folder: where it goes.
        *flags: of ``hrlspec run``.
        success: at each evaluation.
        final: success at the end, with an interval 0.1 wide; a run without is not finished.
    """
    ((experiment, path),) = experiments_of(parse_run(["--total-steps", "1000", "--out", str(folder), *flags]))
    with open_run(path, experiment, tensorboard=False) as run:
        for number, value in enumerate(success, start=1):
            run.append({"env_steps": 100 * number, "wall_s": 60.0 * number, "eval/success_rate": value, "level": 1})
        if final is not None:
            scores: dict[str, Any] = {}
            for name in ("success_rate", "return_mean", "steps_mean"):
                scores |= {name: final, f"{name}_interval": [final - 0.05, final + 0.05]}
            scores |= {"spl": None, "spl_interval": None}
            first = {"first_choice": 0.75, "first_choice_interval": None}
            results = {"suite": scores, "contested_choice": None, "first_choice": first}
            run.write_summary({"env_steps": 1024, "final": results, "pictures": []})
    return path


def contents(folder: Path) -> dict[str, bytes]:
    """Everything below a folder by its path; of folders nothing."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def rows(folder: Path) -> list[dict[str, Any]]:
    """Those of a run's ``metrics.jsonl``, without what depends on the clock."""
    return [{k: v for k, v in row.items() if k not in ("wall_s", "train/steps_per_s")} for row in read_metrics(folder)]
