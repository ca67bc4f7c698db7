"""Rollouts of a trained agent on given tasks in given layouts, one episode each, vectorised over episodes.

Axes: **B** episodes, **H** horizon, **N** tree nodes.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32, Key

from envs_jax.arrays import Array
from envs_jax.base import Layout, State
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import LowDecision, Outcome
from hrlspec.agent.interaction import Worker, act, assign, start, transition
from hrlspec.agent.low_level import Params, TaskBook
from hrlspec.spec import RUNNING, TaskTree
from hrlspec.spec.automata import Automata
from hrlspec.tasks.rewards import RewardMachine

Seen = TypeVar("Seen")


@struct.dataclass
class Episodes:
    """Outcomes of B episodes.

    Attributes:
        success: bool ``[B]``, the task was satisfied within the horizon.
        violated: bool ``[B]``, the task was violated, or the environment ended the episode.
        steps: int32 ``[B]``, environment steps until the episode ended.
        returns: float32 ``[B]``, undiscounted sum of rewards.
        rounds: int32 ``[B]``, accepting transitions; 0 for tasks that do not go on for ever.
        ended: bool ``[B]``, the environment ended the episode, and the task was neither satisfied nor violated by then.
    """

    success: Bool[Array, " B"]
    violated: Bool[Array, " B"]
    steps: Int32[Array, " B"]
    returns: Float32[Array, " B"]
    rounds: Int32[Array, " B"]
    ended: Bool[Array, " B"]


@struct.dataclass
class Trace:
    """Trajectories, leading axes ``[H, B]``; entry t is the state before step t, meaningful while ``running``.

    Attributes:
        env_state: states of the environment.
        node: int32, task node.
        assigned: int32, the edge assigned.
        running: bool.
    """

    env_state: State
    node: Int32[Array, "*lead B"]
    assigned: Int32[Array, "*lead B"]
    running: Bool[Array, "*lead B"]


class Moment(NamedTuple):
    """One step of B episodes, for whoever watches them.

    Attributes:
        agent: both levels.
        params: their parameters.
        book: the tasks.
        before: where world and task stood, the sub-task in force assigned.
        low: what the low level decided.
        outcome: what came of it.
        after: where world and task stand then.
        running: bool ``[B]``, the episode had not ended before.
    """

    agent: Agent
    params: Params
    book: TaskBook
    before: Worker
    low: LowDecision
    outcome: Outcome
    after: Worker
    running: Bool[Array, " B"]


Watch = Callable[[Moment], Seen]
"""What is kept of a step: a pure function, of a module's top level, so that programs with it compile once."""


def run_episodes(
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
    chunk: int = 500,
) -> Episodes:
    """One episode per task and layout: a pure function, to be jitted (``agent`` static), vmapped and scanned.

    Args:
        key: consumed.
        agent: the networks.
        params: their parameters.
        machine: the rewards.
        tasks: trees, leading axis M, any N; or M automata.
        layouts: layouts of the environment, leading axis B.
        which: int ``[B]``, the task of each episode; if not given there are as many, one for each.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.
        chunk: episodes run in parallel; bounds memory. Each size compiles once.

    Returns:
        JAX arrays, leading axis B.

    Raises:
        ValueError: there are not as many tasks as layouts, or not as many as are named.
    """
    which = _which(tasks, layouts, which)
    total = len(which)
    chunk = min(chunk, total)
    parts = []
    for first in range(0, total, chunk):
        # The last chunk is filled up by wrapping around, so that every chunk has one compiled shape.
        rows = np.arange(first, first + chunk) % total
        some = jax.tree.map(lambda x, rows=rows: x[rows], layouts)
        begun = _begun(tasks, which[rows])
        episodes, _ = _run(jax.random.fold_in(key, first), agent, params, machine, *begun, some, greedy, shield, None)
        parts.append(jax.tree.map(lambda x, n=total - first: x[:n], episodes))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def trace_episodes(
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
) -> tuple[Episodes, Trace]:
    """As :func:`run_episodes`, for a few episodes, with their trajectories."""
    how: dict[str, Any] = {"which": which, "greedy": greedy, "shield": shield}
    return watch_episodes(key, agent, params, machine, tasks, layouts, _way, **how)


