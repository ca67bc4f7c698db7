"""The test suites: tasks that no run ever trains on, kept as text beside this file.

``python -m experiments.suites`` draws them anew, byte for byte the same; ``--check`` only says whether they are.

Axes: **M** tasks, **P** atomic propositions.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import hashlib
import textwrap
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

import envs_jax
from envs_jax.zone.layouts import COLOURS
from hrlspec.evaluation import Suite, suite_from_text, suite_from_trees
from hrlspec.run.errors import UserError
from hrlspec.spec import TaskTree, task_hashes
from hrlspec.tasks.sampling import sample_sequences, sample_trees

FOLDER = Path(__file__).parent / "suites"
COMMAND = "python -m experiments.suites"
NUM_TASKS = 200
MAX_NODES = 16
"""Trees of the suites fit into what training pads to."""

Draw = Callable[[np.random.Generator, int, np.ndarray], TaskTree]
"""Draws at least M tasks over P propositions, none of them with a reserved hash."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """How a suite comes about.

    Attributes:
        about: a line for its readers.
        draws: samplers, each of which contributes the same number of tasks up to rounding.
        keep: which of the drawn trees are taken, bool ``[M]``.
    """

    about: str
    draws: tuple[Draw, ...]
    keep: Callable[[TaskTree], np.ndarray] = lambda trees: np.ones(len(trees.parent), bool)


def _trees(depth: int, *, max_branching: int = 3, num_drawn: int = 4 * NUM_TASKS) -> Draw:
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


def _sequences(level: int, *, max_avoid: int, num_drawn: int) -> Draw:
    """Random sequences."""

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


def _root_children(trees: TaskTree) -> np.ndarray:
    """How many children the root has, int ``[M]``."""
    return (np.asarray(trees.valid) & (np.asarray(trees.parent) == TaskTree.ROOT)).sum(-1)


def _shortest(trees: TaskTree) -> np.ndarray:
    """Sub-tasks on the shortest way to satisfy each task, int ``[M]``."""
    return np.where(trees.accepting, trees.depth, np.iinfo(np.int32).max).min(-1)


def _always_avoids(trees: TaskTree) -> np.ndarray:
    """Whether every edge has something to avoid, bool ``[M]``."""
    edge = np.asarray(trees.valid) & (np.asarray(trees.parent) != TaskTree.NO_NODE)
    return (np.asarray(trees.avoid).any(-1) | ~edge).all(-1)


def _ways(trees: TaskTree, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
    """How many ways to satisfy each task there are, and how many reach ``second`` after ``first``; int ``[M]``."""
    parent, reach = np.asarray(trees.parent), np.asarray(trees.reach)
    rows = np.arange(len(parent))
    met, spoilt = np.zeros(parent.shape, bool), np.zeros(parent.shape, bool)
    for node in range(1, parent.shape[1]):  # parents come before children
        above = parent[:, node]
        spoilt[:, node] = spoilt[rows, above] | (met[rows, above] & reach[:, node, second])
        met[:, node] = met[rows, above] | reach[:, node, first]
    ends = np.asarray(trees.accepting & trees.valid)
    return ends.sum(-1), (ends & spoilt).sum(-1)


_DAG = Recipe(
    "random trees, depth 2, 3 and 4 in equal numbers, 1 to 3 children of a node, 0 to 2 negatives on an edge; "
    "every way to satisfy a task takes 2 sub-tasks or more",
    tuple(_trees(depth) for depth in (2, 3, 4)),
    lambda trees: _shortest(trees) >= 2,
)

_ZONE_DAG = Recipe(
    "random trees, depth 2 and 3 in equal numbers, 1 to 3 children of a node, 0 to 2 negatives on an edge; "
    "every way to satisfy a task takes 2 sub-tasks or more",
    tuple(_trees(depth) for depth in (2, 3)),
    lambda trees: _shortest(trees) >= 2,
)
_BLUE, _GREEN = (COLOURS.index(colour) for colour in ("blue", "green"))


def _possible(trees: TaskTree) -> np.ndarray:
    """Whether some way to satisfy the task leaves green before blue makes it vanish, bool ``[M]``."""
    ways, spoilt = _ways(trees, _BLUE, _GREEN)
    return (_shortest(trees) >= 2) & (spoilt < ways)


def _order_matters(trees: TaskTree) -> np.ndarray:
    """Whether besides that some other way asks for green after blue, bool ``[M]``."""
    return _possible(trees) & (_ways(trees, _BLUE, _GREEN)[1] > 0)


_NM_DAG = dataclasses.replace(
    _ZONE_DAG, about=f"{_ZONE_DAG.about}, and at least one way asks for no green after blue", keep=_possible
)
_NM_ORDER = dataclasses.replace(
    _ZONE_DAG,
    about=f"{_NM_DAG.about}, but some other way does, where no green is left",
    draws=tuple(_trees(depth, num_drawn=16 * NUM_TASKS) for depth in (2, 3)),
    keep=_order_matters,
)
_REACH_AVOID = Recipe(
    "sequences of 2 to 6 sub-tasks in equal numbers, 1 or 2 negatives on each (tasks of one sub-task are too few to "
    "hold any of them out)",
    tuple(_sequences(level, max_avoid=2, num_drawn=40 * NUM_TASKS) for level in range(2, 7)),
    _always_avoids,
)
_REACH = Recipe(
    "sequences of 4, 6, 8, 10 and 12 sub-tasks in equal numbers, without negatives (of 2 and 3 there are too few to "
    "hold them out)",
    tuple(_sequences(level, max_avoid=0, num_drawn=4 * NUM_TASKS) for level in (4, 6, 8, 10, 12)),
)

RECIPES: dict[str, dict[str, Recipe]] = {
    "letter": {
        "dag": _DAG,
        "deeper": Recipe(
            "random trees of depth 5, beyond what training collects on or relabels to, 1 to 3 children of a node, "
            "0 to 2 negatives on an edge; every way to satisfy a task takes 5 sub-tasks",
            (_trees(5, num_drawn=60 * NUM_TASKS),),
            lambda trees: _shortest(trees) == 5,
        ),
        "wider": Recipe(
            "random trees, depth 2, 3 and 4 in equal numbers, 4 children of the root, beyond what training collects on "
            "or relabels to, 1 to 4 elsewhere, 0 to 2 negatives on an edge; every way to satisfy a task takes 2 "
            "sub-tasks or more",
            tuple(_trees(depth, max_branching=4, num_drawn=30 * NUM_TASKS) for depth in (2, 3, 4)),
            lambda trees: (_root_children(trees) == 4) & (_shortest(trees) >= 2),
        ),
        "branches": Recipe(
            "random trees, depth 2, 3 and 4 in equal numbers, 2 or 3 children of the root, 1 to 3 elsewhere, 0 to 2 "
            "negatives on an edge; for return over optimum, where branches may be of any length",
            tuple(_trees(depth) for depth in (2, 3, 4)),
            lambda trees: _root_children(trees) >= 2,
        ),
    },
    "letter12": {
        "dag": _DAG,
        "reach_avoid_6": Recipe(
            "sequences of 6 sub-tasks, 1 or 2 negatives on each (the peers' RA-6)",
            (_sequences(6, max_avoid=2, num_drawn=40 * NUM_TASKS),),
            _always_avoids,
        ),
        "reach_12": Recipe(
            "sequences of 12 sub-tasks without negatives (the peers' R-12)",
            (_sequences(12, max_avoid=0, num_drawn=2 * NUM_TASKS),),
        ),
    },
    "walk": {"dag": _DAG, "reach_avoid": _REACH_AVOID, "reach": _REACH},
    "flatworld": {"dag": _DAG, "reach_avoid": _REACH_AVOID, "reach": _REACH},
    "zone": {"dag": _ZONE_DAG, "reach_avoid": _REACH_AVOID, "reach": _REACH},
    "zone-ltl2action": {"dag": _ZONE_DAG},
    "zone-nm": {"dag": _NM_DAG, "order": _NM_ORDER},
}


def suite_names(env_name: str) -> tuple[str, ...]:
    """The suites of an environment's preset; none for one without."""
    return tuple(RECIPES.get(env_name, {}))


