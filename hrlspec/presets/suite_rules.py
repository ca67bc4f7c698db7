"""How test suites come about: samplers, and rules for what is kept of what they draw.

Axes: **M** tasks, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Mapping

import jax
import numpy as np

from hrlspec.spec import TaskTree, task_hashes
from hrlspec.tasks.sampling import sample_sequences, sample_trees

NUM_TASKS = 200
MAX_NODES = 16
"""Trees of the suites fit into what training pads to."""

Draw = Callable[[np.random.Generator, int, np.ndarray], TaskTree]
"""Draws at least M tasks over P propositions, none of them with a reserved hash."""


@dataclasses.dataclass(frozen=True)
class SuiteRule:
    """How a suite comes about.

    Attributes:
        about: a line for its readers.
        draws: samplers, each of which contributes the same number of tasks up to rounding.
        keep: which of the drawn trees are taken, bool ``[M]``.
        scarce: whether a sampler may find few tasks: then at most a quarter of those that it found is taken, and no
            sequence, of which there are fewer still, so that enough are left to train on. Otherwise that is an error.
    """

    about: str
    draws: tuple[Draw, ...]
    keep: Callable[[TaskTree], np.ndarray] = lambda trees: np.ones(len(trees.parent), bool)
    scarce: bool = False


def trees(depth: int, *, max_branching: int = 3, num_drawn: int = 4 * NUM_TASKS) -> Draw:
    """Random trees whose longest path has ``depth`` edges."""

    def draw(rng: np.random.Generator, num_propositions: int, reserved: np.ndarray) -> TaskTree:
        return sample_trees(
            rng,
            num_tasks=num_drawn,
            num_propositions=num_propositions,
            max_nodes=MAX_NODES,
            min_depth=depth,
            max_depth=depth,
            max_branching=max_branching,
            max_avoid=2,
            reserved=reserved,
        )

    return draw


def sequences(level: int, *, max_avoid: int, num_drawn: int) -> Draw:
    """Random sequences of ``level`` sub-tasks."""

    def draw(rng: np.random.Generator, num_propositions: int, reserved: np.ndarray) -> TaskTree:
        return sample_sequences(
            rng,
            level=level,
            num_tasks=num_drawn,
            num_propositions=num_propositions,
            max_nodes=MAX_NODES,
            max_avoid=max_avoid,
            reserved=reserved,
        )

    return draw


def root_children(tasks: TaskTree) -> np.ndarray:
    """How many children the root has, int ``[M]``."""
    return (np.asarray(tasks.valid) & (np.asarray(tasks.parent) == TaskTree.ROOT)).sum(-1)


def shortest(tasks: TaskTree) -> np.ndarray:
    """Sub-tasks on the shortest way to satisfy each task, int ``[M]``."""
    return np.where(tasks.accepting, tasks.depth, np.iinfo(np.int32).max).min(-1)


def has_fork(tasks: TaskTree) -> np.ndarray:
    """Whether some node has several children, bool ``[M]``; tasks without are sequences."""
    nodes = np.arange(tasks.parent.shape[-1])
    return ((np.asarray(tasks.parent)[..., None] == nodes).sum(-2) > 1).any(-1)


def always_avoids(tasks: TaskTree) -> np.ndarray:
    """Whether every edge has something to avoid, bool ``[M]``."""
    edge = np.asarray(tasks.valid) & (np.asarray(tasks.parent) != TaskTree.NO_NODE)
    return (np.asarray(tasks.avoid).any(-1) | ~edge).all(-1)


def random_trees(*depths: int) -> SuiteRule:
    """Random trees of several depths, of which no way to satisfy one is a single sub-task."""
    listed = f"{', '.join(map(str, depths[:-1]))} and {depths[-1]}"
    return SuiteRule(
        f"random trees, depth {listed} in equal numbers, 1 to 3 children of a node, 0 to 2 negatives on an edge; "
        "every way to satisfy a task takes 2 sub-tasks or more",
        tuple(trees(depth) for depth in depths),
        lambda tasks: shortest(tasks) >= 2,
    )


DAG = random_trees(2, 3, 4)
REACH_AVOID = SuiteRule(
    "sequences of 2 to 6 sub-tasks in equal numbers, 1 or 2 negatives on each (tasks of one sub-task are too few to "
    "hold any of them out)",
    tuple(sequences(level, max_avoid=2, num_drawn=40 * NUM_TASKS) for level in range(2, 7)),
    always_avoids,
)
REACH = SuiteRule(
    "sequences of 4, 6, 8, 10 and 12 sub-tasks in equal numbers, without negatives (of 2 and 3 there are too few to "
    "hold them out)",
    tuple(sequences(level, max_avoid=0, num_drawn=4 * NUM_TASKS) for level in (4, 6, 8, 10, 12)),
)


VALIDATION = "_validation"
"""Ending of the names of suites for whoever tunes or chooses anything, which leaves the test suites to the end."""
_VALIDATED = ("dag", "branches")
_DRAWING = 2
"""Which drawing of all suites this is: the first served for tuning and for results alike."""


def with_validation(rules: Mapping[str, SuiteRule]) -> dict[str, SuiteRule]:
    """Rules of test suites and, last, of the validation suites that belong to some of them."""
    return {**rules, **{name + VALIDATION: rules[name] for name in _VALIDATED if name in rules}}


def seed_of_suite(world: str, name: str) -> int:
    """A number that belongs to the suite's name, so that adding a suite changes no other."""
    return zlib.crc32(f"{world}/{name}/{_DRAWING}".encode())


def draw_suite(
    rng: np.random.Generator, rule: SuiteRule, num_propositions: int, taken: np.ndarray, where: str
) -> TaskTree:
    """Distinct tasks, the samplers' shares one after the other.

    Args:
        rng: advanced.
        rule: what to draw.
        num_propositions: P.
        taken: uint32, hashes of tasks that may not be drawn.
        where: what to call the suite in a message.

    Raises:
        ValueError: there are too few such tasks.
    """
    parts = []
    for part, draw in enumerate(rule.draws):
        share = NUM_TASKS * (part + 1) // len(rule.draws) - NUM_TASKS * part // len(rule.draws)
        drawn = draw(rng, num_propositions, taken)
        hashes = task_hashes(drawn)
        first = np.zeros(len(hashes), bool)
        first[np.unique(hashes, return_index=True)[1]] = True
        rows = np.flatnonzero(first & rule.keep(drawn))
        if rule.scarce and len(rows) < 4 * share:
            rows = rows[has_fork(drawn)[rows]][: len(rows) // 4]
        elif len(rows) < share:
            raise ValueError(f"{where}: only {len(rows)} of {share} tasks among {len(hashes)} drawn ones")
        rows = rows[:share]
        parts.append(jax.tree.map(lambda x, rows=rows: x[rows], drawn))
        taken = np.concatenate([taken, hashes[rows]])
    result: TaskTree = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return result
