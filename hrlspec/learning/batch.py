"""From trajectories to training batches: original and relabelled experience under one roof.

A relabelled copy of an environment's rollout is treated as one more environment, so that both levels train on
originals and copies with the same code.

Axes: **V** environments and relabelled copies, **T** time steps, **S** episodes (slots), **N** tree nodes,
**P** atomic propositions, **B** decisions.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from hrlspec.agent.agent import Agent, Params, TaskBook, View, in_groups
from hrlspec.agent.distributions import Categorical
from hrlspec.config import Config
from hrlspec.learning import ppo
from hrlspec.learning.relabel import Record, Relabelled, relabel, visits
from hrlspec.learning.rollout import Trajectory
from hrlspec.learning.targets import low_level_targets, planner_targets
from hrlspec.spec import TaskState, TaskTree, initial
from hrlspec.tasks.rewards import RewardMachine


@struct.dataclass
class LowBatch:
    """Low-level samples; leading axes ``[V, T]``, but for ``tree``, which is ``[V, S, ...]``."""

    tree: TaskTree
    view: View
    slot: jax.Array  # int32, which of the trees
    edge: jax.Array  # int32, the assigned edge
    ahead: jax.Array  # float32 [..., D, P], what was to be reached after it
    feasible: jax.Array  # bool [..., N], the open edges; empty unless the low level is told the whole task
    action: jax.Array  # int32, or float32 [..., A]
    log_prob: jax.Array  # float32, what the ratio is taken to
    advantage: jax.Array  # float32
    target: jax.Array  # float32
    on_policy: jax.Array  # bool, counts in the policy loss
    valid: jax.Array  # bool, counts at all


@struct.dataclass
class PlanBatch:
    """Planner samples; leading axis B."""

    tree: TaskTree
    view: View
    node: jax.Array  # int32
    blocked: jax.Array  # bool [B, N]
    edge: jax.Array  # int32, the edge that was assigned
    log_prob: jax.Array  # float32
    advantage: jax.Array  # float32
    target: jax.Array  # float32
    reached: jax.Array  # bool [B, P], p₊ of the sub-task that was completed
    next_view: View  # observation when it was
    completed: jax.Array  # bool, it was, within the episode
    advice: jax.Array  # float32 [B, N], what the low level said of each edge; zeros when not used
    valid: jax.Array  # bool
    chosen: jax.Array  # bool, counts in the policy loss


def build(
    key: jax.Array,
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    book: TaskBook,
    trajectory: Trajectory,
    reserved: jax.Array,
) -> tuple[LowBatch, PlanBatch]:
    """Relabels, computes the targets of both levels, and picks the planner's samples. The key is consumed."""
    config = agent.config
    num_slots = config.episode_slots
    relabel_key, pick_key = jax.random.split(key)
    by_env = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), trajectory)
    num_copies = round(config.relabel.share * config.num_envs)
    parts = [_originals(config, book, by_env, num_slots)]
    if num_copies:
        offset = jax.random.randint(relabel_key, (), 0, config.num_envs)
        chosen = (offset + jnp.arange(num_copies)) % config.num_envs
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(relabel_key, chosen)
        some = jax.tree.map(lambda x: x[chosen], by_env)
        parts.append(_copies(keys, agent, params, machine, book, some, reserved, num_slots))
    merged = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    return _with_targets(pick_key, config, merged)


@struct.dataclass
class _Experience:
    """Experience before targets; leading axes ``[V, T]``, ``tree`` ``[V, S, ...]``."""

    tree: TaskTree
    view: View
    slot: jax.Array
    node: jax.Array
    blocked: jax.Array
    edge: jax.Array
    ahead: jax.Array
    feasible: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    decided: jax.Array
    plan_log_prob: jax.Array
    plan_value: jax.Array
    advice: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    bootstrap: jax.Array
    plan_bootstrap: jax.Array
    edge_taken: jax.Array
    reached: jax.Array
    goal: jax.Array
    on_policy: jax.Array
    choice: jax.Array
    valid: jax.Array


def _originals(config: Config, book: TaskBook, rollout: Trajectory, num_slots: int) -> _Experience:
    """The rollout as it was, ``[E, T]``; episodes beyond the last slot are marked invalid."""
    envs = jnp.arange(rollout.episode.shape[0])[:, None]
    tasks = jnp.zeros((envs.shape[0], num_slots), jnp.int32)
    tasks = tasks.at[envs, rollout.episode].set(rollout.task, mode="drop")
    valid = rollout.episode < num_slots
    edges = book.tree.valid[rollout.task] & (book.tree.parent[rollout.task] == rollout.node[..., None])
    return _Experience(
        tree=jax.tree.map(lambda x: x[tasks], book.tree),
        view=rollout.view,
        slot=jnp.minimum(rollout.episode, num_slots - 1),
        node=rollout.node,
        blocked=rollout.blocked,
        edge=rollout.assigned,
        ahead=rollout.ahead,
        feasible=_kept(config, edges & ~rollout.blocked),
        action=rollout.action,
        log_prob=rollout.log_prob,
        value=rollout.value,
        decided=rollout.decided,
        plan_log_prob=rollout.plan_log_prob,
        plan_value=rollout.plan_value,
        advice=rollout.advice,
        reward=rollout.reward,
        terminated=rollout.terminated,
        truncated=rollout.truncated,
        bootstrap=rollout.bootstrap,
        plan_bootstrap=rollout.plan_bootstrap,
        edge_taken=rollout.edge_taken,
        reached=book.tree.reach[rollout.task, rollout.edge],
        goal=book.tree.reach[rollout.task, rollout.assigned],
        on_policy=valid & ~rollout.shielded,
        choice=jnp.ones_like(valid),
        valid=valid,
    )


