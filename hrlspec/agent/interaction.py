"""One step of the agent in its world: decide where a sub-task ended, act, advance the task, reward.

Shared by training and evaluation. Axes: **E** environments, **M** tasks of the book, **N** tree nodes, **P**
atomic propositions, **R** bonus rules.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hrlspec.agent.agent import Agent, Params, TaskBook, View, in_groups, shielded_action
from hrlspec.agent.distributions import Categorical
from hrlspec.agent.networks.controller import Instruction
from hrlspec.spec import RUNNING, SATISFIED, TaskState, TaskTree, advance, initial, open_edges
from hrlspec.tasks import rewards
from hrlspec.tasks.rewards import RewardMachine


@struct.dataclass
class Worker:
    """Environments with a task each; every field has the leading axis E.

    Attributes:
        env_state: state of the environment.
        view: its observation, as ``env.proposition_view`` gives it.
        task: int32 ``[E]``, row of the task book.
        task_state: where the task stands.
        assigned: int32 ``[E]``, the edge the planner assigned.
        ahead: float32 ``[E, D, P]``, what the planner means to reach after it, see `Instruction`.
        awaiting: bool ``[E]``, a decision is due before the next action.
        rules: int32 ``[E, R]``, state of the bonus rules.
    """

    env_state: Any
    view: View
    task: jax.Array
    task_state: TaskState
    assigned: jax.Array
    ahead: jax.Array
    awaiting: jax.Array
    rules: jax.Array


@struct.dataclass
class Decision:
    """What the planner said; meaningful where ``made``. Leading axis E."""

    made: jax.Array  # bool [E]
    log_prob: jax.Array  # float32 [E]
    value: jax.Array  # float32 [E]
    advice: jax.Array  # float32 [E, N], what the low level said of each edge


@struct.dataclass
class Outcome:
    """What a step led to, before any reset. Leading axis E."""

    labels: jax.Array  # bool [E, P]
    edge_taken: jax.Array  # bool [E]
    reward: jax.Array  # float32 [E]
    terminated: jax.Array  # bool [E], task satisfied or violated, or the environment ended the episode
    truncated: jax.Array  # bool [E], horizon reached
    satisfied: jax.Array  # bool [E]


def task_of(book: TaskBook, rows: jax.Array) -> TaskTree:
    """The trees of the given rows of a book."""
    return jax.tree.map(lambda x: x[rows], book.tree)


def start(
    agent: Agent, machine: RewardMachine, layouts: Any, tasks: jax.Array, keys: jax.Array, book: TaskBook
) -> Worker:
    """Workers at the start of an episode in the given layouts with the given rows of the book, all leading axis E."""
    env = agent.env
    observation, env_state = jax.vmap(env.reset_to, in_axes=(0, 0, None))(layouts, keys, env.default_params)
    num_envs = tasks.shape[0]
    return Worker(
        env_state=env_state,
        view=jax.vmap(env.proposition_view)(observation),
        task=tasks,
        task_state=jax.vmap(initial)(task_of(book, tasks)),
        assigned=jnp.full(num_envs, TaskTree.NO_NODE, jnp.int32),
        ahead=jnp.zeros((num_envs, *book.told.ahead.shape[2:])),
        awaiting=jnp.ones(num_envs, bool),
        rules=jnp.broadcast_to(rewards.initial(machine), (num_envs, machine.num_rules)),
    )


def plan_where(
    agent: Agent, params: Params, book: TaskBook, worker: Worker, needed: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array, Decision]:
    """Runs the planner for the environments in ``needed`` alone.

    Returns choices ``[E]``, what lies ahead of them ``[E, D, P]``, and how they were made.

    Args:
        agent: the networks.
        params: their parameters.
        book: the tasks.
        worker: the environments.
        needed: bool ``[E]``.
        noise: Gumbel noise ``[E, N]``; zeros choose greedily.
    """

    def decide(inputs: Any) -> tuple[jax.Array, ...]:
        view, task, state, noise = inputs
        tree, told = jax.tree.map(lambda x: x[task], (book.tree, book.told))
        logits, value, advice, ahead = agent.plan_ahead(params, view, tree, state, told)
        choice, log_prob = jax.vmap(Categorical(logits.shape[-1]).sample)(logits, noise)
        return choice, ahead[jnp.arange(choice.shape[0]), choice], log_prob, value, advice

    nothing = jnp.zeros(needed.shape)
    outputs = (worker.assigned, worker.ahead, nothing, nothing, jnp.zeros(noise.shape))
    inputs = (worker.view, worker.task, worker.task_state, noise)
    choice, ahead, *how = in_groups(decide, needed, inputs, outputs, agent.config.group)
    return choice, ahead, Decision(needed, *how)


def decide(agent: Agent, params: Params, book: TaskBook, worker: Worker, noise: jax.Array) -> tuple[Worker, Decision]:
    """Assigns a sub-task wherever one is due."""
    choice, ahead, decision = plan_where(agent, params, book, worker, worker.awaiting, noise)
    awaiting = jnp.zeros_like(worker.awaiting)
    return dataclasses.replace(worker, assigned=choice, ahead=ahead, awaiting=awaiting), decision


def act(
    agent: Agent, params: Params, book: TaskBook, worker: Worker, noise: jax.Array, *, shield: bool
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Chooses actions for the assigned sub-tasks.

    Returns:
        Actions (leading axis E), their log-probabilities, the low level's values, and bool ``[E]``: the shield
        replaced the action.
    """

    def one(view: View, told: Instruction, noise: jax.Array) -> Any:
        outputs, value = agent.control(params, view, told)
        action, log_prob = agent.actions.sample(outputs, noise)
        safe = shielded_action(agent, params, view, told.avoid > 0, action) if shield else action
        return safe, log_prob, value, (safe != action).any()

    feasible = jax.vmap(open_edges)(task_of(book, worker.task), worker.task_state)
    told = agent.told_now(params, book.told, (worker.task,), worker.assigned, feasible, worker.ahead)
    return jax.vmap(one)(worker.view, told, noise)


