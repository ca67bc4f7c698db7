"""Relabelling: whatever the labels, the new task replayed on them visits exactly the completed path, when it did.

Random labels (several at once) are played on random trees by a plain-Python monitor; the rollouts that result
begin and end in the middle of episodes, and of sub-tasks.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.learning.relabel import Record, Relabelled, branch_lengths, relabel, visits
from hrlspec.spec import SATISFIED, TaskState, TaskTree, advance, initial, task_hashes
from hrlspec.tasks.rewards import Bonus, reward_machine
from hrlspec.tasks.sampling import sample_trees
from tests.probes import pairs, quick_jit, read_monitor
from tests.tasks.test_rewards import reference
from tests.trees import random_tree

LETTERS = "abcde"
RULES = [Bonus("a", "d", 5.0), Bonus("b", "e", 10.0, ("a",)), Bonus("c", "b", 2.0, ("d", "e"))]
T, SLOTS, ROLLOUTS, NUM_SAMPLED = 24, 6, 150, 500


class Setting(NamedTuple):
    max_path: int
    max_nodes: int
    conjunctions: bool
    visited: bool = False


SETTINGS = [
    Setting(max_path=4, max_nodes=16, conjunctions=False),
    Setting(max_path=3, max_nodes=9, conjunctions=True),  # room for some of each branch only
    Setting(max_path=4, max_nodes=16, conjunctions=False, visited=True),
    Setting(max_path=3, max_nodes=9, conjunctions=True, visited=True),
]
NOTHING_RESERVED = np.zeros(200, np.uint32)


def play(rng: np.random.Generator, conjunctions: bool) -> dict[str, np.ndarray]:
    """One environment's rollout: random labels, random assignments, random tasks, random ends of episodes."""
    rows: dict[str, list[Any]] = {name: [] for name in ("slot", "labels", "edge_taken", "reach", "avoid")}
    density = rng.choice([0.1, 0.3])
    horizon = int(rng.integers(3, 2 * T))
    slot, tree, time = 0, _task(rng, conjunctions), int(rng.integers(horizon))
    node, blocked = int(rng.choice(np.flatnonzero(tree.valid & ~tree.accepting))), set()
    for _ in range(T):
        edges = [k for k in range(tree.num_nodes) if tree.valid[k] and tree.parent[k] == node and k not in blocked]
        labels = rng.random(5) < density
        before = node
        node, blocked, status = read_monitor(tree, node, blocked, pairs(labels), int(rng.choice(edges)))
        rows["slot"].append(slot)
        rows["labels"].append(labels)
        rows["edge_taken"].append(node != before)
        rows["reach"].append(tree.reach[node])
        rows["avoid"].append(tree.avoid[node])
        time += 1
        if status != "running" or time >= horizon:
            slot, tree, time, node, blocked = slot + 1, _task(rng, conjunctions), 0, 0, set()
    return {name: np.array(entries) for name, entries in rows.items()}


def _task(rng: np.random.Generator, conjunctions: bool) -> TaskTree:
    if conjunctions:
        return random_tree(rng, num_nodes=8, num_propositions=5, most_together=2, distinct=True)
    row = int(rng.integers(NUM_SAMPLED))
    return jax.tree.map(lambda x: x[row], _sampled())


@functools.cache
def _sampled() -> TaskTree:
    """Tasks drawn at once, which is quicker than one by one."""
    sizes = {"num_propositions": 5, "max_nodes": 9, "min_depth": 1, "max_depth": 6, "max_branching": 3}
    return sample_trees(np.random.default_rng(0), num_tasks=NUM_SAMPLED, **sizes)


@functools.cache
def relabeller(max_path: int, max_nodes: int) -> Any:
    def one(key: jax.Array, record: Record, reserved: jax.Array, branch: float) -> Relabelled:
        machine = reward_machine(LETTERS, subtask=0.5, bonuses=RULES)
        return relabel(
            key,
            record,
            machine,
            reserved,
            num_slots=SLOTS,
            max_path=max_path,
            max_nodes=max_nodes,
            max_avoid=3,
            branch=branch,
        )

    return quick_jit(jax.vmap(one, in_axes=(0, 0, None, None)))


