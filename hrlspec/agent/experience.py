"""One step of the agent in its world, spelled once: what it saw, decided and did, and what came of it.

Collecting, relabelling and learning nest these structs; each says its fields' trailing axes, the leading ones are its
holder's. Axes: **P** atomic propositions, **N** tree nodes, **D** later sub-tasks, **A** components of an action,
**E** environments, **T** time steps, **V** environments and relabelled copies, **S** episodes (slots), **B** decisions.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Int32, Shaped

from envs_jax import Environment
from envs_jax.arrays import Array
from hrlspec.agent.networks.controller import Sight
from hrlspec.spec import TaskState, TaskTree


class View(NamedTuple):
    """An observation by whom it concerns, as `Environment.proposition_view` splits it."""

    propositions: Float32[Array, "..."]  # [..., P, ...], what is seen of each proposition
    shared: Float32[Array, "..."]  # [..., F0], what belongs to none of them


@struct.dataclass
class HighDecision:
    """What the high level decided; the edge and what lies ahead stay in force, the rest is meaningful where made."""

    made: Bool[Array, "*lead"]  # a decision was made before this step
    edge: Int32[Array, "*lead"]  # the edge assigned
    ahead: Float32[Array, "*lead D P"]  # reach sets of the sub-tasks planned 1, 2, ... after it
    log_prob: Float32[Array, "*lead"]
    value: Float32[Array, "*lead"]  # V^h of the remaining task
    advice: Float32[Array, "*lead N"]  # the low level's value of each edge
    leaf: Int32[Array, "*lead"]  # where the path ends that is meant to be taken


@struct.dataclass
class LowDecision:
    """What the low level decided."""

    action: Int32[Array, "*lead"] | Float32[Array, "*lead A"]
    log_prob: Float32[Array, "*lead"]  # what the ratio is taken to
    value: Float32[Array, "*lead"]  # V^l before the step
    shielded: Bool[Array, "*lead"]  # the shield replaced the action


@struct.dataclass
class Outcome:
    """What a step led to, before any reset."""

    labels: Bool[Array, "*lead P"]
    node: Int32[Array, "*lead"]  # task node after: the edge that was taken, or the node before when none was
    edge_taken: Bool[Array, "*lead"]
    satisfied: Bool[Array, "*lead"]
    accepted: Bool[Array, "*lead"]  # a round of a task that goes on for ever is complete
    reward: Float32[Array, "*lead"]
    terminated: Bool[Array, "*lead"]  # task satisfied or violated, or the environment ended the episode
    truncated: Bool[Array, "*lead"]  # horizon reached


@struct.dataclass
class Bootstrap:
    """Values of the state after a step; read where an episode was truncated, and after the last step of a rollout."""

    low: Float32[Array, "*lead"]
    high: Float32[Array, "*lead"]


@struct.dataclass
class Step:
    """One step while collecting, with leading axes ``[T, E]``."""

    view: View  # before
    task: Int32[Array, "*lead"]  # row of the task book
    level: Int32[Array, "*lead"]  # its curriculum level
    episode: Int32[Array, "*lead"]  # which episode of this rollout, 0-based
    since: Int32[Array, "*lead"]  # steps since the edge in force was assigned
    state: TaskState  # before
    high: HighDecision
    low: LowDecision
    outcome: Outcome
    bootstrap: Bootstrap
    reach_value: Float32[Array, "*lead _"]  # [..., P], the reach critic's value after; empty without a shield


def view_of(env: Environment, observation: Float32[Array, "..."]) -> View:
    """The view of one observation."""
    return View(*env.proposition_view(observation))


def flat(x: Shaped[Array, "V T ..."]) -> Shaped[Array, "..."]:
    """Merges the two leading axes (zero-sized arrays too)."""
    return x.reshape((x.shape[0] * x.shape[1], *x.shape[2:]))


def undecided(num_envs: int, num_nodes: int, ahead_shape: tuple[int, ...]) -> HighDecision:
    """Nothing assigned yet, leading axis E; ``ahead_shape`` is ``(D, P)``."""
    nothing = jnp.zeros(num_envs, jnp.float32)
    return HighDecision(
        made=jnp.zeros(num_envs, bool),
        edge=jnp.full(num_envs, TaskTree.NO_NODE, jnp.int32),
        ahead=jnp.zeros((num_envs, *ahead_shape), jnp.float32),
        log_prob=nothing,
        value=nothing,
        advice=jnp.zeros((num_envs, num_nodes), jnp.float32),
        leaf=jnp.zeros(num_envs, jnp.int32),
    )


@struct.dataclass
class Experience:
    """Rollouts and their relabelled copies, leading axes ``[V, T]``, before targets; ``trees`` is ``[V, S, ...]``.

    A relabelled copy of an environment's rollout counts as one more environment: V of them in all, S episodes each.
    """

    trees: TaskTree
    slot: Int32[Array, "V T"]  # which of the trees
    view: View
    state: TaskState
    high: HighDecision
    low: LowDecision
    outcome: Outcome
    bootstrap: Bootstrap
    goal: Bool[Array, "V T P"]  # p₊ of the edge in force
    reached: Bool[Array, "V T P"]  # p₊ of the edge taken
    learns_low: Bool[Array, "V T"]  # counts in the low level's policy loss
    learns_high: Bool[Array, "V T"]  # counts in the high level's policy loss
    valid: Bool[Array, "V T"]  # counts at all


@struct.dataclass
class Credit:
    """What samples are worth to a level."""

    advantage: Float32[Array, "*lead"]
    target: Float32[Array, "*lead"]  # of the value
    learns: Bool[Array, "*lead"]  # counts in the policy loss
    valid: Bool[Array, "*lead"]  # counts at all


@struct.dataclass
class LowBatch:
    """Samples of the low level, leading axes ``[V, T]``; ``trees`` is ``[V, S, ...]``."""

    trees: TaskTree
    slot: Int32[Array, "V T"]  # which of the trees
    sight: Sight
    edge: Int32[Array, "V T"]  # the edge in force
    ahead: Float32[Array, "V T D P"]  # reach sets of the sub-tasks planned after it
    feasible: Bool[Array, "V T _"]  # [V, T, N], the open edges; empty unless conditioned on the whole task
    decision: LowDecision
    credit: Credit


@struct.dataclass
class HighBatch:
    """Samples of the high level, leading axis B: decisions, their credit, and what they led to."""

    tree: TaskTree
    view: View
    state: TaskState
    decision: HighDecision
    credit: Credit
    reached: Bool[Array, "B P"]  # p₊ of the sub-task that was completed
    next_view: View  # when it was
    completed: Bool[Array, " B"]  # it was, within the episode and the rollout
