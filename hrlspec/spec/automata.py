"""Tasks as automata, inside the jit: the states of all of them are rows of one table, each with a task tree.

A state is what a row of a book of tasks is: when an automaton moves, its task goes on as another one. What the tree
says of blocked edges and of the order of sub-tasks does not count: the automaton rules. Where it leaves a choice, which
sub-task the agent pursues decides.

Axes: **R** states of all automata, **L** labels, **M** automata, **P** atomic propositions.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Int32

from envs_jax.arrays import Array
from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.monitor import RUNNING, SATISFIED, VIOLATED
from hrlspec.spec.tree import TaskTree
from hrlspec.spec.unfold import Unfolded, unfold

MAX_PROPOSITIONS = 16
"""Most propositions of an environment: labels are looked up in a table of all sets of them."""


@struct.dataclass
class Automata:
    """M tasks as automata over the same propositions and labels, state by state.

    Attributes:
        trees: what the agent is shown in each state, leading axis R.
        successors: int32 ``[R, L]``, the row that each label leads to.
        status: int32 ``[R]``, ``RUNNING``, ``SATISFIED`` or ``VIOLATED``.
        accepts: bool ``[R, L]``, the accepting transitions of tasks that go on for ever.
        column: int32 ``[2^P]``, which label a set of propositions is, bit i for proposition i; -1 for one that cannot
            occur.
        start: int32 ``[M]``, the row where each task begins.
        origin: int32 ``[R, N]``, the row that reads what meets each edge: the row itself, unless the edge begins with a
            jump; see `hrlspec.spec.unfold.Unfolded`.
    """

    trees: TaskTree
    successors: Int32[Array, "R L"]
    status: Int32[Array, " R"]
    accepts: Bool[Array, "R L"]
    column: Int32[Array, " _"]
    start: Int32[Array, " M"]
    origin: Int32[Array, "R N"]

    def advance(
        self, row: Int32[Array, ""], labels: Bool[Array, " P"], edge: Int32[Array, ""] | int = TaskTree.NO_NODE
    ) -> tuple[Int32[Array, ""], Bool[Array, ""]]:
        """See `advance`; a jump is taken where the edge that is assigned begins with one, is met, and violates nothing.

        Args:
            row: int32 ``[]``, where a task stands.
            labels: bool ``[P]``, the propositions that hold now.
            edge: int32 ``[]``, the edge that is assigned.
        """
        tables = self.successors, self.accepts, self.column
        stays = advance(*tables, row, labels)
        jumps = advance(*tables, jnp.asarray(self.origin)[row, edge], labels)
        met = (edge != TaskTree.NO_NODE) & (labels | ~jnp.asarray(self.trees.reach)[row, edge]).all()
        taken = met & (jnp.asarray(self.status)[jumps[0]] != VIOLATED)
        return jnp.where(taken, jumps[0], stays[0]), jnp.where(taken, jumps[1], stays[1])

    def padded(self, num_rows: int) -> Automata:
        """The same with ``num_rows`` rows, numpy leaves: copies of the last one are added, which nothing leads to."""
        missing = num_rows - len(self.status)

        def pad(x: Array) -> np.ndarray:
            return np.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1), mode="edge")

        rows = {name: getattr(self, name) for name in ("trees", "successors", "status", "accepts", "origin")}
        return Automata(**jax.tree.map(pad, rows), column=self.column, start=self.start)


def advance(
    successors: Int32[Array, "R L"],
    accepts: Bool[Array, "R L"],
    column: Int32[Array, " _"],
    row: Int32[Array, ""],
    labels: Bool[Array, " P"],
) -> tuple[Int32[Array, ""], Bool[Array, ""]]:
    """One step; a set of propositions that cannot occur changes nothing.

    Args:
        successors: see `Automata`.
        accepts: see `Automata`.
        column: see `Automata`.
        row: int32 ``[]``, where a task stands.
        labels: bool ``[P]``, the propositions that hold now.

    Returns:
        The row after it, and whether an accepting transition led there, bool ``[]``.
    """
    bits = 2 ** jnp.arange(labels.shape[0], dtype=jnp.int32)
    label = jnp.asarray(column)[(labels * bits).sum(dtype=jnp.int32)]
    known, at = label >= 0, (row, jnp.maximum(label, 0))
    return jnp.where(known, jnp.asarray(successors)[at], row), known & jnp.asarray(accepts)[at]


def automata_of(
    automata: Sequence[Automaton],
    propositions: Sequence[str],
    max_nodes: int,
    *,
    trees: Sequence[TaskTree] | None = None,
) -> tuple[Automata, Bool[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
    """Puts automata together for acting.

    Args:
        automata: M of them, over the same labels in the same order.
        propositions: names of the P propositions, in the order of an environment's labels.
        max_nodes: N, padded size of the trees.
        trees: what is shown in the states of each, leading axis Q, if not what `unfold` makes of them: see
            `hrlspec.spec.readings.monitor_automaton`.

    Returns:
        The automata; and, bool ``[M]``, of which some tree was cut, and in which a way on begins where nothing holds.

    Raises:
        ValueError: there are too many propositions, or the labels differ.
    """
    if len(propositions) > MAX_PROPOSITIONS:
        raise ValueError(f"found {len(propositions)} propositions, automata take {MAX_PROPOSITIONS} at most")
    labels = automata[0].labels
    if any(automaton.labels != labels for automaton in automata):
        raise ValueError("the automata are over different labels")
    if trees is None:
        unfolded = [unfold(automaton, propositions, max_nodes) for automaton in automata]
    else:
        unfolded = [_as_shown(shown) for shown in trees]
    sizes = np.array([automaton.num_states for automaton in automata])
    start = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    status = np.full(sizes.sum(), RUNNING, np.int32)
    for first, automaton in zip(start, automata, strict=True):
        for state, value in ((automaton.accepting, SATISFIED), (automaton.rejecting, VIOLATED)):
            if state is not None:
                status[first + state] = value
    successors = [first + automaton.successors for first, automaton in zip(start, automata, strict=True)]
    origin = [first + one.origin for first, one in zip(start, unfolded, strict=True)]
    leaves: dict[str, Any] = {
        "trees": jax.tree.map(lambda *x: np.concatenate(x), *(one.trees for one in unfolded)),
        "successors": np.concatenate(successors).astype(np.int32),
        "status": status,
        "accepts": np.concatenate(
            [np.zeros(some.successors.shape, bool) if some.marks is None else some.marks for some in automata]
        ),
        "column": _columns(labels, propositions),
        "start": start.astype(np.int32),
        "origin": np.concatenate(origin).astype(np.int32),
    }
    return (
        Automata(**leaves),
        np.array([one.cut.any() for one in unfolded]),
        np.array([one.silent.any() for one in unfolded]),
    )


def _as_shown(trees: TaskTree) -> Unfolded:
    """Of trees that were given: nothing is left out, and nothing begins with a jump."""
    nothing = np.zeros(1, bool)
    own = np.arange(len(trees.parent), dtype=np.int32)[:, None]
    return Unfolded(trees, nothing, nothing, np.repeat(own, trees.parent.shape[1], 1))


def _columns(labels: Iterable[Collection[str]], propositions: Sequence[str]) -> Int32[np.ndarray, " _"]:
    """Which label each set of propositions is, int32 ``[2^P]``."""
    bit = {name: 1 << i for i, name in enumerate(propositions)}
    column = np.full(1 << len(propositions), -1, np.int32)
    for number, label in enumerate(labels):
        column[sum(bit[name] for name in label)] = number
    return column