def transition(
    agent: Agent, machine: RewardMachine, book: TaskBook, worker: Worker, action: jax.Array, keys: jax.Array
) -> tuple[Worker, Outcome]:
    """Steps environments, tasks and bonus rules. Ended episodes are left as they ended."""
    env = agent.env
    params = env.default_params
    observation, env_state, _, failed, truncated, _ = jax.vmap(env.step_env, in_axes=(0, 0, 0, None))(
        keys, worker.env_state, action, params
    )
    labels = jax.vmap(env.labels, in_axes=(0, None))(env_state, params)
    tree = task_of(book, worker.task)
    state = jax.vmap(advance)(tree, worker.task_state, labels, worker.assigned)
    edge_taken = state.node != worker.task_state.node
    satisfied = (state.status == SATISFIED) & edge_taken
    reached = book.tree.reach[worker.task, state.node]
    rules, reward = jax.vmap(rewards.step, in_axes=(None, 0, 0, 0, 0, 0))(
        machine, worker.rules, labels, reached, edge_taken, satisfied
    )
    lost = jnp.take_along_axis(state.blocked, worker.assigned[:, None], 1)[:, 0]
    terminated = failed | (state.status != RUNNING)
    worker = dataclasses.replace(
        worker,
        env_state=env_state,
        view=jax.vmap(env.proposition_view)(observation),
        task_state=state,
        awaiting=edge_taken | lost,
        rules=rules,
    )
    outcome = Outcome(
        labels=labels,
        edge_taken=edge_taken,
        reward=reward,
        terminated=terminated,
        truncated=truncated & ~terminated,
        satisfied=satisfied,
    )
    return worker, outcome


def restart_where(
    agent: Agent,
    machine: RewardMachine,
    worker: Worker,
    ended: jax.Array,
    layouts: Any,
    tasks: jax.Array,
    keys: jax.Array,
    book: TaskBook,
) -> Worker:
    """Replaces the workers in ``ended`` (bool ``[E]``) by fresh ones in the given layouts and tasks."""
    fresh = start(agent, machine, layouts, tasks, keys, book)

    def pick(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(ended.reshape(ended.shape + (1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(pick, fresh, worker)