@functools.cache
def played(seed: int, conjunctions: bool) -> Record:
    rng = np.random.default_rng(seed)
    rollouts = [play(rng, conjunctions) for _ in range(ROLLOUTS)]
    return Record(**{name: np.stack([r[name] for r in rollouts]) for name in rollouts[0]})


@functools.cache
def relabelled(setting: Setting) -> tuple[Record, Relabelled]:
    record = played(setting.max_nodes, setting.conjunctions)
    if setting.visited:
        record = jax.tree.map(np.asarray, quick_jit(jax.vmap(visits))(record))
    keys = jax.random.split(jax.random.key(setting.max_nodes), ROLLOUTS)
    new = relabeller(setting.max_path, setting.max_nodes)(keys, record, NOTHING_RESERVED, 0.7)
    return record, jax.tree.map(np.asarray, new)


def tree_at(new: Relabelled, rollout: int, slot: int) -> TaskTree:
    return jax.tree.map(lambda x: x[rollout, slot], new.tree)


def slots_of(record: Record) -> list[tuple[int, int, np.ndarray]]:
    """Every episode: rollout, slot, its steps."""
    found = [(i, s, np.flatnonzero(record.slot[i] == s)) for i in range(ROLLOUTS) for s in range(T)]
    return [entry for entry in found if len(entry[2])]


@pytest.fixture(params=SETTINGS, ids=["16 nodes", "conjunctions", "visits", "visits, conjunctions"])
def setting(request: pytest.FixtureRequest) -> Setting:
    return request.param


def test_the_sample_is_rich(setting: Setting) -> None:
    record, new = relabelled(setting)
    assert (record.labels.sum(-1) > 1).mean() > 0.05
    assert (record.slot.max(-1) >= SLOTS).any()  # episodes beyond the last slot
    assert 0.2 < new.valid.mean() < 0.95
    done = [int(record.edge_taken[i][steps].sum()) for i, _, steps in slots_of(record)]
    assert max(done) > setting.max_path or setting.conjunctions  # longer than any path
    assert len(set(done)) > 3


def test_the_monitor_visits_the_recorded_path_at_the_recorded_times(setting: Setting) -> None:
    """Whether it is told which edge is pursued or not: no other edge is ever met first."""
    record, new = relabelled(setting)
    checked = 0
    for i, slot, steps in slots_of(record):
        if slot >= SLOTS:
            assert not new.valid[i, steps].any()
            continue
        tree, node, blocked, status = tree_at(new, i, slot), 0, set(), "running"
        length = min(int(record.edge_taken[i, steps].sum()), setting.max_path)
        place = 0
        for t in steps:
            assert new.valid[i, t] == (place < length)
            if not new.valid[i, t]:
                assert length == 0 or status == "satisfied"
                continue
            assert status == "running"
            assert (new.node[i, t], new.assigned[i, t]) == (node, place + 1)
            labels = pairs(record.labels[i, t])
            free = read_monitor(tree, node, blocked, labels, TaskTree.NO_NODE)
            before = node
            node, blocked, status = read_monitor(tree, node, blocked, labels, int(new.assigned[i, t]))
            assert free == (node, blocked, status)
            assert (node != before) == record.edge_taken[i, t]
            if node != before:
                assert node == before + 1  # the path is rows 1, 2, ...
                place += 1
                np.testing.assert_array_equal(tree.reach[node], record.reach[i, t])
                np.testing.assert_array_equal(tree.avoid[node], record.avoid[i, t])
            assert new.terminated[i, t] == (status == "satisfied") == (place == length)
            checked += 1
    assert checked > 500


def test_the_jitted_monitor_agrees(setting: Setting) -> None:
    record, new = relabelled(setting)

    def replay(trees: TaskTree, slot: jax.Array, labels: jax.Array, assigned: jax.Array) -> TaskState:
        def step(carry: tuple[TaskState, jax.Array], x: tuple[jax.Array, ...]) -> Any:
            state, last = carry
            slot, labels, assigned = x
            tree = jax.tree.map(lambda a: a[jnp.minimum(slot, SLOTS - 1)], trees)
            state = jax.tree.map(lambda new, old: jnp.where(slot != last, new, old), initial(tree), state)
            after = advance(tree, state, labels, assigned)
            return (after, slot), (state.node, after.node, after.status)

        start = initial(jax.tree.map(lambda a: a[0], trees)), jnp.int32(-1)
        return jax.lax.scan(step, start, (slot, labels, assigned))[1]

    before, after, status = quick_jit(jax.vmap(replay))(new.tree, record.slot, record.labels, new.assigned)
    valid = new.valid
    np.testing.assert_array_equal(np.asarray(before)[valid], new.node[valid])
    np.testing.assert_array_equal((np.asarray(after) != before)[valid], record.edge_taken[valid])
    np.testing.assert_array_equal((np.asarray(status) == SATISFIED)[valid], new.terminated[valid])


