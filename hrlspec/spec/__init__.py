"""The specification language SPECTRL: text, syntax tree, padded task tree and monitor."""

from __future__ import annotations

from hrlspec.spec.compiler import compile_task
from hrlspec.spec.draw import draw_task
from hrlspec.spec.hashing import task_hash, task_hashes
from hrlspec.spec.monitor import RUNNING, SATISFIED, VIOLATED, TaskState, advance, initial, open_edges
from hrlspec.spec.parser import bare_lines, parse
from hrlspec.spec.semantics import satisfies
from hrlspec.spec.subtasks import Subtask, subtasks
from hrlspec.spec.syntax import (
    Achieve,
    And,
    Choice,
    Condition,
    Ensuring,
    Formula,
    Not,
    Or,
    Prop,
    SpecError,
    SpecWarning,
    Then,
)
from hrlspec.spec.text import to_text, tree_to_formula, tree_to_text
from hrlspec.spec.tree import TaskTree, forbidden, subtask_avoid

__all__ = [
    "RUNNING",
    "SATISFIED",
    "VIOLATED",
    "Achieve",
    "And",
    "Choice",
    "Condition",
    "Ensuring",
    "Formula",
    "Not",
    "Or",
    "Prop",
    "SpecError",
    "SpecWarning",
    "Subtask",
    "TaskState",
    "TaskTree",
    "Then",
    "advance",
    "bare_lines",
    "compile_task",
    "draw_task",
    "forbidden",
    "initial",
    "open_edges",
    "parse",
    "satisfies",
    "subtask_avoid",
    "subtasks",
    "task_hash",
    "task_hashes",
    "to_text",
    "tree_to_formula",
    "tree_to_text",
]
