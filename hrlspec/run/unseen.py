"""Test tasks of a run: its preset's suites, or, for an environment that has none, tasks drawn for the run."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from hrlspec.presets import Preset
from hrlspec.presets.generic import unseen_tasks
from hrlspec.run.errors import UserError


def with_tasks(preset: Preset, folder: Path, seed: int) -> Preset:
    """The preset, with a suite ``dag`` if it has none: the one in the run folder, or one drawn with the run's seed.

    Raises:
        UserError: the run folder's suite cannot be read.
    """
    if preset.suite_names:
        return preset
    file = folder / "tasks" / "dag.txt"
    try:
        text = file.read_text(encoding="utf-8") if file.exists() else unseen_tasks(preset.make(), seed)
    except OSError as error:
        raise UserError(f"cannot read {file}: {error}") from error
    except ValueError as error:  # no text, or no task that can be satisfied
        raise UserError(f"no test tasks in {file}: {error}") from error
    return dataclasses.replace(preset, texts={"dag": text})
