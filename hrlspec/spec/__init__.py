"""The specification language SPECTRL: text, syntax tree, padded task tree, monitor and samplers."""

from __future__ import annotations

from hrlspec.spec.hashing import task_hash, task_hashes
from hrlspec.spec.monitor import RUNNING, SATISFIED, VIOLATED, TaskState, advance, initial, open_edges
from hrlspec.spec.sampling import sample_sequences, sample_trees
from hrlspec.spec.tree import TaskTree, subtask_avoid

__all__ = [
    "RUNNING",
    "SATISFIED",
    "VIOLATED",
    "TaskState",
    "TaskTree",
    "advance",
    "initial",
    "open_edges",
    "sample_sequences",
    "sample_trees",
    "subtask_avoid",
    "task_hash",
    "task_hashes",
]
