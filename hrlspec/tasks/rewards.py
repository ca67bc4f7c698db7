"""Rewards as data: completion, sub-tasks, and order bonuses (paper, "Reward Function of Subgoals").

A bonus rule is a small reward machine. Its state is never observed by the agent: that is what makes the
choice of the next sub-task non-Markovian in the paper's second set of experiments.

Axes: **R** bonus rules, **P** atomic propositions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array


class Bonus(NamedTuple):
    """One rule: reach ``first`` (having seen none of ``avoid`` since the episode's start), later ``second``."""

    first: str
    second: str
    bonus: float
    avoid: tuple[str, ...] = ()


@struct.dataclass
class RewardMachine:
    """Reward of a task: ``completion`` once, ``subtask`` per edge taken, and each bonus at most once an episode.

    Attributes:
        completion: float32 ``[]``, on satisfying the task.
        subtask: float32 ``[]``, for every edge taken.
        first: int32 ``[R]``, index of the proposition that arms rule r when a taken edge reaches it.
        second: int32 ``[R]``, index of the proposition that pays rule r when a *later* taken edge reaches it.
        avoid: bool ``[R, P]``, labels that disable rule r when seen before it is armed, or in the same step.
        bonus: float32 ``[R]``.
    """

    WAITING: ClassVar[int] = 0
    ARMED: ClassVar[int] = 1
    PAID: ClassVar[int] = 2
    DEAD: ClassVar[int] = 3

    completion: Float32[Array, ""]
    subtask: Float32[Array, ""]
    first: Int32[Array, " R"]
    second: Int32[Array, " R"]
    avoid: Bool[Array, "R P"]
    bonus: Float32[Array, " R"]

    @property
    def num_rules(self) -> int:
        """R, the number of bonus rules."""
        return self.first.shape[-1]


def reward_machine(
    propositions: Sequence[str], *, completion: float = 1.0, subtask: float = 0.0, bonuses: Sequence[Bonus] = ()
) -> RewardMachine:
    """Builds a :class:`RewardMachine` over ``propositions``.

    Raises:
        ValueError: if a rule names an unknown proposition.
    """
    check_bonuses(propositions, bonuses)
    index = {name: i for i, name in enumerate(propositions)}
    avoid = np.zeros((len(bonuses), len(propositions)), bool)
    for i, rule in enumerate(bonuses):
        avoid[i, [index[name] for name in rule.avoid]] = True
    return RewardMachine(
        completion=jnp.float32(completion),
        subtask=jnp.float32(subtask),
        first=jnp.asarray([index[rule.first] for rule in bonuses], jnp.int32),
        second=jnp.asarray([index[rule.second] for rule in bonuses], jnp.int32),
        avoid=jnp.asarray(avoid),
        bonus=jnp.asarray([rule.bonus for rule in bonuses], jnp.float32),
    )


def check_bonuses(propositions: Sequence[str], bonuses: Sequence[Bonus]) -> None:
    """Raises ``ValueError`` if a rule names an unknown proposition."""
    for rule in bonuses:
        unknown = [name for name in (rule.first, rule.second, *rule.avoid) if name not in propositions]
        if unknown:
            raise ValueError(f"bonus rule {rule} names {unknown}, known propositions are {list(propositions)}")


def return_bounds(machine: RewardMachine, depth: int) -> tuple[float, float]:
    """What no return of an episode is below and none above, on a task with ``depth`` edges on its longest path."""
    parts = np.concatenate([[machine.completion], np.full(depth, machine.subtask), machine.bonus])
    return float(np.minimum(parts, 0).sum()), float(np.maximum(parts, 0).sum())


def initial(machine: RewardMachine) -> Int32[Array, " R"]:
    """Every rule waiting, int32 ``[R]``."""
    return jnp.full(machine.num_rules, RewardMachine.WAITING, jnp.int32)


def step(
    machine: RewardMachine,
    rules: Int32[Array, " R"],
    labels: Bool[Array, " P"],
    reached: Bool[Array, " P"],
    edge_taken: Bool[Array, ""],
    completed: Bool[Array, ""],
) -> tuple[Int32[Array, " R"], Float32[Array, ""]]:
    """One step of the reward.

    Args:
        machine: the rules.
        rules: int32 ``[R]``, the state of each rule.
        labels: bool ``[P]``, the propositions that hold in the new state.
        reached: bool ``[P]``, what the edge taken in this step reaches (ignored when none was).
        edge_taken: bool ``[]``.
        completed: bool ``[]``, the task became satisfied in this step.

    Returns:
        The new rule states and the reward, float32 ``[]``.
    """
    seen_avoid = (machine.avoid & labels).any(-1)
    waiting, armed = rules == RewardMachine.WAITING, rules == RewardMachine.ARMED
    arms = waiting & ~seen_avoid & edge_taken & reached[machine.first]
    pays = armed & edge_taken & reached[machine.second]
    rules = jnp.where(waiting & seen_avoid, RewardMachine.DEAD, rules)
    rules = jnp.where(arms, RewardMachine.ARMED, rules)
    rules = jnp.where(pays, RewardMachine.PAID, rules)
    reward = machine.completion * completed + machine.subtask * edge_taken + (machine.bonus * pays).sum(-1)
    return rules, reward.astype(jnp.float32)
