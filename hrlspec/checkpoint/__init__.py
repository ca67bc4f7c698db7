"""Checkpoints: the whole state on disk, verified when it is read back."""

from __future__ import annotations

from hrlspec.checkpoint.leaves import state_hash
from hrlspec.checkpoint.store import (
    CheckpointDamagedError,
    CheckpointError,
    CheckpointMismatchError,
    CheckpointMissingError,
    Restored,
    load,
    save,
    steps,
)

__all__ = [
    "CheckpointDamagedError",
    "CheckpointError",
    "CheckpointMismatchError",
    "CheckpointMissingError",
    "Restored",
    "load",
    "save",
    "state_hash",
    "steps",
]