def _copies(
    keys: jax.Array,
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    book: TaskBook,
    rollout: Trajectory,
    reserved: jax.Array,
    num_slots: int,
) -> _Experience:
    """Relabelled copies of the given environments' rollouts, with both levels' opinion of them under the new tasks."""
    config = agent.config
    num_nodes = config.curriculum.max_nodes
    record = Record(
        slot=rollout.episode,
        labels=rollout.labels,
        edge_taken=rollout.edge_taken,
        reach=book.tree.reach[rollout.task, rollout.edge],
        avoid=book.tree.avoid[rollout.task, rollout.edge],
    )

    def one(key: jax.Array, record: Record) -> Relabelled:
        return relabel(
            key,
            record,
            machine,
            reserved,
            num_slots=num_slots,
            max_path=config.curriculum.levels,
            max_nodes=num_nodes,
            max_avoid=config.curriculum.max_avoid,
            branch=config.relabel.branch,
        )

    if config.relabel.visits:
        record = jax.vmap(visits)(record)
    new = jax.vmap(one)(keys, record)
    copies, num_steps = rollout.episode.shape
    slot = jnp.minimum(rollout.episode, num_slots - 1)
    flat = jax.tree.map(lambda x: x.reshape((copies * num_slots, *x.shape[2:])), new.tree)
    fresh = agent.open_book(params, flat)
    row = (jnp.arange(copies)[:, None] * num_slots + slot).reshape(-1)
    edge = new.assigned.reshape(-1)
    view = jax.tree.map(lambda x: x.reshape((copies * num_steps, *x.shape[2:])), rollout.view)
    node = new.node.reshape(-1)
    feasible = fresh.tree.valid[row] & (fresh.tree.parent[row] == node[:, None])
    told = agent.told_now(params, fresh.told, (row,), edge, feasible, fresh.told.ahead[row, edge])
    if config.network.advice and config.future_embedding:
        # The plan of a relabelled task is the path that was completed; its nodes follow one another.
        later = edge[:, None] + 1 + jnp.arange(told.ahead.shape[1])
        on_path = later <= new.path_length.reshape(-1)[row][:, None]
        ahead = fresh.tree.reach[row[:, None], jnp.minimum(later, num_nodes - 1)] & on_path[..., None]
        told = dataclasses.replace(told, ahead=ahead.astype(jnp.float32))
    outputs, value = jax.vmap(agent.control, in_axes=(None, 0, 0))(params, view, told)
    action = rollout.action.reshape((copies * num_steps, *rollout.action.shape[2:]))
    log_prob = jax.vmap(agent.actions.log_prob)(outputs, action)

    # A copy ends in success, its returns are known: the planner's opinion is asked only where something depends on it.
    asked = config.relabel.planner_policy or config.max_operator

    def plan(inputs: tuple[View, jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        view, row, node, edge = inputs
        tree, told = jax.tree.map(lambda x: x[row], (fresh.tree, fresh.told))
        state = dataclasses.replace(jax.vmap(initial)(tree), node=node)
        if not asked:
            advice, _ = agent.advise(params, view, tree, state, told)
            return jnp.zeros(row.shape), jnp.zeros(row.shape), advice
        logits, value, advice, _ = agent.plan_ahead(params, view, tree, state, told)
        return jax.vmap(Categorical(logits.shape[-1]).log_prob)(logits, edge), value, advice

    decided = new.decided.reshape(-1)
    nothing = jnp.zeros(decided.shape)
    inputs = (view, row, node, edge)
    unknown = nothing, nothing, jnp.zeros((*decided.shape, num_nodes))
    plan_log_prob, plan_value, advice = in_groups(plan, decided, inputs, unknown, group=128)

    def shaped(x: jax.Array) -> jax.Array:
        return x.reshape((copies, num_steps, *x.shape[1:]))

    return _Experience(
        tree=new.tree,
        view=rollout.view,
        slot=slot,
        node=new.node,
        blocked=jnp.zeros((copies, num_steps, num_nodes), bool),
        edge=new.assigned,
        ahead=shaped(told.ahead),
        feasible=_kept(config, shaped(feasible)),
        action=rollout.action,
        log_prob=rollout.log_prob if config.relabel.corrected else shaped(log_prob),
        value=shaped(value),
        decided=new.decided,
        plan_log_prob=jnp.zeros_like(new.reward) if config.relabel.corrected else shaped(plan_log_prob),
        plan_value=shaped(plan_value),
        advice=shaped(advice),
        reward=new.reward,
        terminated=new.terminated | ~new.valid,
        truncated=jnp.zeros_like(new.valid),
        bootstrap=jnp.zeros_like(new.reward),
        plan_bootstrap=jnp.zeros_like(new.reward),
        edge_taken=record.edge_taken & new.valid,
        reached=record.reach,
        goal=record.reach,
        on_policy=new.valid & ~rollout.shielded,
        choice=jnp.full_like(new.valid, config.relabel.planner_policy),
        valid=new.valid,
    )


def _kept(config: Config, feasible: jax.Array) -> jax.Array:
    """Open edges ``[..., N]`` where the low level is told of them."""
    return feasible if config.network.whole_task else feasible[..., :0]


def _of_options(x: _Experience) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Reward and ends as options see them: each is over when its sub-task is, and earns 1 if it reached its goal."""
    reached = x.edge_taken & (x.reached == x.goal).all(-1)
    over = x.edge_taken | x.terminated | jnp.roll(x.decided, -1, 1).at[:, -1].set(False)
    return reached.astype(jnp.float32), over, x.truncated


def _with_targets(key: jax.Array, config: Config, x: _Experience) -> tuple[LowBatch, PlanBatch]:
    """Targets of both levels, and the planner's share of the decisions."""

    def in_time(*arrays: jax.Array) -> tuple[jax.Array, ...]:
        return tuple(jnp.swapaxes(a, 0, 1) for a in arrays)

    ends = in_time(x.reward, x.terminated, x.truncated)
    target = low_level_targets(
        *(in_time(*_of_options(x)) if config.options else ends),
        *in_time(x.value, x.bootstrap, x.decided, x.plan_value),
        discount=config.discount,
        gae_lambda=config.low.gae_lambda,
        max_operator=config.max_operator,
    ).T
    plan_advantage, plan_target = planner_targets(
        *ends,
        *in_time(x.decided, x.plan_value, x.plan_bootstrap),
        discount=config.discount,
        gae_lambda=jnp.where(x.choice.T, config.high.gae_lambda, 1.0),
    )
    plan_advantage = ppo.relative(plan_advantage.T, x.plan_value, config.high)
    low = LowBatch(
        tree=x.tree,
        view=x.view,
        slot=x.slot,
        edge=x.edge,
        ahead=x.ahead,
        feasible=x.feasible,
        action=x.action,
        log_prob=x.log_prob,
        advantage=ppo.relative(target - x.value, x.value, config.low),
        target=target,
        on_policy=x.on_policy,
        valid=x.valid,
    )
    return low, _pick_decisions(key, config, x, plan_advantage, plan_target.T)


def _pick_decisions(
    key: jax.Array, config: Config, x: _Experience, advantage: jax.Array, target: jax.Array
) -> PlanBatch:
    """A random subset of the decisions, of fixed size B; when there are fewer, the rest is marked invalid."""
    num_rows, num_steps = x.decided.shape
    step = jnp.arange(num_steps)
    # The first completion and the first end of a sub-task at or after each step.
    ended = x.edge_taken | x.terminated | x.truncated | jnp.roll(x.decided, -1, 1)
    end = jax.lax.cummin(jnp.where(ended, step, num_steps), axis=1, reverse=True)
    last = jnp.minimum(end, num_steps - 1)
    completed = (end < num_steps) & jnp.take_along_axis(x.edge_taken, last, 1)
    wanted = x.decided & x.valid & (completed | config.unfinished)
    lottery = jnp.where(wanted, jax.random.uniform(key, wanted.shape), -1.0).reshape(-1)
    size = min(config.steps_per_iteration // config.planner_share, num_rows * num_steps)
    score, index = jax.lax.top_k(lottery, size)
    row, time = index // num_steps, index % num_steps
    end = last[row, time]
    after = jnp.minimum(end + 1, num_steps - 1)
    goes_on = completed[row, time] & (end + 1 < num_steps) & ~(x.terminated | x.truncated)[row, end]
    slot = x.slot[row, time]
    return PlanBatch(
        tree=jax.tree.map(lambda a: a[row, slot], x.tree),
        view=jax.tree.map(lambda a: a[row, time], x.view),
        node=x.node[row, time],
        blocked=x.blocked[row, time],
        edge=x.edge[row, time],
        log_prob=x.plan_log_prob[row, time],
        advantage=advantage[row, time],
        target=target[row, time],
        reached=x.reached[row, end],
        next_view=jax.tree.map(lambda a: a[row, after], x.view),
        completed=goes_on,
        advice=x.advice[row, time],
        valid=score >= 0,
        chosen=(score >= 0) & x.choice[row, time],
    )


def plan_state(batch: PlanBatch) -> TaskState:
    """The task states of planner samples (leading axis B)."""
    state = jax.vmap(initial)(batch.tree)
    return dataclasses.replace(state, node=batch.node, blocked=batch.blocked)