def test_rewards_are_recomputed(setting: Setting) -> None:
    record, new = relabelled(setting)
    paid = 0.0
    for i, _, steps in slots_of(record):
        mine = steps[new.valid[i, steps]]
        taken = record.edge_taken[i, mine]
        ends = new.terminated[i, mine]
        expected = reference(RULES, 1.0, 0.5, record.labels[i, mine], record.reach[i, mine], taken, ends)
        np.testing.assert_allclose(new.reward[i, mine], expected)
        assert not new.reward[i, steps[~new.valid[i, steps]]].any()
        paid += sum(expected)
    assert paid > 100


def test_decisions_are_due_at_the_start_and_after_each_sub_task(setting: Setting) -> None:
    record, new = relabelled(setting)
    for i, _, steps in slots_of(record):
        due = [bool(new.valid[i, t] and (t == steps[0] or record.edge_taken[i, t - 1])) for t in steps]
        assert new.decided[i, steps].tolist() == due


def test_trees_are_well_formed_and_follow_the_samplers_rules(setting: Setting) -> None:
    record, new = relabelled(setting)
    branches, sizes = 0, set()
    for i, slot, steps in slots_of(record):
        length = min(int(record.edge_taken[i, steps].sum()), setting.max_path)
        if slot >= SLOTS or not length:
            continue
        tree = tree_at(new, i, slot)
        nodes = np.flatnonzero(tree.valid)
        children = {k: [j for j in nodes if tree.parent[j] == k] for k in nodes}
        assert tree.parent[0] == TaskTree.NO_NODE
        assert not tree.reach[0].any()
        assert not tree.avoid[0].any()
        assert tree.depth[0] == 0
        padding = ~tree.valid
        assert (tree.parent[padding] == TaskTree.NO_NODE).all()
        assert not (tree.reach[padding].any())
        assert not (tree.avoid[padding].any())
        assert not (tree.accepting[padding].any())
        assert not tree.depth[padding].any()
        for k in nodes:
            assert tree.accepting[k] == (not children[k])
            goals = [tuple(tree.reach[j]) for j in children[k]]
            assert len(set(goals)) == len(goals) <= 2
        for k in nodes[1:]:
            parent = tree.parent[k]
            assert 0 <= parent < k
            assert tree.valid[parent]
            assert tree.depth[k] == tree.depth[parent] + 1
            if k <= setting.max_path:
                continue
            branches += 1
            goal, before, avoid = pairs(tree.reach[k]), pairs(tree.reach[parent]), pairs(tree.avoid[k])
            assert len(goal) == 1
            assert not goal & before
            assert not avoid & (goal | before)
            sizes.add(len(avoid))
        assert set(range(length + 1)) <= set(nodes)
        assert not set(range(length + 1, setting.max_path + 1)) & set(nodes)
        assert max(tree.depth[nodes]) == length  # a branch is no longer than what remains of the path beside it
    assert branches > 100
    assert sizes == {0, 1, 2, 3} if not setting.conjunctions else sizes >= {0, 1, 2}


def test_reserved_tasks_are_never_produced() -> None:
    setting = SETTINGS[0]
    record, new = relabelled(setting)
    slots = [(i, s, steps) for i, s, steps in slots_of(record) if s < SLOTS and new.valid[i, steps].any()]
    hashes = {(i, s): int(task_hashes(jax.tree.map(lambda x: x[None], tree_at(new, i, s)))[0]) for i, s, _ in slots}
    reserved = np.unique(list(hashes.values()))[::2].astype(np.uint32)[: len(NOTHING_RESERVED)]
    reserved = np.pad(reserved, (0, len(NOTHING_RESERVED) - len(reserved)), "edge")
    keys = jax.random.split(jax.random.key(setting.max_nodes), ROLLOUTS)
    again = jax.tree.map(np.asarray, relabeller(setting.max_path, setting.max_nodes)(keys, record, reserved, 0.7))
    kept = 0
    for i, slot, steps in slots:
        if hashes[i, slot] in reserved:
            for flags in (again.valid, again.decided, again.terminated, again.reward):
                assert not flags[i, steps].any()
        else:
            kept += 1
            np.testing.assert_array_equal(again.valid[i, steps], new.valid[i, steps])
    assert kept > 20
    assert len(slots) - kept > 20


