"""LTL tasks for the adapters of `envs_jax`: translated from text into automata, which labels advance.

Axes: **S** states (padded), **L** labels, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Int32

from envs_jax.adapters.tasks import Verdict
from envs_jax.arrays import Array
from hrlspec.spec import RUNNING, SATISFIED, SpecError, subtasks
from hrlspec.spec.automata import Automata, advance, automata_of
from hrlspec.spec.ltl import Automaton, parse_ltl, to_automaton, to_buchi
from hrlspec.tasks.text_tasks import STATUS, shown

SHOWN_NODES = 64
"""Nodes of the trees that sub-tasks are described from; the first edges of all short paths are among them."""


@struct.dataclass
class LtlTask:
    """An automaton for stepping, padded to S states.

    Attributes:
        successors: int32 ``[S, L]``.
        status: int32 ``[S]``.
        accepts: bool ``[S, L]``, accepting transitions of a task that goes on for ever.
        column: int32 ``[2^P]``, see `hrlspec.spec.automata.Automata`.
    """

    successors: Int32[Array, "*lead S L"]
    status: Int32[Array, "*lead S"]
    accepts: Bool[Array, "*lead S L"]
    column: Int32[Array, "*lead _"]


@struct.dataclass
class LtlProgress:
    """Progress of a task.

    Attributes:
        state: int32 ``[]``, of the automaton.
        status: int32 ``[]``, what the state says of the task.
        rounds: int32 ``[]``, accepting transitions so far.
    """

    state: Int32[Array, "*lead"]
    status: Int32[Array, "*lead"]
    rounds: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class LtlTasks:
    """The task language of the adapters (`envs_jax.adapters.tasks.Tasks`): tasks are formulas in LTL.

    The reward is 1 on completing the task, or each round of one that goes on for ever, and 0 otherwise; an episode
    terminates when the task is satisfied or violated.

    Attributes:
        propositions: names of the environment's P propositions.
        labels: the L sets of them that can hold together.
        forever: whether rounds count, instead of satisfaction by the end of the episode.
        max_states: S, the padded size of an automaton; larger ones are refused.
        completion: the reward.
    """

    propositions: tuple[str, ...]
    labels: tuple[frozenset[str], ...]
    forever: bool = False
    max_states: int = 64
    completion: float = 1.0

    def read(self, text: str) -> LtlTask:
        """The padded automaton of a formula, numpy leaves.

        Raises:
            SpecError: if the text is no formula, names unknown propositions, needs more than S states, or leaves it
                to the agent when something begins to hold for ever, which no action says.
        """
        table = _read(text, self)[1].padded(self.max_states)
        return LtlTask(table.successors, table.status, table.accepts, table.column)

    def start(self, task: LtlTask) -> LtlProgress:
        """In the initial state; the labels of the first observation do not count."""
        return LtlProgress(state=jnp.int32(0), status=jnp.asarray(task.status)[0], rounds=jnp.int32(0))

    def advance(self, task: LtlTask, progress: LtlProgress, labels: Bool[Array, " P"]) -> tuple[LtlProgress, Verdict]:
        """One step of the automaton."""
        state, accepted = advance(task.successors, task.accepts, task.column, progress.state, labels)
        running = progress.status == RUNNING
        state, accepted = jnp.where(running, state, progress.state), running & accepted
        status = jnp.asarray(task.status)[state]
        satisfied = status == SATISFIED
        paid = accepted | (running & satisfied)
        verdict = Verdict(
            reward=jnp.where(paid, jnp.float32(self.completion), 0.0), ended=status != RUNNING, success=satisfied
        )
        return LtlProgress(state=state, status=status, rounds=progress.rounds + accepted), verdict

    def describe(self, text: str, progress: LtlProgress) -> dict[str, Any]:
        """What ``info`` shows of a task.

        Returns:
            ``status`` (``"running"``, ``"satisfied"`` or ``"violated"``), ``state`` (int, of the automaton),
            ``subtasks`` (tuple of SPECTRL texts, the sub-tasks by which it moves on; none when the task has ended),
            ``rounds`` (int) and ``success`` (bool).
        """
        state, status = int(progress.state), int(progress.status)
        return {
            "status": STATUS[status],
            "state": state,
            "subtasks": _subtasks(text, self)[state] if status == RUNNING else (),
            "rounds": int(progress.rounds),
            "success": status == SATISFIED,
        }


@functools.lru_cache(maxsize=4096)
def _read(text: str, language: LtlTasks) -> tuple[Automaton, Automata]:
    translate = to_buchi if language.forever else to_automaton
    automaton = translate(parse_ltl(text), language.propositions, language.labels)
    if automaton.jumps:
        raise SpecError("from when on something holds for ever is for the agent to say, and no action says it")
    if automaton.num_states > language.max_states:
        raise SpecError(f"the automaton has {automaton.num_states} states, at most {language.max_states} are taken")
    return automaton, automata_of([automaton], language.propositions, SHOWN_NODES)[0]


@functools.lru_cache(maxsize=4096)
def _subtasks(text: str, language: LtlTasks) -> tuple[tuple[str, ...], ...]:
    """For each state the sub-tasks of its tree, as text."""
    automaton, table = _read(text, language)
    trees = [jax.tree.map(lambda x, state=state: x[state], table.trees) for state in range(automaton.num_states)]
    return tuple(tuple(shown(subtask) for subtask in subtasks(tree, 0, language.propositions)) for tree in trees)
