"""Experience relabelling: a trajectory becomes the record of another, random task (paper, "Experience Replay").

The sub-tasks an episode completed become the path of a new tree; random branches are added along it so that
the recorded labels, replayed through the monitor on the new tree, visit exactly that path at the recorded times.

Axes: **T** time steps, **S** episodes (slots) of one environment's rollout, **K** sub-tasks of a path, **N** tree
nodes, **P** atomic propositions.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float32, Int32, Key, Shaped, UInt32

from envs_jax.arrays import Array
from hrlspec.spec import TaskTree, task_hash
from hrlspec.tasks import rewards
from hrlspec.tasks.rewards import RewardMachine


@struct.dataclass
class Record:
    """What relabelling needs of one environment's rollout.

    Attributes:
        slot: int32 ``[T]``, which episode of the rollout the step belongs to.
        labels: bool ``[T, P]``, labels of the state after the step.
        edge_taken: bool ``[T]``, the step completed a sub-task.
        reach: bool ``[T, P]``, what the edge taken reaches.
        avoid: bool ``[T, P]``, its ``ensuring`` part.
    """

    slot: Int32[Array, "*lead T"]
    labels: Bool[Array, "*lead T P"]
    edge_taken: Bool[Array, "*lead T"]
    reach: Bool[Array, "*lead T P"]
    avoid: Bool[Array, "*lead T P"]

    @property
    def first(self) -> Bool[Array, " T"]:
        """Whether the step is the first of its episode in the rollout, bool ``[T]``."""
        return jnp.concatenate([jnp.ones(1, bool), self.slot[1:] != self.slot[:-1]])


@struct.dataclass
class Relabelled:
    """The same rollout as a record of other tasks.

    Attributes:
        tree: the new tasks, leading axis S; nodes 1, 2, ... are the completed path.
        path_length: int32 ``[S]``, sub-tasks on that path.
        node: int32 ``[T]``, node of the new task before the step.
        assigned: int32 ``[T]``, the edge pursued: the next one of the path.
        decided: bool ``[T]``, a decision is due before the step.
        reward: float32 ``[T]``.
        terminated: bool ``[T]``, the step satisfied the new task.
        valid: bool ``[T]``, the step belongs to the new task; later ones do not.
    """

    tree: TaskTree
    path_length: Int32[Array, " S"]
    node: Int32[Array, " T"]
    assigned: Int32[Array, " T"]
    decided: Bool[Array, " T"]
    reward: Float32[Array, " T"]
    terminated: Bool[Array, " T"]
    valid: Bool[Array, " T"]


def visits(record: Record) -> Record:
    """The same rollout with whatever was visited as a completed sub-task, in hindsight (Andrychowicz et al., 2017).

    A sub-task is completed wherever a proposition holds for the first time since the last one was; it keeps its
    ``ensuring`` part where it was the one assigned. Goals that were not assigned are learned as well, so that regions
    visited rarely have samples.
    """

    def step(seen: Bool[Array, " P"], inputs: tuple[Array, ...]) -> tuple[Bool[Array, " P"], tuple[Array, ...]]:
        labels, taken, reach, avoid, first = inputs
        seen = seen & ~first
        new = labels & ~seen
        intended = taken & (reach & new).any() & ~(avoid & (seen | labels)).any()
        found = jnp.arange(labels.shape[0], dtype=jnp.int32) == jnp.argmax(new)
        goal = jnp.where(intended, reach, found) & new.any()
        return jnp.where(new.any(), labels, seen), (new.any(), goal, avoid & intended)

    inputs = (record.labels, record.edge_taken, record.reach, record.avoid, record.first)
    taken, reach, avoid = jax.lax.scan(step, jnp.zeros(record.labels.shape[1:], bool), inputs)[1]
    return Record(slot=record.slot, labels=record.labels, edge_taken=taken, reach=reach, avoid=avoid)


def relabel(
    key: Key[Array, ""],
    record: Record,
    machine: RewardMachine,
    reserved: UInt32[Array, " M"],
    *,
    num_slots: int,
    max_path: int,
    max_nodes: int,
    max_avoid: int,
    branch: float | Float32[Array, ""],
) -> Relabelled:
    """Relabels one environment's rollout; ``vmap`` for more.

    An episode without a completed sub-task, one beyond ``num_slots``, and a new task whose hash is
    reserved for evaluation are marked invalid.

    Args:
        key: consumed.
        record: the rollout.
        machine: the rewards to recompute; bonus rules start anew with each new task.
        reserved: uint32 ``[M]``, sorted hashes of held-out tasks.
        num_slots: S.
        max_path: K, the longest path kept.
        max_nodes: N of the new trees; branches are shortened to fit.
        max_avoid: largest random ``ensuring`` part of a branch's edge.
        branch: probability of a branch at each node of the path.
    """
    done_before = _completed_before(record)
    path = _path(record, done_before, num_slots, max_path)
    tree = jax.vmap(
        lambda k, *p: _grow(k, *p, max_nodes=max_nodes, max_avoid=max_avoid, branch=branch),
    )(jax.random.split(key, num_slots), *path)
    length = path[0]
    held_out = jnp.isin(jax.vmap(task_hash)(tree), reserved) if reserved.shape[0] else jnp.zeros(num_slots, bool)

    slot = jnp.minimum(record.slot, num_slots - 1)
    valid = (record.slot < num_slots) & ~held_out[slot] & (done_before < length[slot])
    decided = valid & (record.first | jnp.concatenate([jnp.zeros(1, bool), record.edge_taken[:-1]]))
    terminated = valid & record.edge_taken & (done_before + 1 == length[slot])

    def pay(rules: Int32[Array, " R"], step: tuple[Array, ...]) -> tuple[Int32[Array, " R"], Float32[Array, ""]]:
        labels, reached, taken, completed, first = step
        rules = jnp.where(first, rewards.initial(machine), rules)
        return rewards.step(machine, rules, labels, reached, taken, completed)

    steps = (record.labels, record.reach, record.edge_taken & valid, terminated, record.first)
    reward = jax.lax.scan(pay, rewards.initial(machine), steps)[1]
    return Relabelled(
        tree=tree,
        path_length=length,
        node=jnp.where(valid, done_before, 0),
        assigned=jnp.where(valid, done_before + 1, 0),
        decided=decided,
        reward=reward * valid,
        terminated=terminated,
        valid=valid,
    )


def _completed_before(record: Record) -> Int32[Array, " T"]:
    """How many sub-tasks its episode had completed before each step, int32 ``[T]``."""
    total = jnp.cumsum(record.edge_taken) - record.edge_taken
    return (total - jax.lax.cummax(jnp.where(record.first, total, 0))).astype(jnp.int32)


def _path(
    record: Record, done_before: Int32[Array, " T"], num_slots: int, max_path: int
) -> tuple[Int32[Array, " S"], Bool[Array, "S K P"], Bool[Array, "S K P"], Bool[Array, "S K P"]]:
    """The completed path of each slot: length ``[S]``, reach, avoid and the labels seen along it, ``[S, K, P]``."""
    num_propositions = record.labels.shape[-1]
    empty = jnp.zeros((num_slots, max_path, num_propositions), jnp.int32)
    slot, place = record.slot, done_before
    seen = empty.at[slot, place].max(record.labels.astype(jnp.int32), mode="drop") > 0
    taken_place = jnp.where(record.edge_taken, place, max_path)
    reach = empty.at[slot, taken_place].set(record.reach.astype(jnp.int32), mode="drop") > 0
    avoid = empty.at[slot, taken_place].set(record.avoid.astype(jnp.int32), mode="drop") > 0
    length = jnp.zeros(num_slots, jnp.int32).at[slot].add(record.edge_taken.astype(jnp.int32), mode="drop")
    return jnp.minimum(length, max_path), reach, avoid, seen


def branch_lengths(max_path: int, max_nodes: int) -> np.ndarray:
    """Longest branch at each node of the path, int ``[K]``: K - i, shortened alike until everything fits N nodes.

    What room is left then goes to the first of those that were shortened, a node each.

    Raises:
        ValueError: if not even the path fits.
    """
    room = max_nodes - 1 - max_path
    if room < 0:
        raise ValueError(f"a path of {max_path} sub-tasks needs {max_path + 1} nodes, max_nodes is {max_nodes}")
    full = max_path - np.arange(max_path)
    cap = max(c for c in range(max_path + 1) if np.minimum(full, c).sum() <= room)
    lengths = np.minimum(full, cap)
    shortened = np.flatnonzero(lengths < full)
    lengths[shortened[: room - lengths.sum()]] += 1
    return lengths


def _grow(
    key: Key[Array, ""],
    length: Int32[Array, ""],
    path_reach: Bool[Array, "K P"],
    path_avoid: Bool[Array, "K P"],
    seen: Bool[Array, "K P"],
    *,
    max_nodes: int,
    max_avoid: int,
    branch: float | Float32[Array, ""],
) -> TaskTree:
    """One tree around a completed path.

    Nodes 0..K are the path; then, for each node of the path, a fixed run of places for its branch. The first
    goal of the branch at node i is none of the labels seen while sub-task i was under way.
    """
    max_path, num_propositions = path_reach.shape
    longest = branch_lengths(max_path, max_nodes)
    rounds = max(1, *longest)  # One at least, so that there is something to gather nothing from where no branch fits.
    num_places = int(longest.sum())
    shapes = ((2, max_path), (rounds, max_path, num_propositions), (num_places, num_propositions + 1))
    sizes = [math.prod(shape) for shape in shapes]
    # One draw for everything: each takes longer to compile than what is done with it.
    drawn = jnp.split(jax.random.uniform(key, (sum(sizes),), jnp.float32), np.cumsum(sizes)[:-1])
    chance, lottery, noise = (x.reshape(shape) for x, shape in zip(drawn, shapes, strict=True))

    place = np.arange(max_path)
    grows = (chance[0] < branch) & (place < length)
    limit = jnp.minimum(length - place, longest).astype(jnp.int32)
    wanted = jnp.floor(chance[1] * limit).astype(jnp.int32) + 1
    wanted = jnp.where(grows, jnp.minimum(wanted, limit), 0)

    # The branches, place by place along the path, as rows after the path's own.
    owner = np.repeat(place, longest)
    offset = np.concatenate([np.arange(n) for n in longest])
    goal, exists, taboo = (x[offset, owner] for x in _branches(lottery, wanted, path_reach, seen))
    ends = exists & ~jnp.append(exists & (offset > 0), False)[1:]
    avoid = jax.vmap(lambda n, f: _random_avoid(n, f, max_avoid))(noise, taboo) & exists[:, None]

    first = max_path + 1 + np.concatenate([[0], np.cumsum(longest)])[owner]
    parent = np.where(offset, first + offset - 1, owner)
    padding = max_nodes - 1 - max_path - len(owner)
    nothing = jnp.zeros((1, num_propositions), bool)
    valid = jnp.concatenate([jnp.ones(1, bool), place < length, exists, jnp.zeros(padding, bool)])

    def rows(*parts: Any) -> Shaped[Array, "..."]:
        x = jnp.concatenate([jnp.asarray(part) for part in parts])
        x = jnp.pad(x, ((0, padding),) + ((0, 0),) * (x.ndim - 1))
        return jnp.where(valid.reshape((-1,) + (1,) * (x.ndim - 1)), x, 0).astype(x.dtype)

    return TaskTree(
        parent=jnp.where(valid, rows(np.full(1, TaskTree.NO_NODE), place, parent), TaskTree.NO_NODE).astype(jnp.int32),
        reach=rows(nothing, path_reach, goal),
        avoid=rows(nothing, path_avoid, avoid),
        accepting=rows(np.zeros(1, bool), place + 1 == length, ends),
        valid=valid,
        depth=rows(np.zeros(1, np.int32), place + 1, owner + 1 + offset).astype(jnp.int32),
    )


def _branches(
    lottery: Float32[Array, "J K P"],
    wanted: Int32[Array, " K"],
    path_reach: Bool[Array, "K P"],
    seen: Bool[Array, "K P"],
) -> tuple[Bool[Array, "J K P"], Bool[Array, "J K"], Bool[Array, "J K P"]]:
    """A branch at each node of the path, sub-task by sub-task: goals, whether they exist, and what they cannot avoid.

    The first goal is none of the labels seen, of what was reached before and of what the path reaches; no goal is the
    one before it.
    """
    num_propositions = path_reach.shape[1]
    before = jnp.concatenate([jnp.zeros((1, num_propositions), bool), path_reach[:-1]])
    excluded, exists = seen | before | path_reach, jnp.ones(path_reach.shape[0], bool)
    reach, alive, forbidden = [], [], []
    for j in range(lottery.shape[0]):
        exists = exists & (j < wanted) & ~excluded.all(-1)
        choice = jnp.argmax(jnp.where(excluded, -1.0, lottery[j]), -1)
        goal = (jnp.arange(num_propositions, dtype=jnp.int32) == choice[:, None]) & exists[:, None]
        reach.append(goal)
        alive.append(exists)
        forbidden.append(goal | before)
        excluded = before = goal
    return jnp.stack(reach), jnp.stack(alive), jnp.stack(forbidden)


def _random_avoid(noise: Float32[Array, " P_and_1"], forbidden: Bool[Array, " P"], max_avoid: int) -> Bool[Array, " P"]:
    """At most ``max_avoid`` (and P - 2) random propositions outside ``forbidden``, bool ``[P]``; uniform size."""
    num_propositions = forbidden.shape[0]
    most = max(0, min(max_avoid, num_propositions - 2))
    size = jnp.floor(noise[-1] * (most + 1)).astype(jnp.int32)
    score = jnp.where(forbidden, -1.0, noise[:-1])
    rank = (score[None, :] > score[:, None]).sum(-1)
    return (rank < size) & ~forbidden