@functools.cache
def load_suite(env_name: str, name: str) -> Suite:
    """A suite by name.

    Raises:
        UserError: if there is no such suite, or its file is missing or damaged.
    """
    known = suite_names(env_name)
    if name not in known:
        expected = f"expected one of: {', '.join(known)}" if known else "there is none for this environment"
        raise UserError(f"unknown suite {name!r} of {env_name!r}; {expected}")
    return _suite(env_name, name)


@functools.cache
def reserved_hashes(env_name: str) -> np.ndarray:
    """Sorted hashes of all tasks of an environment's suites, uint32 ``[...]``: training must reject them.

    Empty for an environment without suites. They are kept in a file, as compiling every formula at each start takes
    seconds; it counts only as long as the suites are what they were when it was written.

    Raises:
        UserError: if a suite's file is missing or damaged.
    """
    names = suite_names(env_name)
    if not names:
        return np.zeros(0, np.uint32)
    lines = _read(_reserved_path(env_name)).split() if _reserved_path(env_name).exists() else []
    if lines[:1] == [_fingerprint(env_name)]:
        result = np.array([int(line, 16) for line in lines[1:]], np.uint32)
    else:
        result = _hashes([load_suite(env_name, name) for name in names])
    result.flags.writeable = False  # It is shared by all who ask.
    return result


