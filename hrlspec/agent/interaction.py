"""One step of the agent in its world: decide where a sub-task ended, act, advance the task, reward.

Shared by training and evaluation. Axes: **E** environments, **M** tasks of the book, **N** tree nodes, **P**
atomic propositions, **K** candidate actions, **R** bonus rules.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32, Key

from envs_jax import Environment
from envs_jax.arrays import Array
from envs_jax.base import Layout, State
from hrlspec.agent.agent import Agent
from hrlspec.agent.distributions import Categorical
from hrlspec.agent.experience import HighDecision, LowDecision, Outcome, View, undecided, view_of
from hrlspec.agent.groups import in_groups, take
from hrlspec.agent.low_level import Params, TaskBook
from hrlspec.agent.networks.controller import Instruction
from hrlspec.agent.networks.tree import with_stays
from hrlspec.agent.shield import shielded_action
from hrlspec.spec import RUNNING, SATISFIED, TaskState, TaskTree, advance, initial, open_edges
from hrlspec.spec.monitor import holding
from hrlspec.tasks import rewards
from hrlspec.tasks.rewards import RewardMachine


@struct.dataclass
class Worker:
    """Environments with a task each; every field has the leading axis E.

    Attributes:
        env_state: state of the environment.
        view: its observation.
        task: int32 ``[E]``, row of the task book.
        task_state: where the task stands.
        decision: the high level's, in force.
        awaiting: bool ``[E]``, a decision is due before the next action.
        rules: int32 ``[E, R]``, state of the bonus rules.
    """

    env_state: State
    view: View
    task: Int32[Array, " E"]
    task_state: TaskState
    decision: HighDecision
    awaiting: Bool[Array, " E"]
    rules: Int32[Array, "E R"]


def task_of(book: TaskBook, rows: Int[Array, " E"]) -> TaskTree:
    """The trees of the given rows of a book."""
    return take(book.tree, rows)


def start(
    keys: Key[Array, " E"],
    env: Environment,
    machine: RewardMachine,
    book: TaskBook,
    layouts: Layout,
    tasks: Int[Array, " E"],
) -> Worker:
    """Workers at the start of an episode in the given layouts with the given rows of the book, all leading axis E."""
    observation, env_state = jax.vmap(env.reset_to, in_axes=(0, 0, None))(layouts, keys, env.default_params)
    num_envs = tasks.shape[0]
    return Worker(
        env_state=env_state,
        view=_views(env, observation),
        task=tasks,
        task_state=jax.vmap(initial)(task_of(book, tasks)),
        decision=undecided(num_envs, book.tree.num_nodes, book.instructions.ahead.shape[2:]),
        awaiting=jnp.ones(num_envs, bool),
        rules=jnp.broadcast_to(rewards.initial(machine), (num_envs, machine.num_rules)),
    )


def decide(
    agent: Agent,
    params: Params,
    book: TaskBook,
    worker: Worker,
    due: Bool[Array, " E"],
    noise: Float32[Array, "E N"],
    valued: Bool[Array, " E"] | bool = False,
) -> HighDecision:
    """What the high level decides in the environments where that is due, and in the others what is in force there.

    Where there is nothing to choose the high level is not asked: value and advice are zeros unless ``valued``.

    Args:
        agent: both levels.
        params: their parameters.
        book: the tasks.
        worker: the environments.
        due: bool ``[E]``.
        noise: Gumbel noise ``[E, N]``; zeros choose greedily.
        valued: bool ``[E]``, V^h is wanted, whether or not a decision is due.
    """

    def choose(inputs: tuple[View, Int[Array, " B"], TaskState, Float32[Array, "B N"]]) -> HighDecision:
        view, task, state, noise = inputs
        tree, instructions = take((book.tree, book.instructions), task)
        choice = agent.high.choose(agent.low, params, view, tree, state, instructions)
        edge, log_prob = jax.vmap(Categorical(noise.shape[-1]).sample)(choice.logits, noise)
        told = jax.vmap(with_stays)(tree, choice.ahead)
        ahead, leaf = take((told, choice.leaf), jnp.arange(edge.shape[0], dtype=jnp.int32), edge)
        return HighDecision(jnp.ones(edge.shape, bool), edge, ahead, log_prob, choice.value, choice.advice, leaf)

    before, task = worker.decision, worker.task
    settled = agent.high.settled(task_of(book, task), worker.task_state, book.forks[task])
    obvious = due & (settled != TaskTree.NO_NODE)
    nothing = undecided(due.shape[0], noise.shape[-1], before.ahead.shape[1:])
    ahead = jnp.where(obvious[:, None, None], book.instructions.ahead[task, settled], before.ahead)
    kept = dataclasses.replace(nothing, made=obvious, edge=jnp.where(obvious, settled, before.edge), ahead=ahead)
    inputs = (worker.view, task, worker.task_state, noise)
    return in_groups(choose, valued | (due & ~obvious), inputs, kept, agent.config.group)


def assign(agent: Agent, params: Params, book: TaskBook, worker: Worker, noise: Float32[Array, "E N"]) -> Worker:
    """Assigns a sub-task wherever one is due; see `decide`."""
    decision = decide(agent, params, book, worker, worker.awaiting, noise)
    return dataclasses.replace(worker, decision=decision, awaiting=jnp.zeros_like(worker.awaiting))


def act(
    agent: Agent,
    params: Params,
    book: TaskBook,
    worker: Worker,
    noise: Float32[Array, "E ..."],
    reach_values: Float32[Array, "E P K"] | None,
) -> LowDecision:
    """Chooses actions for the sub-tasks in force, leading axis E.

    Args:
        agent: both levels.
        params: their parameters.
        book: the tasks.
        worker: the environments.
        noise: of the actions; zeros choose the mode.
        reach_values: Q(s, g, a) of what is seen, for the shield, float32 ``[E, P, K]``; ``None`` for no shield.
    """
    low = agent.low

    def one(
        view: View, instruction: Instruction, noise: Float32[Array, "*_"], reach: Float32[Array, "P K"] | None
    ) -> LowDecision:
        outputs, value = low.control(params, view, instruction)
        action, log_prob = low.actions.sample(outputs, noise)
        safe = action if reach is None else shielded_action(low, reach, instruction.avoid > 0, action)
        return LowDecision(action=safe, log_prob=log_prob, value=value, shielded=(safe != action).any())

    feasible = jax.vmap(open_edges)(task_of(book, worker.task), worker.task_state)
    decision = worker.decision
    instructions = low.instructions_at(
        params, book.instructions, (worker.task,), decision.edge, feasible, decision.ahead
    )
    return jax.vmap(one)(worker.view, instructions, noise, reach_values)


def transition(
    keys: Key[Array, " E"],
    env: Environment,
    machine: RewardMachine,
    book: TaskBook,
    worker: Worker,
    action: Int32[Array, " E"] | Float32[Array, "E A"],
) -> tuple[Worker, Outcome]:
    """Steps environments, tasks and bonus rules. Ended episodes are left as they ended."""
    params = env.default_params
    observation, env_state, _, failed, truncated, _ = jax.vmap(env.step_env, in_axes=(0, 0, 0, None))(
        keys, worker.env_state, action, params
    )
    labels = jax.vmap(env.labels, in_axes=(0, None))(env_state, params)
    task, state, edge_taken, lost, accepted = _progress(book, worker, labels)
    satisfied = (state.status == SATISFIED) & edge_taken
    # An automaton does not say what it was that let it move: whatever holds.
    reached = labels if book.automata is not None else book.tree.reach[task, state.node]
    rules, reward = jax.vmap(rewards.step, in_axes=(None, 0, 0, 0, 0, 0))(
        machine, worker.rules, labels, reached, edge_taken, satisfied | accepted
    )
    terminated = failed | (state.status != RUNNING)
    outcome = Outcome(
        labels=labels,
        node=state.node,
        edge_taken=edge_taken,
        satisfied=satisfied,
        accepted=accepted,
        reward=reward,
        terminated=terminated,
        truncated=truncated & ~terminated,
    )
    after = dataclasses.replace(
        worker,
        env_state=env_state,
        view=_views(env, observation),
        task=task,
        task_state=state,
        awaiting=edge_taken | lost,
        rules=rules,
    )
    return after, outcome


def _progress(
    book: TaskBook, worker: Worker, labels: Bool[Array, "E P"]
) -> tuple[Int32[Array, " E"], TaskState, Bool[Array, " E"], Bool[Array, " E"], Bool[Array, " E"]]:
    """Rows of the book after one step, and the tasks' states.

    And whether they moved, whether the edge in force is lost, and whether a round of a task that goes on is complete.
    """
    edge = worker.decision.edge
    if book.automata is None:
        state = jax.vmap(advance)(task_of(book, worker.task), worker.task_state, labels, edge)
        lost = jnp.take_along_axis(state.blocked, edge[:, None], 1)[:, 0]
        return worker.task, state, state.node != worker.task_state.node, lost, jnp.zeros_like(lost)
    tree, jumping = task_of(book, worker.task), edge
    held = jax.vmap(holding)(tree, worker.task_state, labels)
    if held is not None and tree.hold is not None:  # where it has not held for long enough there is no jump yet
        long_enough = jnp.take_along_axis(held >= tree.hold, edge[:, None], 1)[:, 0]
        jumping = jnp.where(long_enough, edge, TaskTree.NO_NODE)
    task, accepted = jax.vmap(book.automata.advance)(worker.task, labels, jumping)
    state = dataclasses.replace(jax.vmap(initial)(task_of(book, task)), status=book.automata.status[task])
    if held is not None:
        state = dataclasses.replace(state, held=jnp.where((task == worker.task)[:, None], held, 0))
    return task, state, (task != worker.task) | accepted, jnp.zeros_like(accepted), accepted


def _views(env: Environment, observation: Float32[Array, "E ..."]) -> View:
    return jax.vmap(lambda x: view_of(env, x))(observation)