def watch_episodes(
    key: Key[Array, ""],
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    tasks: TaskTree | Automata,
    layouts: Layout,
    watch: Watch[Seen],
    *,
    which: Int[np.ndarray, " B"] | None = None,
    greedy: bool = False,
    shield: bool = False,
) -> tuple[Episodes, Seen]:
    """As :func:`run_episodes`, for a few episodes, with what ``watch`` keeps of each step, leading axis H.

    Watching changes nothing of what happens.
    """
    which = _which(tasks, layouts, which)
    return _run(key, agent, params, machine, *_begun(tasks, which), layouts, greedy, shield, watch)


def _way(moment: Moment) -> Trace:
    before = moment.before
    return Trace(before.env_state, before.task_state.node, before.decision.edge, moment.running)


def _which(tasks: TaskTree | Automata, layouts: Layout, which: Int[np.ndarray, " B"] | None) -> Int[np.ndarray, " B"]:
    """The task of each episode.

    Raises:
        ValueError: there are not as many tasks as layouts, or not as many as are named.
    """
    num_layouts = jax.tree.leaves(layouts)[0].shape[0]
    num_tasks = len(tasks.start) if isinstance(tasks, Automata) else tasks.parent.shape[0]
    found = num_tasks if which is None else len(which)
    if found != num_layouts:
        raise ValueError(f"found {found} tasks for {num_layouts} layouts, expected one for each")
    which = np.arange(num_tasks) if which is None else which
    wrong = which[(which < 0) | (which >= num_tasks)]
    if wrong.size:
        raise ValueError(f"which names task {wrong[0]}, there are {num_tasks}")
    return which


def _begun(tasks: TaskTree | Automata, which: Int[np.ndarray, " B"]) -> tuple[TaskTree | Automata, Int32[Array, " B"]]:
    """What a book is made of for some episodes, a tree for each or all states, and the row where each begins."""
    if isinstance(tasks, Automata):
        return tasks, jnp.asarray(tasks.start)[which]
    return jax.tree.map(lambda x: x[which], tasks), jnp.arange(len(which), dtype=jnp.int32)


@functools.partial(jax.jit, static_argnames=("agent", "greedy", "shield", "watch"))
def _run(
    key: Key[Array, ""],
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    tasks: TaskTree | Automata,
    rows: Int32[Array, " B"],
    layouts: Layout,
    greedy: bool,
    shield: bool,
    watch: Watch[Any] | None,
) -> tuple[Episodes, Any]:
    env, book = agent.env, agent.low.prepare(params, tasks)
    num_episodes, num_nodes = rows.shape[0], book.tree.num_nodes
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num_episodes, dtype=jnp.int32))
    worker = start(keys, env, machine, book, layouts, rows)
    noise_scale = 0.0 if greedy else 1.0
    zeros = jnp.zeros(num_episodes, jnp.float32)
    none = zeros.astype(jnp.int32)
    outcome = Episodes(success=zeros > 0, violated=zeros > 0, steps=none, returns=zeros, rounds=none, ended=zeros > 0)

    def step(carry: tuple[Any, ...]) -> tuple[tuple[Any, ...], Any]:
        worker, outcome, running, time = carry
        step_key, plan_key, act_key = jax.random.split(jax.random.fold_in(key, num_episodes + time), 3)
        worker = dataclasses.replace(worker, awaiting=worker.awaiting & running)
        noise = noise_scale * jax.random.gumbel(plan_key, (num_episodes, num_nodes), jnp.float32)
        worker = assign(agent, params, book, worker, noise)
        noise = noise_scale * agent.low.actions.noise(act_key, (num_episodes,))
        reach = jax.vmap(agent.low.reach_values, (None, 0))(params, worker.view) if shield else None
        low, before = act(agent, params, book, worker, noise, reach), worker
        worker, result = transition(jax.random.split(step_key, num_episodes), env, machine, book, before, low.action)
        seen = watch and watch(Moment(agent, params, book, before, low, result, worker, running))
        outcome = Episodes(
            success=outcome.success | (running & result.satisfied),
            violated=outcome.violated | (running & result.terminated & ~result.satisfied),
            steps=outcome.steps + running,
            returns=outcome.returns + running * result.reward,
            rounds=outcome.rounds + (running & result.accepted),
            ended=outcome.ended | (running & result.terminated & (worker.task_state.status == RUNNING)),
        )
        running &= ~(result.terminated | result.truncated)
        return (worker, outcome, running, time + 1), seen

    carry = (worker, outcome, jnp.ones(num_episodes, bool), jnp.int32(0))
    if watch:
        carry, seen = jax.lax.scan(lambda c, _: step(c), carry, length=env.horizon)
        return carry[1], seen
    return jax.lax.while_loop(lambda c: c[2].any(), lambda c: step(c)[0], carry)[1], None
