"""Episodes with all that went on in both levels, for somebody who wants to look into them.

Axes: **B** episodes, **H** horizon, **N** tree nodes, **P** atomic propositions, **D** coordinates of a position.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32, Key, Shaped

from envs_jax import Drawable, Environment
from envs_jax.arrays import Array
from envs_jax.base import Layout, State
from hrlspec.agent.agent import Agent
from hrlspec.agent.groups import take
from hrlspec.agent.interaction import Worker
from hrlspec.agent.low_level import Params
from hrlspec.evaluation.episodes import Episodes, Moment, watch_episodes
from hrlspec.spec import TaskState, TaskTree, open_edges
from hrlspec.spec.automata import Automata
from hrlspec.tasks.rewards import RewardMachine


@struct.dataclass
class Standing:
    """How world and task stand at a moment.

    Attributes:
        position: ``[..., D]``, of the agent in its scene; D is 0 in a world that cannot be drawn.
        labels: bool ``[..., P]``, the propositions that hold.
        task: int32 ``[...]``, the task, or the state of an automaton: a row of what was to be carried out.
        state: progress on its tree.
    """

    position: Shaped[Array, "*lead D"]
    labels: Bool[Array, "*lead P"]
    task: Int32[Array, "*lead"]
    state: TaskState


@struct.dataclass
class Deliberation:
    """What the high level made of the open branches, meaningful where it decided.

    Attributes:
        made: bool ``[...]``, it decided before this step.
        edge: int32 ``[...]``, the edge in force, throughout; the root where the method assigns none.
        open: bool ``[..., N]``, the edges that it could choose.
        value: float32 ``[...]``, V^h of the remaining task.
        probability: float32 ``[..., N]``, of choosing each open edge.
        worth: float32 ``[..., N]``, V^h if each open edge were the only one; zeros for others.
    """

    made: Bool[Array, "*lead"]
    edge: Int32[Array, "*lead"]
    open: Bool[Array, "*lead N"]
    value: Float32[Array, "*lead"]
    probability: Float32[Array, "*lead N"]
    worth: Float32[Array, "*lead N"]


@struct.dataclass
class Record:
    """B episodes, leading axes ``[H, B]``.

    Attributes:
        running: bool, the episode had not ended before the step; the rest is meaningful where it is.
        before: how everything stood before the step.
        after: how everything stood after it.
        high: the high level's thoughts before it.
        action: int32, or float32 with a trailing axis.
        value: float32, V^l before the step.
        reward: float32, of the step.
    """

    running: Bool[Array, "*lead"]
    before: Standing
    after: Standing
    high: Deliberation
    action: Int32[Array, "*lead"] | Float32[Array, "*lead A"]
    value: Float32[Array, "*lead"]
    reward: Float32[Array, "*lead"]


def record_episodes(
    key: Key[Array, ""],
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    tasks: TaskTree | Automata,
    layouts: Layout,
    *,
    which: Int[np.ndarray, " B"] | None = None,
    greedy: bool = False,
    shield: bool = False,
) -> tuple[Episodes, Record]:
    """As `run_episodes`, for a few episodes, with all that went on.

    The high level is asked once more at each of its decisions, and about each branch alone; nothing else depends on
    what it says then.
    """
    how: dict[str, Any] = {"which": which, "greedy": greedy, "shield": shield}
    return watch_episodes(key, agent, params, machine, tasks, layouts, _record, **how)


def _record(moment: Moment) -> Record:
    env = moment.agent.env
    return Record(
        running=moment.running,
        before=_standing(env, moment.before),
        after=_standing(env, moment.after),
        high=_deliberation(moment),
        action=moment.low.action,
        value=moment.low.value,
        reward=moment.outcome.reward,
    )


def _standing(env: Environment, worker: Worker) -> Standing:
    def position(state: State) -> Shaped[Array, " D"]:
        return env.position(state) if isinstance(env, Drawable) else jnp.zeros(0, jnp.float32)

    return Standing(
        position=jax.vmap(position)(worker.env_state),
        labels=jax.vmap(env.labels, (0, None))(worker.env_state, env.default_params),
        task=worker.task,
        state=worker.task_state,
    )


def _deliberation(moment: Moment) -> Deliberation:
    """Computed where a decision was made, which is rare."""
    agent, book, worker = moment.agent, moment.book, moment.before
    decision = worker.decision
    tree, instructions = take((book.tree, book.instructions), worker.task)
    open_now = jax.vmap(open_edges)(tree, worker.task_state)
    num_episodes, num_nodes = open_now.shape

    def choose(blocked: Bool[Array, "B N"]) -> tuple[Float32[Array, "B N"], Float32[Array, " B"]]:
        state = dataclasses.replace(worker.task_state, blocked=blocked)
        choice = agent.high.choose(agent.low, moment.params, worker.view, tree, state, instructions)
        return jax.nn.softmax(choice.logits), choice.value

    def alone(edge: Int32[Array, ""]) -> Float32[Array, " B"]:
        is_open = open_now[:, edge]
        others = open_now & (jnp.arange(num_nodes, dtype=jnp.int32) != edge)

        def worth() -> Float32[Array, " B"]:
            return jnp.where(is_open, choose(worker.task_state.blocked | others)[1], 0.0)

        return jax.lax.cond(is_open.any(), worth, lambda: jnp.zeros(num_episodes, jnp.float32))

    def thoughts() -> Deliberation:
        probability, value = choose(worker.task_state.blocked)
        worth = jax.lax.map(alone, jnp.arange(num_nodes, dtype=jnp.int32)).T
        return Deliberation(decision.made, decision.edge, open_now, value, probability, worth)

    nothing = jnp.zeros((num_episodes, num_nodes), jnp.float32)
    none = Deliberation(decision.made, decision.edge, open_now, nothing[:, 0], nothing, nothing)
    return jax.lax.cond(decision.made.any(), thoughts, lambda: none)
