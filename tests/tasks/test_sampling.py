from __future__ import annotations

import time
from collections import Counter
from typing import Any

import jax
import numpy as np
import pytest

from hrlspec.spec import TaskTree, compile_task, parse, task_hash, task_hashes, tree_to_text
from hrlspec.tasks.sampling import sample_sequences, sample_trees
from tests.spec.tasks import NAMES
from tests.spec.test_compile import check_shape

TREES = {
    "num_propositions": 5,
    "max_nodes": 16,
    "min_depth": 2,
    "max_depth": 4,
    "max_branching": 3,
}


def row(trees: TaskTree, m: int) -> TaskTree:
    return jax.tree.map(lambda x: x[m], trees)


def check_rules(trees: TaskTree, max_avoid: int = 3) -> None:
    """The sampling rules that sequences and trees share."""
    edge = trees.valid & (trees.parent >= 0)
    assert (edge.sum(-1) == trees.valid.sum(-1) - 1).all()
    assert (trees.reach.sum(-1) == edge).all()
    assert (trees.avoid.sum(-1) <= min(max_avoid, max(0, trees.num_propositions - 2))).all()
    assert not (trees.avoid & ~edge[..., None]).any()
    before = np.take_along_axis(trees.reach, np.maximum(trees.parent, 0)[..., None], axis=1)
    assert not (trees.avoid & (trees.reach | before)).any()
    assert not (trees.reach & before)[edge].any()
    goal = trees.reach.argmax(-1)
    for m in range(len(edge)):
        siblings = Counter(zip(trees.parent[m][edge[m]].tolist(), goal[m][edge[m]].tolist(), strict=True))
        assert max(siblings.values()) == 1
        check_shape(row(trees, m))


@pytest.mark.parametrize("level", [1, 2, 4, 7])
@pytest.mark.parametrize("num_propositions", [2, 5, 12])
def test_sequences(level: int, num_propositions: int) -> None:
    trees = sample_sequences(
        np.random.default_rng(level), level=level, num_tasks=300, num_propositions=num_propositions, max_nodes=8
    )
    check_rules(trees)
    assert (trees.depth.max(-1) == level).all()
    assert (trees.valid.sum(-1) == level + 1).all()
    assert (trees.accepting.sum(-1) == 1).all()


def test_sequences_are_uniform() -> None:
    trees = sample_sequences(np.random.default_rng(0), level=2, num_tasks=20_000, num_propositions=5, max_nodes=4)
    goals = trees.reach[:, 1:3].argmax(-1)
    pairs = Counter(map(tuple, goals.tolist()))
    assert len(pairs) == 20
    assert max(pairs.values()) < 1.2 * 20_000 / 20
    assert min(pairs.values()) > 0.8 * 20_000 / 20
    sizes = np.bincount(trees.avoid[:, 1:3].sum(-1).ravel()) / 40_000
    np.testing.assert_allclose(sizes, 0.25, atol=0.02)
    harm = trees.avoid[:, 1].mean(0)
    np.testing.assert_allclose(harm, harm.mean(), atol=0.02)


def test_trees() -> None:
    trees = sample_trees(np.random.default_rng(0), num_tasks=3000, **TREES)
    check_rules(row(trees, slice(300)))
    depth = trees.depth.max(-1)
    np.testing.assert_allclose(np.bincount(depth)[2:] / 3000, 1 / 3, atol=0.04)
    leaves = trees.accepting.sum(-1)
    assert (leaves >= 2).mean() >= 0.5
    assert (leaves == 1).any()
    children = np.array([np.bincount(p[p >= 0], minlength=16) for p in trees.parent])
    assert set(np.unique(children)) == {0, 1, 2, 3}
    leaf_depth = np.where(trees.accepting, trees.depth, 0)
    shortest = np.where(trees.accepting, trees.depth, 99).min(-1)
    assert (shortest < leaf_depth.max(-1)).mean() > 0.3, "branches end at different depths"
    assert trees.valid.sum(-1).max() <= 16
    # The branch that leads on must not be recognisable by its place.
    two = trees.valid.sum(-1) > 2
    first_is_deep = (trees.parent == 1).any(-1)[two].mean()
    assert 0.3 < first_is_deep < 0.9


@pytest.mark.parametrize("num_tasks", [1, 2, 7, 100])
def test_half_of_the_trees_branch(num_tasks: int) -> None:
    rng = np.random.default_rng(num_tasks)
    for _ in range(20):
        trees = sample_trees(
            rng, num_tasks=num_tasks, num_propositions=5, max_nodes=4, min_depth=1, max_depth=2, max_branching=2
        )
        assert 2 * (trees.accepting.sum(-1) >= 2).sum() >= num_tasks


