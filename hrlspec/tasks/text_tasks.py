"""SPECTRL tasks for the adapters of `envs_jax`: parsed from text, advanced by the monitor and the reward machine.

Axes: **N** tree nodes, **P** atomic propositions, **R** bonus rules.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Int32

from envs_jax.adapters.tasks import Verdict
from envs_jax.arrays import Array
from hrlspec.spec import (
    RUNNING,
    SATISFIED,
    VIOLATED,
    TaskState,
    TaskTree,
    advance,
    compile_task,
    initial,
    parse,
    subtasks,
)
from hrlspec.spec.subtasks import Subtask
from hrlspec.tasks import rewards
from hrlspec.tasks.rewards import Bonus, RewardMachine, check_bonuses, reward_machine

STATUS = {RUNNING: "running", SATISFIED: "satisfied", VIOLATED: "violated"}


@struct.dataclass
class TextProgress:
    """Progress of a task.

    Attributes:
        task: state of the monitor.
        rules: int32 ``[R]``, state of the bonus rules.
    """

    task: TaskState
    rules: Int32[Array, "*lead R"]


@dataclasses.dataclass(frozen=True)
class TextTasks:
    """The task language of the adapters (`envs_jax.adapters.tasks.Tasks`): tasks are SPECTRL text.

    No sub-task is assigned, so that of several edges met at once the most specific one is taken, else the first.
    By default the reward is 1 on completing the task and 0 otherwise; an episode terminates when the task is satisfied
    or violated.

    Attributes:
        propositions: names of the environment's P propositions.
        max_nodes: N, the padded size of a task; larger tasks are refused.
        completion: reward for completing the task.
        subtask: reward for every edge taken.
        bonuses: order bonuses.
    """

    propositions: tuple[str, ...]
    max_nodes: int = 64
    completion: float = 1.0
    subtask: float = 0.0
    bonuses: tuple[Bonus, ...] = ()

    def __post_init__(self) -> None:
        check_bonuses(self.propositions, self.bonuses)

    def read(self, text: str) -> TaskTree:
        """The padded tree of a task, numpy leaves.

        Raises:
            SpecError: if the text is no task, names unknown propositions or needs more than N nodes.
        """
        return _read(text, self.propositions, self.max_nodes)

    def start(self, task: TaskTree) -> TextProgress:
        """At the root, every rule waiting."""
        return TextProgress(task=initial(task), rules=rewards.initial(self._machine()))

    def advance(
        self, task: TaskTree, progress: TextProgress, labels: Bool[Array, " P"]
    ) -> tuple[TextProgress, Verdict]:
        """One step of monitor and reward machine."""
        before, state = progress.task, advance(task, progress.task, labels, TaskTree.NO_NODE)
        edge_taken = state.node != before.node
        satisfied = state.status == SATISFIED
        rules, reward = rewards.step(
            self._machine(), progress.rules, labels, task.reach[state.node], edge_taken, satisfied & edge_taken
        )
        # Once the episode has ended, the rules no longer change.
        running = before.status == RUNNING
        rules = jnp.where(running, rules, progress.rules)
        reward = jnp.where(running, reward, 0.0)
        verdict = Verdict(reward=reward, ended=state.status != RUNNING, success=satisfied)
        return TextProgress(task=state, rules=rules), verdict

    def describe(self, text: str, progress: TextProgress) -> dict[str, Any]:
        """What ``info`` shows of a task.

        Returns:
            ``status`` (``"running"``, ``"satisfied"`` or ``"violated"``), ``node`` (int, the current node of the
            tree), ``subtasks`` (tuple of SPECTRL texts, the sub-tasks that are open now; none when the task has
            ended) and ``success`` (bool).
        """
        node, status = int(progress.task.node), int(progress.task.status)
        offered = _subtasks(text, self.propositions, self.max_nodes)[node] if status == RUNNING else ()
        blocked = np.asarray(progress.task.blocked)
        return {
            "status": STATUS[status],
            "node": node,
            "subtasks": tuple(shown for edge, shown in offered if not blocked[edge]),
            "success": status == SATISFIED,
        }

    def _machine(self) -> RewardMachine:
        return reward_machine(self.propositions, completion=self.completion, subtask=self.subtask, bonuses=self.bonuses)


@functools.lru_cache(maxsize=4096)
def _read(text: str, propositions: tuple[str, ...], max_nodes: int) -> TaskTree:
    return compile_task(parse(text), propositions, max_nodes, on_host=True)


@functools.lru_cache(maxsize=4096)
def _subtasks(text: str, propositions: tuple[str, ...], max_nodes: int) -> tuple[tuple[tuple[int, str], ...], ...]:
    """For each valid node of a task its edges: where they lead, and the sub-task as text."""
    tree = _read(text, propositions, max_nodes)
    return tuple(
        tuple((subtask.node, shown(subtask)) for subtask in subtasks(tree, int(node), propositions))
        for node in np.flatnonzero(tree.valid)
    )


def shown(subtask: Subtask) -> str:
    """A sub-task in SPECTRL."""
    text = "achieve " + _joined(subtask.reach)
    return f"{text} ensuring {_joined([f'not {name}' for name in subtask.avoid])}" if subtask.avoid else text


def _joined(names: Sequence[str]) -> str:
    return " and ".join(names)
