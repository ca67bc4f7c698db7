"""Test tasks of a run: its preset's suites, or, for an environment without any, tasks drawn for the run."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from hrlspec.presets import Preset
from hrlspec.presets.generic import unseen_tasks
from hrlspec.run.errors import UserError


def with_tasks(preset: Preset, folder: Path | None, seed: int) -> Preset:
    """The preset, with suites if it has none: those in the run folder, if there is one, or some drawn with the seed.

    Raises:
        UserError: the run folder's suite cannot be read.
    """
    if preset.suite_names:
        return preset
    if folder is None:
        return dataclasses.replace(preset, texts=unseen_tasks(preset.make(), seed))
    tasks = folder / "tasks"
    try:
        found = {file.stem: file.read_text(encoding="utf-8") for file in sorted(tasks.glob("*.txt"))}
        texts = found if "dag" in found else unseen_tasks(preset.make(), seed)
    except OSError as error:
        raise UserError(f"cannot read {tasks}: {error}") from error
    except ValueError as error:  # no text, or no task that can be satisfied
        raise UserError(f"no test tasks in {tasks}: {error}") from error
    return dataclasses.replace(preset, texts=texts)