def test_options_at_their_limits() -> None:
    rng = np.random.default_rng(3)
    tight = sample_trees(rng, num_tasks=100, **(TREES | {"max_nodes": 6, "max_depth": 4, "min_depth": 4}))
    check_rules(tight)
    assert (tight.depth.max(-1) == 4).all()
    lines = sample_trees(rng, num_tasks=50, **(TREES | {"max_branching": 1, "max_nodes": 5}))
    assert (lines.accepting.sum(-1) == 1).all()
    many = sample_trees(rng, num_tasks=100, min_leaves=4, **TREES)
    check_rules(many)
    assert (many.accepting.sum(-1) >= 4).all()
    two = sample_trees(rng, num_tasks=100, **(TREES | {"num_propositions": 2}))
    check_rules(two)
    bare = sample_trees(rng, num_tasks=50, max_avoid=0, **TREES)
    assert not bare.avoid.any()
    none = sample_sequences(rng, level=1, num_tasks=0, num_propositions=5, max_nodes=4)
    assert none.parent.shape == (0, 4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"max_nodes": 4}, "max_nodes"),
        ({"max_nodes": 5}, "max_nodes of at least 6"),
        ({"min_depth": 0}, "min_depth"),
        ({"min_depth": 5}, "smaller than min_depth"),
        ({"max_branching": 0}, "max_branching"),
        ({"num_propositions": 1}, "two propositions"),
        ({"max_avoid": -1}, "max_avoid"),
        ({"num_tasks": -1}, "num_tasks"),
        ({"max_branching": 1, "min_leaves": 2}, "could not be drawn"),
    ],
)
def test_impossible_options(change: dict[str, int], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        sample_trees(np.random.default_rng(0), **({"num_tasks": 3} | TREES | change))


def test_reserved_tasks_are_never_drawn() -> None:
    rng = np.random.default_rng(5)
    reserved = np.sort(task_hashes(sample_trees(rng, num_tasks=200, **TREES)))
    few = {"num_propositions": 3, "max_nodes": 4, "min_depth": 1, "max_depth": 2, "max_branching": 2}
    small = np.unique(task_hashes(sample_trees(rng, num_tasks=400, **few)))
    held_out = np.sort(rng.permutation(small)[: len(small) // 2])
    again = task_hashes(sample_trees(rng, num_tasks=1000, reserved=held_out, **few))
    assert np.isin(task_hashes(sample_trees(rng, num_tasks=1000, **few)), held_out).sum() > 100
    assert not np.isin(again, held_out).any()
    lines = task_hashes(sample_sequences(rng, level=1, num_tasks=500, num_propositions=5, max_nodes=16))
    assert len(np.unique(lines)) == 5 * (1 + 4 + 6 + 4), "goals times avoided sets of size 0 to 3"
    with pytest.raises(ValueError, match="reserved"):
        sample_sequences(rng, level=1, num_tasks=5, num_propositions=5, max_nodes=16, reserved=np.unique(lines))
    assert not np.isin(task_hashes(sample_trees(rng, num_tasks=500, reserved=reserved, **TREES)), reserved).any()


def test_the_same_seed_gives_the_same_tasks() -> None:
    draws = [sample_trees(np.random.default_rng(11), num_tasks=20, **TREES) for _ in range(2)]
    assert jax.tree.all(jax.tree.map(np.array_equal, *draws))


def test_thousands_of_trees_a_second() -> None:
    start = time.process_time()
    sample_trees(np.random.default_rng(0), num_tasks=2000, **TREES)
    assert time.process_time() - start < 1.0


def _shuffled(tree: TaskTree, rng: np.random.Generator, num_nodes: int) -> TaskTree:
    """The same task with siblings in another order, padded to ``num_nodes`` with holes in between."""
    nodes = np.flatnonzero(tree.valid)
    key = {0: ()}
    lottery = rng.random(len(tree.parent))
    for node in nodes[1:]:
        key[node] = (*key[tree.parent[node]], lottery[node])
    order = sorted(nodes, key=lambda node: (len(key[node]), key[node]))
    places = np.concatenate([[0], 1 + np.sort(rng.permutation(num_nodes - 1)[: len(nodes) - 1])])
    where = dict(zip(order, places.tolist(), strict=True))
    parent = np.full(num_nodes, TaskTree.NO_NODE, np.int32)
    arrays = {
        name: np.zeros((num_nodes, *getattr(tree, name).shape[1:]), getattr(tree, name).dtype)
        for name in ("reach", "avoid", "accepting", "valid", "depth")
    }
    for old, new in where.items():
        if old:
            parent[new] = where[tree.parent[old]]
        for name, array in arrays.items():
            array[new] = getattr(tree, name)[old]
    return TaskTree(parent=parent, **arrays)


def test_hash_depends_on_the_task_alone() -> None:
    rng = np.random.default_rng(0)
    trees = sample_trees(rng, num_tasks=200, **TREES)
    hashes = task_hashes(trees)
    moved = 0
    for m in range(200):
        tree = row(trees, m)
        other = _shuffled(tree, rng, 24)
        moved += not np.array_equal(other.parent[:16], tree.parent)
        assert int(task_hashes(jax.tree.map(lambda x: x[None], other))[0]) == int(hashes[m])
    assert moved > 150
    padded = jax.vmap(task_hash)(jax.tree.map(lambda x: np.pad(x, [(0, 0), (0, 5)] + [(0, 0)] * (x.ndim - 2)), trees))
    np.testing.assert_array_equal(padded, hashes)


def test_hash_is_the_same_on_host_and_device() -> None:
    trees = sample_trees(np.random.default_rng(1), num_tasks=500, **TREES)
    np.testing.assert_array_equal(jax.jit(jax.vmap(task_hash))(trees), task_hashes(trees))
    assert task_hashes(trees).dtype == np.uint32


def _canonical(tree: TaskTree, node: int) -> tuple:
    """The task without any order of siblings."""
    children = sorted(_canonical(tree, child) for child in np.flatnonzero(tree.parent == node))
    return tuple(tree.reach[node].tolist()), tuple(tree.avoid[node].tolist()), tuple(children)


def test_different_tasks_have_different_hashes() -> None:
    rng = np.random.default_rng(2)
    trees = sample_trees(rng, num_tasks=3000, **TREES)
    hashes = task_hashes(trees)
    tasks = {_canonical(row(trees, m), 0): int(hashes[m]) for m in range(3000)}
    assert len(tasks) > 2900
    assert len(set(hashes.tolist())) == len(tasks)
    one_bit_off = []
    tree = row(trees, 0)
    for name in ("reach", "avoid"):
        for node in np.flatnonzero(tree.valid)[1:]:
            for p in range(5):
                array = getattr(tree, name).copy()
                array[node, p] ^= True
                one_bit_off.append(tree.replace(**{name: array}))
    hashes = task_hashes(jax.tree.map(lambda *x: np.stack(x), tree, *one_bit_off))
    assert len(np.unique(hashes)) == len(hashes)
    flips = np.unpackbits((hashes[1:] ^ hashes[0]).view(np.uint8)).mean()
    assert 0.45 < flips < 0.55, "about half of the bits change with one"


def test_sampled_trees_have_text() -> None:
    rng = np.random.default_rng(4)
    trees = sample_trees(rng, num_tasks=40, **TREES)
    lines = sample_sequences(rng, level=3, num_tasks=10, num_propositions=5, max_nodes=16)
    for batch in (trees, lines):
        for m, expected in enumerate(task_hashes(batch)):
            text = tree_to_text(row(batch, m), NAMES)
            assert int(task_hash(compile_task(parse(text), NAMES, 20))) == int(expected)


@pytest.mark.parametrize("joint", [0.3, 1.0])
def test_goals_that_are_sets(joint: float) -> None:
    """Every goal is a proposition or a set that holds together, and edges near one another still differ."""
    together = np.array([[1, 1, 0, 0, 0], [1, 0, 1, 0, 0], [1, 1, 1, 0, 0]], bool)
    known = {frozenset(np.flatnonzero(label).tolist()) for label in (*together, *np.eye(5, dtype=bool))}
    how: dict[str, Any] = {"joint": joint, "together": together}
    trees = sample_trees(np.random.default_rng(0), num_tasks=500, **TREES, **how)
    counts = Counter[int]()
    for m in range(500):
        edges = np.flatnonzero(trees.valid[m] & (trees.parent[m] >= 0)).tolist()
        goals = {0: frozenset[int]()} | {
            node: frozenset(np.flatnonzero(trees.reach[m, node]).tolist()) for node in edges
        }
        assert set(goals.values()) - {frozenset()} <= known
        assert all(goals[node] != goals[int(trees.parent[m, node])] for node in edges)
        assert len({(int(trees.parent[m, node]), goals[node]) for node in edges}) == len(edges)
        counts.update(len(goals[node]) for node in edges)
    before = np.take_along_axis(trees.reach, np.maximum(trees.parent, 0)[..., None], axis=1)
    assert not (trees.avoid & (trees.reach | before)).any()
    # Two of five propositions are in no set; where all edges try, the rest fails for being like one nearby.
    share = 1 - counts[1] / counts.total()
    assert 0.65 * 0.6 * joint < share <= 0.62 * joint
    sequences = sample_sequences(
        np.random.default_rng(0), level=3, num_tasks=500, num_propositions=5, max_nodes=8, **how
    )
    assert 0.65 * 0.6 * joint < (sequences.reach[:, 1:4].sum(-1) > 1).mean() <= 0.62 * joint


def test_no_set_to_reach() -> None:
    """Without sets that hold together tasks are the same as ever."""
    plain = sample_trees(np.random.default_rng(0), num_tasks=50, **TREES)
    for together in (None, np.zeros((0, 5), bool)):
        again = sample_trees(np.random.default_rng(0), num_tasks=50, **TREES, joint=0.5, together=together)
        assert jax.tree.all(jax.tree.map(np.array_equal, plain, again))