def test_visits_in_hindsight() -> None:
    """By hand: b by chance, c on purpose while avoiding a, again c (not new), d and e at once, then another episode."""
    seen = ["", "b", "b", "", "c", "c", "", "c", "de", "e", "a"]
    labels = np.array([[letter in step for letter in LETTERS] for step in seen])
    taken = np.arange(len(seen)) == 4
    reach, avoid = (labels & taken[:, None]), np.zeros_like(labels)
    avoid[4] = [True, False, False, False, False]
    slot = np.array([0] * 10 + [1], np.int32)
    found = visits(Record(slot=slot, labels=labels, edge_taken=taken, reach=reach, avoid=avoid))
    goals = ["".join(letter for letter, wanted in zip(LETTERS, row, strict=True) if wanted) for row in found.reach]
    assert goals == ["", "b", "", "", "c", "", "", "", "d", "", "a"]
    np.testing.assert_array_equal(found.edge_taken, found.reach.any(-1))
    np.testing.assert_array_equal(found.avoid, avoid)
    forbidden = avoid.copy()
    forbidden[4, 1] = True  # b was met before: as a sub-task of its own it would have been violated
    again = visits(Record(slot=slot, labels=labels, edge_taken=taken, reach=reach, avoid=forbidden))
    assert not again.avoid.any()


@pytest.mark.parametrize("branch", [0, 1])
def test_branch_probability(branch: int) -> None:
    setting = SETTINGS[0]
    # b is reached at 1, d at 3, alone on their ways.
    labels = np.zeros((ROLLOUTS, T, 5), bool)
    labels[:, 1, 1] = labels[:, 3, 3] = True
    slot = np.repeat(np.where(np.arange(T) < 4, 0, 1)[None], ROLLOUTS, 0)
    record = Record(slot=slot, labels=labels, edge_taken=labels.any(-1), reach=labels, avoid=labels & False)
    keys = jax.random.split(jax.random.key(0), ROLLOUTS)
    new = relabeller(setting.max_path, setting.max_nodes)(keys, record, NOTHING_RESERVED, float(branch))
    parent = np.asarray(new.tree.parent)[:, 0]
    for node in (0, 1):
        np.testing.assert_array_equal((parent == node).sum(-1), 1 + branch)
    if branch:
        depth = np.asarray(new.tree.depth)[:, 0].max(-1)
        assert (depth == 2).all()
        lengths = np.asarray(new.tree.valid)[:, 0].sum(-1) - 3
        assert set(lengths.tolist()) == {2, 3}  # 1 or 2 beside b, 1 beside d


def test_branch_lengths_fill_the_room() -> None:
    assert branch_lengths(4, 16).tolist() == [4, 3, 2, 1]
    assert branch_lengths(4, 5).tolist() == [0, 0, 0, 0]
    for path in range(1, 7):
        for nodes in range(path + 1, 30):
            lengths = branch_lengths(path, nodes)
            assert (lengths <= path - np.arange(path)).all()
            assert 1 + path + lengths.sum() <= nodes
    with pytest.raises(ValueError, match="path of 4 sub-tasks needs 5 nodes, max_nodes is 4"):
        branch_lengths(4, 4)


@pytest.mark.parametrize(("max_path", "max_nodes"), [(4, 5), (3, 6), (1, 2), (1, 3)])
def test_little_or_no_room_for_branches(max_path: int, max_nodes: int) -> None:
    rng = np.random.default_rng(0)
    rollouts = [play(rng, False) for _ in range(2)]
    record = Record(**{name: np.stack([r[name] for r in rollouts]) for name in rollouts[0]})
    keys = jax.random.split(jax.random.key(0), 2)
    shapes = jax.eval_shape(relabeller(max_path, max_nodes), keys, record, NOTHING_RESERVED, 0.7)
    assert shapes.tree.reach.shape == (2, SLOTS, max_nodes, 5)
