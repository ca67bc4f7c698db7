"""One step of the agent in its world, spelled once: what it saw, decided and did, and what came of it.

Collecting, relabelling and learning nest these structs; each says its fields' trailing axes, the leading ones are its
holder's. Axes: **P** atomic propositions, **N** tree nodes, **D** later sub-tasks, **A** components of an action,
**E** environments, **T** time steps, **V** environments and relabelled copies, **S** episodes (slots), **B** decisions.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from envs_jax import Environment
from hrlspec.spec import TaskState, TaskTree


class View(NamedTuple):
    """An observation by whom it concerns, as `Environment.proposition_view` splits it."""

    propositions: jax.Array  # float32 [..., P, ...], what is seen of each proposition
    shared: jax.Array  # float32 [..., F0], what belongs to none of them


@struct.dataclass
class HighDecision:
    """What the high level decided; the edge and what lies ahead stay in force, the rest is meaningful where made."""

    made: jax.Array  # bool, a decision was made before this step
    edge: jax.Array  # int32, the edge assigned
    ahead: jax.Array  # float32 [..., D, P], what is meant to be reached 1, 2, ... sub-tasks after it
    log_prob: jax.Array  # float32
    value: jax.Array  # float32, V^h of the remaining task
    advice: jax.Array  # float32 [..., N], what the low level said of each edge


@struct.dataclass
class LowDecision:
    """What the low level decided."""

    action: jax.Array  # int32, or float32 [..., A]
    log_prob: jax.Array  # float32, what the ratio is taken to
    value: jax.Array  # float32, V^l before the step
    shielded: jax.Array  # bool, the shield replaced the action


@struct.dataclass
class Outcome:
    """What a step led to, before any reset."""

    labels: jax.Array  # bool [..., P]
    node: jax.Array  # int32, task node after: the edge that was taken, or the node before when none was
    edge_taken: jax.Array  # bool
    satisfied: jax.Array  # bool
    reward: jax.Array  # float32
    terminated: jax.Array  # bool, task satisfied or violated, or the environment ended the episode
    truncated: jax.Array  # bool, horizon reached


@struct.dataclass
class Bootstrap:
    """Values of the state after a step; read where an episode was truncated, and after the last step of a rollout."""

    low: jax.Array  # float32
    high: jax.Array  # float32


@struct.dataclass
class Step:
    """One step while collecting, with leading axes ``[T, E]``."""

    view: View  # before
    task: jax.Array  # int32, row of the task book
    level: jax.Array  # int32, its curriculum level
    episode: jax.Array  # int32, which episode of this rollout, 0-based
    since: jax.Array  # int32, steps since the edge in force was assigned
    state: TaskState  # before
    high: HighDecision
    low: LowDecision
    outcome: Outcome
    bootstrap: Bootstrap
    reach_value: jax.Array  # float32 [..., P], the reach critic's value after; empty without a shield


def view_of(env: Environment, observation: jax.Array) -> View:
    """The view of one observation."""
    return View(*env.proposition_view(observation))


def undecided(num_envs: int, num_nodes: int, ahead_shape: tuple[int, ...]) -> HighDecision:
    """Nothing assigned yet, leading axis E; ``ahead_shape`` is ``(D, P)``."""
    nothing = jnp.zeros(num_envs)
    return HighDecision(
        made=jnp.zeros(num_envs, bool),
        edge=jnp.full(num_envs, TaskTree.NO_NODE, jnp.int32),
        ahead=jnp.zeros((num_envs, *ahead_shape)),
        log_prob=nothing,
        value=nothing,
        advice=jnp.zeros((num_envs, num_nodes)),
    )


@struct.dataclass
class Experience:
    """Rollouts and their relabelled copies, leading axes ``[V, T]``, before targets; ``trees`` is ``[V, S, ...]``.

    A relabelled copy of an environment's rollout counts as one more environment: V of them in all, S episodes each.
    """

    trees: TaskTree
    slot: jax.Array  # int32, which of the trees
    view: View
    state: TaskState
    high: HighDecision
    low: LowDecision
    outcome: Outcome
    bootstrap: Bootstrap
    goal: jax.Array  # bool [..., P], p₊ of the edge in force
    reached: jax.Array  # bool [..., P], p₊ of the edge taken
    learns_low: jax.Array  # bool, counts in the low level's policy loss
    learns_high: jax.Array  # bool, counts in the high level's policy loss
    valid: jax.Array  # bool, counts at all


@struct.dataclass
class Credit:
    """What samples are worth to a level."""

    advantage: jax.Array  # float32
    target: jax.Array  # float32, of the value
    learns: jax.Array  # bool, counts in the policy loss
    valid: jax.Array  # bool, counts at all


@struct.dataclass
class LowBatch:
    """Samples of the low level, leading axes ``[V, T]``; ``trees`` is ``[V, S, ...]``."""

    trees: TaskTree
    slot: jax.Array  # int32, which of the trees
    view: View
    edge: jax.Array  # int32, the edge in force
    ahead: jax.Array  # float32 [..., D, P], what is meant to be reached after it
    feasible: jax.Array  # bool [..., N], the open edges; empty unless the low level is told the whole task
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
    reached: jax.Array  # bool [..., P], p₊ of the sub-task that was completed
    next_view: View  # when it was
    completed: jax.Array  # bool, it was, within the episode and the rollout
