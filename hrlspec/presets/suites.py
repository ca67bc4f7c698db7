"""The test suites of presets: tasks that no run ever trains on, kept as text beside this file.

``hrlspec suites`` draws them anew, byte for byte the same.
"""

from __future__ import annotations

import functools
import hashlib
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hrlspec.evaluation import Suite, suite_from_text, suite_from_trees
from hrlspec.presets.suite_rules import MAX_NODES, NUM_TASKS, SuiteRule, draw_suite, seed_of_suite
from hrlspec.spec import task_hashes
from hrlspec.tasks.sampling import sample_trees

FOLDER = Path(__file__).parent / "suites"


class SuiteError(ValueError):
    """A suite that is not there, or cannot be read."""


@functools.cache
def packaged_suite(world: str, name: str, propositions: tuple[str, ...]) -> Suite:
    """The suite of a world in a file of this package.

    Raises:
        SuiteError: the file is missing or damaged.
    """
    return suite_from_text(name, _read(suite_file(world, name)), propositions)


@functools.cache
def packaged_hashes(world: str, names: tuple[str, ...], propositions: tuple[str, ...]) -> np.ndarray:
    """Sorted hashes of all tasks of a world's suites, uint32 ``[...]``; read-only.

    They are kept in a file, as compiling every formula at each start takes seconds; it counts only as long as the
    suites are what they were when it was written.

    Raises:
        SuiteError: a suite's file is missing or damaged.
    """
    file = hashes_file(world)
    lines = _read(file).split() if file.exists() else []
    if lines[:1] == [_fingerprint(world, names)]:
        result = np.array([int(line, 16) for line in lines[1:]], np.uint32)
    else:
        result = hashes_of([packaged_suite(world, name, propositions) for name in names])
    result.flags.writeable = False  # It is shared by all who ask.
    return result


def hashes_of(suites: Sequence[Suite]) -> np.ndarray:
    """Sorted hashes of all their tasks, uint32 ``[...]``."""
    return np.unique(np.concatenate([np.zeros(0, np.uint32), *(suite.hashes for suite in suites)]))


def suite_texts(world: str, rules: Mapping[str, SuiteRule], propositions: Sequence[str]) -> dict[str, str]:
    """A world's suites by name, drawn anew; no task occurs twice in them."""
    taken = np.zeros(0, np.uint32)
    texts = {}
    for name, rule in rules.items():
        seed, where = seed_of_suite(world, name), f"{world}/{name}"
        trees = draw_suite(np.random.default_rng(seed), rule, len(propositions), taken, where)
        taken = np.concatenate([taken, task_hashes(trees)])
        sampler = f"hrlspec.tasks.sampling.sample_{'sequences' if 'sequences' in rule.about else 'trees'}"
        comments = (
            f"{where}: {NUM_TASKS} unseen tasks",
            rule.about,
            f"sampler {sampler}, seed {seed}, trees fit {MAX_NODES} nodes, no task twice",
            "made by: python -m experiments.suites",
        )
        texts[name] = commented(comments, suite_from_trees(name, trees, propositions).formulas)
    return texts


def hashes_text(world: str, names: tuple[str, ...], propositions: Sequence[str]) -> str:
    """What `packaged_hashes` reads, of the files as they are now."""
    suites = [suite_from_text(name, _read(suite_file(world, name)), propositions) for name in names]
    return "\n".join([_fingerprint(world, names), *(f"{task:08x}" for task in hashes_of(suites))]) + "\n"


def commented(comments: Sequence[str], formulas: Sequence[str]) -> str:
    """A file of tasks: comments, then one formula a line."""
    wrapped = [part for line in comments for part in textwrap.wrap(line, 118)]
    return "".join(f"{line}\n" for line in [*(f"# {part}" for part in wrapped), *formulas])


def suite_file(world: str, name: str) -> Path:
    """Where a suite is kept."""
    return FOLDER / world / f"{name}.txt"


def hashes_file(world: str) -> Path:
    """Where the hashes of a world's suites are kept."""
    return FOLDER / world / "reserved.hex"


def _read(path: Path) -> str:
    """A file of ours.

    Raises:
        SuiteError: it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SuiteError(f"cannot read {path}: {error}; write it again with `hrlspec suites`") from error


def _fingerprint(world: str, names: Sequence[str]) -> str:
    """Changes with the suites' files and with the way tasks are hashed."""
    digest = hashlib.sha256()
    for name in names:
        digest.update(_read(suite_file(world, name)).encode())
    sample = sample_trees(
        np.random.default_rng(0),
        num_tasks=16,
        num_propositions=5,
        max_nodes=MAX_NODES,
        min_depth=1,
        max_depth=4,
        max_branching=3,
    )
    digest.update(task_hashes(sample).tobytes())
    return digest.hexdigest()
