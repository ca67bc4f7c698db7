"""Weights & Biases: the numbers of a run and its configuration, in one W&B run however often it is resumed."""

from __future__ import annotations

import contextlib
import json
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import wandb

from hrlspec.run.errors import UserError, in_words
from hrlspec.run.files import write_atomically


class WandbRun:
    """A run in W&B, online or, with the environment variable ``WANDB_MODE=offline``, in the run folder alone.

    A resumed run adds again what it does again: the same numbers at the same ``env_steps``, which is the axis.

    Args:
        folder: the run folder. ``wandb.json`` in it says which W&B run it is; W&B's own files go beside that.
        project: where the run is to be found in W&B.
        config: told to W&B as the run's configuration.

    Raises:
        UserError: the library refuses, or the folder's run is in another project.
    """

    def __init__(self, folder: Path, project: str, config: Mapping[str, Any]) -> None:
        name = folder.resolve().name
        id_ = _id(folder / "wandb.json", project)
        try:
            self._run = wandb.init(
                project=project,
                id=id_,
                name=name,
                dir=str(folder),
                config=dict(config),
                resume="allow",
                reinit="create_new",  # seeds side by side have a run each
                settings=wandb.Settings(console="off"),  # the terminal is ours
            )
            self._run.define_metric("*", step_metric="env_steps")
        except Exception as error:  # whatever it raises where nobody is logged in, or nothing answers
            raise UserError(f"Weights & Biases does not begin: {in_words(error)}") from error

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Adds numbers under their names."""
        with contextlib.suppress(Exception):  # as `Recorder` has it
            self._run.log({"env_steps": step, **values})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        """Sends what is left; the run counts as failed if it was left by an exception."""
        with contextlib.suppress(Exception):
            self._run.finish(exit_code=int(exception[0] is not None))


def _id(file: Path, project: str) -> str:
    """The id that the file holds; made and written if there is none."""
    try:
        known = json.loads(file.read_text())
        there, id_ = str(known["project"]), str(known["id"])
    except FileNotFoundError:
        there, id_ = project, uuid.uuid4().hex[:8]
        write_atomically(file, json.dumps({"project": there, "id": id_}) + "\n")
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UserError(f"cannot read {file}: {in_words(error)}; without it --wandb begins a new W&B run") from error
    if there != project:
        raise UserError(f"{file.parent} is told to the W&B project {there}, not {project}: resume with --wandb {there}")
    return id_
