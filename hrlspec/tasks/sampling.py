"""Random tasks: sequences for the curriculum and random trees (paper, "Training Curriculum" and "Experience Replay").

Rules for both: an edge reaches one proposition, or a set that holds together (below); its ``ensuring`` part has a
uniformly random size in 0..min(max_avoid, P - 2) and contains neither what the edge reaches nor what the edge before it
reached; no edge reaches what the edge before it reached; edges out of one node reach different propositions or sets.

Where propositions can hold together, a share of the edges, ``joint``, reaches one of the sets in ``together`` that its
proposition is part of, so far as there is one and the rules allow it.

Everything is vectorised over tasks and stays on the host: results have NumPy leaves with a leading axis M.

Axes: **M** tasks, **D** those of them that are drawn, **N** tree nodes, **P** atomic propositions, **J** sets that hold
together.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Bool, Int, UInt32

from hrlspec.spec.hashing import task_hashes
from hrlspec.spec.tree import TaskTree

_MAX_TRIES = 1000


def sample_sequences(
    rng: np.random.Generator,
    *,
    level: int,
    num_tasks: int,
    num_propositions: int,
    max_nodes: int,
    max_avoid: int = 3,
    joint: float = 0.0,
    together: Bool[np.ndarray, "J P"] | None = None,
    reserved: UInt32[np.ndarray, "..."] | None = None,
) -> TaskTree:
    """Sequences of ``level`` random sub-tasks, the curriculum's tasks of that level.

    Args:
        rng: advanced.
        level: number of sub-tasks, at least 1.
        num_tasks: M.
        num_propositions: P.
        max_nodes: N.
        max_avoid: largest ``ensuring`` part of an edge.
        joint: share of the edges that reach a set.
        together: bool ``[J, P]``, sets of propositions that can hold together.
        reserved: uint32 ``[...]``, hashes of held-out tasks, which are drawn again.

    Returns:
        Trees with NumPy leaves and leading axis M; node k + 1 is the k-th sub-task.

    Raises:
        ValueError: if an option is out of range or (nearly) every such task is reserved.
    """
    _check(num_tasks=num_tasks, num_propositions=num_propositions, max_avoid=max_avoid, level=level)
    _check_room(level, num_propositions, max_nodes)

    def draw(which: Int[np.ndarray, " D"]) -> TaskTree:
        trees = _blank(len(which), max_nodes, num_propositions)
        steps = np.arange(1, level + 1)
        goals = rng.integers(num_propositions, size=(len(which), level))
        if level > 1:
            # Uniform over what differs from the goal before: a step of 1..P-1 around the circle of propositions.
            goals[:, 1:] = rng.integers(1, num_propositions, size=(len(which), level - 1))
            goals = np.cumsum(goals, axis=1) % num_propositions
        trees.parent[:, steps] = steps - 1
        trees.depth[:, steps] = steps
        trees.valid[:, : level + 1] = True
        trees.accepting[:, level] = True
        trees.reach[:, 1 : level + 1] = np.eye(num_propositions, dtype=bool)[goals]
        _join(rng, trees, joint, together)
        _draw_avoid(rng, trees, max_avoid)
        return trees

    return _until_good(draw, num_tasks, reserved, None)


def sample_trees(
    rng: np.random.Generator,
    *,
    num_tasks: int,
    num_propositions: int,
    max_nodes: int,
    min_depth: int,
    max_depth: int,
    max_branching: int,
    max_avoid: int = 3,
    min_leaves: int = 1,
    joint: float = 0.0,
    together: Bool[np.ndarray, "J P"] | None = None,
    reserved: UInt32[np.ndarray, "..."] | None = None,
) -> TaskTree:
    """Random trees: the unseen tasks of the evaluation and, by recipe, of the collection.

    The depth (longest path) of each tree is uniform in ``min_depth..max_depth``. Each inner node gets a uniform
    number of children in ``1..max_branching`` as far as N nodes allow; one of them leads on to the full depth, the
    branches beside it have uniform depths of their own and so end at different depths. At least half of the trees
    (rounded up) have two leaves or more wherever ``max_branching`` and P allow for branches at all; their share,
    like ``min_leaves``, is enforced by drawing a tree again with its depth kept.

    Args:
        rng: advanced.
        num_tasks: M.
        num_propositions: P.
        max_nodes: N.
        min_depth: shortest longest path, at least 1.
        max_depth: longest path.
        max_branching: most children of a node; P limits it too, as siblings reach different propositions.
        max_avoid: largest ``ensuring`` part of an edge.
        min_leaves: fewest leaves of every tree.
        joint: share of the edges that reach a set.
        together: bool ``[J, P]``, sets of propositions that can hold together.
        reserved: uint32 ``[...]``, hashes of held-out tasks, which are drawn again.

    Returns:
        Trees with NumPy leaves and leading axis M, nodes in breadth-first order.

    Raises:
        ValueError: if an option is out of range, no such tree exists, or (nearly) every one is reserved.
    """
    _check(num_tasks=num_tasks, num_propositions=num_propositions, max_avoid=max_avoid, min_depth=min_depth)
    _check(max_branching=max_branching, min_leaves=min_leaves)
    if max_depth < min_depth:
        raise ValueError(f"max_depth is {max_depth}, smaller than min_depth, {min_depth}")
    _check_room(max_depth, num_propositions, max_nodes)
    branches = min(max_branching, num_propositions) > 1
    if (branches or min_leaves > 1) and max_nodes < max_depth + max(2, min_leaves):
        raise ValueError(
            f"trees of depth {max_depth} with {max(2, min_leaves)} leaves need max_nodes of at least "
            f"{max_depth + max(2, min_leaves)}, found {max_nodes}"
        )
    depth = rng.integers(min_depth, max_depth + 1, size=num_tasks)
    leaves = np.full(num_tasks, min_leaves)
    if branches:
        leaves[rng.permutation(num_tasks)[: (num_tasks + 1) // 2]] = max(2, min_leaves)

    def draw(which: Int[np.ndarray, " D"]) -> TaskTree:
        trees = _blank(len(which), max_nodes, num_propositions)
        _grow(rng, trees, depth[which], max_branching)
        _join(rng, trees, joint, together)
        _draw_avoid(rng, trees, max_avoid)
        return trees

    return _until_good(draw, num_tasks, reserved, leaves)


def _grow(rng: np.random.Generator, trees: TaskTree, depth: Int[np.ndarray, " D"], max_branching: int) -> None:
    """Fills structure and goals, node by node in breadth-first order, all trees at once.

    ``height`` is the length of the longest path below a node; nodes for it are reserved before any branch may use
    them, so the full depth is always reached.
    """
    num_tasks, max_nodes, num_propositions = trees.reach.shape
    rows = np.arange(num_tasks)
    height = np.zeros((num_tasks, max_nodes), np.int64)
    height[:, 0] = depth
    goal = np.full((num_tasks, max_nodes), -1)
    used = np.ones(num_tasks, np.int64)
    free = max_nodes - 1 - depth
    trees.valid[:, 0] = True
    for node in range(max_nodes - 1):
        most = min(max_branching, num_propositions - (node > 0))
        inner = trees.valid[:, node] & (height[:, node] > 0)
        if not inner.any():
            continue
        count = np.where(inner, np.minimum(rng.integers(1, most + 1, size=num_tasks), 1 + free), 0)
        main = np.floor(rng.random(num_tasks) * count).astype(np.int64)
        lottery = rng.random((num_tasks, num_propositions))
        lottery[rows[goal[:, node] >= 0], goal[goal[:, node] >= 0, node]] = 2.0  # comes last: never drawn
        goals = np.argsort(lottery, axis=1)
        extras_left = np.maximum(count - 1, 0)
        for j in range(most):
            exists, leads = j < count, j == main
            extra = exists & ~leads
            extras_left = extras_left - extra
            # A branch leaves a node for each of its siblings to come.
            tallest = np.where(extra, np.minimum(height[:, node] - 1, free - 1 - extras_left), 0)
            branch = rng.integers(0, tallest + 1)
            free = free - np.where(extra, 1 + branch, 0)
            some, new = rows[exists], used[exists]
            trees.valid[some, new] = True
            trees.parent[some, new] = node
            trees.depth[some, new] = trees.depth[some, node] + 1
            height[some, new] = np.where(leads, height[:, node] - 1, branch)[exists]
            goal[some, new] = goals[exists, j]
            used = used + exists
    trees.accepting[:] = trees.valid & (height == 0)
    tasks, nodes = np.nonzero(goal >= 0)
    trees.reach[tasks, nodes, goal[tasks, nodes]] = True


def _join(rng: np.random.Generator, trees: TaskTree, share: float, together: Bool[np.ndarray, "J P"] | None) -> None:
    """Has a share of the edges reach a set that their proposition is part of, unless another edge near them does."""
    if not share or together is None or not len(together):
        return
    reach, parent = np.asarray(trees.reach), np.asarray(trees.parent)
    edge = trees.valid & (parent >= 0)
    fits = (reach[:, :, None, :] & together).any(-1)
    chosen = together[np.argmax(rng.random(fits.shape) * fits, axis=-1)]
    joins = edge & fits.any(-1) & (rng.random(edge.shape) < share)
    joined = np.where(joins[..., None], chosen, reach)
    before = np.take_along_axis(joined, np.maximum(parent, 0)[:, :, None], axis=1)
    siblings = (parent[:, :, None] == parent[:, None, :]) & edge[:, None, :] & ~np.eye(parent.shape[1], dtype=bool)
    alike = siblings & (joined[:, :, None] == joined[:, None]).all(-1)
    trees.reach[:] = np.where((alike.any(-1) | (joined == before).all(-1))[..., None], reach, joined)


def _draw_avoid(rng: np.random.Generator, trees: TaskTree, max_avoid: int) -> None:
    """Fills the ``ensuring`` parts by the rules at the top."""
    num_tasks, num_nodes, num_propositions = trees.reach.shape
    most = max(0, min(max_avoid, num_propositions - 2))
    edge = trees.valid & (trees.parent >= 0)
    size = np.where(edge, rng.integers(0, most + 1, size=edge.shape), 0)
    reach: Bool[np.ndarray, "M N P"] = np.asarray(trees.reach)
    before = np.take_along_axis(reach, np.maximum(trees.parent, 0)[:, :, None], axis=1)
    lottery = rng.random((num_tasks, num_nodes, num_propositions))
    lottery[reach | before] = 2.0
    rank = np.argsort(np.argsort(lottery, axis=-1), axis=-1)
    trees.avoid[:] = (rank < size[:, :, None]) & ~(reach | before)


def _until_good(
    draw: Callable[[Int[np.ndarray, " D"]], TaskTree],
    num_tasks: int,
    reserved: UInt32[np.ndarray, "..."] | None,
    leaves: Int[np.ndarray, " M"] | None,
) -> TaskTree:
    """Draws all tasks, then again those that are reserved or have too few leaves."""
    which = np.arange(num_tasks)
    trees = draw(which)
    for _ in range(_MAX_TRIES):
        fresh = _take(trees, which)
        bad = np.zeros(len(which), bool)
        if reserved is not None and np.size(reserved):
            bad |= np.isin(task_hashes(fresh), reserved)
        if leaves is not None:
            bad |= fresh.accepting.sum(-1) < leaves[which]
        which = which[bad]
        if not len(which):
            return trees
        again = draw(which)
        for kept, new in zip(jax.tree.leaves(trees), jax.tree.leaves(again), strict=True):
            kept[which] = new
    raise ValueError(
        f"{len(which)} of {num_tasks} tasks could not be drawn in {_MAX_TRIES} tries: almost every such task is "
        "reserved or has too few leaves; allow more depth, branching or avoided propositions"
    )


def _take(trees: TaskTree, which: Int[np.ndarray, " D"]) -> TaskTree:
    taken: TaskTree = jax.tree.map(lambda x: x[which], trees)
    return taken


def _blank(num_tasks: int, max_nodes: int, num_propositions: int) -> TaskTree:
    """Trees of padding alone, NumPy leaves with leading axis M."""
    nodes = (num_tasks, max_nodes)
    return TaskTree(
        parent=np.full(nodes, TaskTree.NO_NODE, np.int32),  # type: ignore[arg-type]
        reach=np.zeros((*nodes, num_propositions), bool),  # type: ignore[arg-type]
        avoid=np.zeros((*nodes, num_propositions), bool),  # type: ignore[arg-type]
        accepting=np.zeros(nodes, bool),  # type: ignore[arg-type]
        valid=np.zeros(nodes, bool),  # type: ignore[arg-type]
        depth=np.zeros(nodes, np.int32),  # type: ignore[arg-type]
    )


def _check(**options: int) -> None:
    """Every option is at least 1, counts of tasks and avoided propositions at least 0."""
    for name, value in options.items():
        least = 0 if name in ("num_tasks", "max_avoid") else 1
        if value < least:
            raise ValueError(f"{name} must be at least {least}, found {value}")


def _check_room(depth: int, num_propositions: int, max_nodes: int) -> None:
    """A path of ``depth`` edges fits, and its goals can alternate."""
    if max_nodes < depth + 1:
        raise ValueError(f"{depth} sub-tasks in a row need max_nodes of at least {depth + 1}, found {max_nodes}")
    if depth > 1 and num_propositions < 2:
        raise ValueError(f"{depth} sub-tasks in a row need two propositions or more, found {num_propositions}")