def generate(env_name: str) -> dict[str, str]:
    """The files of an environment's suites by name, drawn anew; no task occurs twice in an environment's suites."""
    propositions = envs_jax.make(env_name).propositions
    taken = np.zeros(0, np.uint32)
    files = {}
    for name, recipe in RECIPES[env_name].items():
        trees = _draw(env_name, name, recipe, len(propositions), taken)
        taken = np.concatenate([taken, task_hashes(trees)])
        files[name] = _header(env_name, name, recipe) + "".join(
            f"{formula}\n" for formula in suite_from_trees(name, trees, propositions).formulas
        )
    return files


def main() -> None:
    """Writes the suites, or checks them."""
    parser = argparse.ArgumentParser(prog=COMMAND, description="Draws the test suites anew, byte for byte the same.")
    parser.add_argument("--check", action="store_true", help="write nothing, only say whether the files are as drawn")
    check = parser.parse_args().check
    for env_name in RECIPES:
        for name, text in generate(env_name).items():
            path = _path(env_name, name)
            if not check:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8", newline="\n")
            elif not path.exists() or path.read_bytes() != text.encode():
                raise UserError(f"{path} is not what the sampler draws; write it again with `{COMMAND}`")
            print(f"{'as drawn' if check else 'written'}: {path}")
        if not check:
            suites = [_suite(env_name, name) for name in suite_names(env_name)]
            lines = [_fingerprint(env_name), *(f"{task:08x}" for task in _hashes(suites))]
            _reserved_path(env_name).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _path(env_name: str, name: str) -> Path:
    return FOLDER / env_name / f"{name}.txt"


def _reserved_path(env_name: str) -> Path:
    return FOLDER / env_name / "reserved.hex"


def _read(path: Path) -> str:
    """A file of ours.

    Raises:
        UserError: if it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {path}: {error}; write it again with `{COMMAND}`") from error


def _suite(env_name: str, name: str) -> Suite:
    """A suite from its file."""
    return suite_from_text(name, _read(_path(env_name, name)), envs_jax.make(env_name).propositions)


def _hashes(suites: Sequence[Suite]) -> np.ndarray:
    """Sorted hashes of all their tasks, uint32 ``[...]``."""
    return np.unique(np.concatenate([suite.hashes for suite in suites]))


def _fingerprint(env_name: str) -> str:
    """Changes with the suites' files and with the way tasks are hashed."""
    digest = hashlib.sha256()
    for name in suite_names(env_name):
        digest.update(_read(_path(env_name, name)).encode())
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


def _seed(env_name: str, name: str) -> int:
    """A number that belongs to the suite's name, so that adding a suite changes no other."""
    return zlib.crc32(f"{env_name}/{name}".encode())


def _header(env_name: str, name: str, recipe: Recipe) -> str:
    samplers = "hrlspec.spec.sample_sequences" if "sequences" in recipe.about else "hrlspec.spec.sample_trees"
    lines = (
        f"{env_name}/{name}: {NUM_TASKS} unseen tasks",
        recipe.about,
        f"sampler {samplers}, seed {_seed(env_name, name)}, trees fit {MAX_NODES} nodes, no task twice",
        f"made by: {COMMAND}",
    )
    return "".join(f"# {part}\n" for line in lines for part in textwrap.wrap(line, 118))


def _draw(env_name: str, name: str, recipe: Recipe, num_propositions: int, taken: np.ndarray) -> TaskTree:
    """M distinct tasks, the samplers' shares one after the other."""
    rng = np.random.default_rng(_seed(env_name, name))
    parts = []
    for part, draw in enumerate(recipe.draws):
        share = NUM_TASKS * (part + 1) // len(recipe.draws) - NUM_TASKS * part // len(recipe.draws)
        trees = draw(rng, num_propositions, taken)
        hashes = task_hashes(trees)
        first = np.zeros(len(hashes), bool)
        first[np.unique(hashes, return_index=True)[1]] = True
        rows = np.flatnonzero(first & recipe.keep(trees))[:share]
        if len(rows) < share:
            raise ValueError(f"{env_name}/{name}: only {len(rows)} of {share} tasks among {len(hashes)} drawn ones")
        parts.append(jax.tree.map(lambda x, rows=rows: x[rows], trees))
        taken = np.concatenate([taken, hashes[rows]])
    result: TaskTree = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return result
