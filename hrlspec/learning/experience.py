"""From rollouts to experience: the transitions collected, and relabelled copies of them.

A relabelled copy of an environment's rollout counts as one more environment, so that both levels learn from originals
and copies with the same code.

Axes: **V** environments and relabelled copies, **E** environments, **T** time steps, **S** episodes (slots), **N** tree
nodes, **P** atomic propositions, **R** rows: V·T steps one after the other, **L** blocks of environments
(`hrlspec.learning.shards`).
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Int32, Key, Shaped, UInt32

from envs_jax.arrays import Array
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import Bootstrap, Experience, HighDecision, LowDecision, Outcome, Step, View, flat
from hrlspec.agent.groups import in_groups, take
from hrlspec.agent.high_level import Judgement
from hrlspec.agent.low_level import Params, TaskBook
from hrlspec.agent.networks.controller import Instruction
from hrlspec.learning.relabel import Record, Relabelled, relabel, visits
from hrlspec.learning.rollout import JUDGED_AT_ONCE
from hrlspec.spec import RUNNING, TaskState, initial
from hrlspec.tasks.rewards import RewardMachine


def gather(
    key: Key[Array, ""],
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    book: TaskBook,
    steps: Step,
    reserved: UInt32[Array, " M"],
    envs: Int32[Array, " E"],
) -> Experience:
    """A rollout ``[T, E]`` and relabelled copies of a share of its environments, block by block, ``[L, V, T]``.

    Args:
        key: of the relabelling; consumed.
        agent: both levels.
        params: their parameters.
        machine: the rewards.
        book: the tasks of the rollout.
        steps: the rollout.
        reserved: uint32, sorted hashes of held-out tasks, which relabelling must not produce.
        envs: int32 ``[E]``, which environments these are.
    """
    config = agent.config
    by_env = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), steps)
    parts = [originals(book, by_env, config.episode_slots)]
    if config.copies_per_block:
        offset = jax.random.randint(key, (), 0, config.envs_per_block, jnp.int32)
        within = (offset + jnp.arange(config.copies_per_block, dtype=jnp.int32)) % config.envs_per_block
        chosen = (jnp.arange(0, len(envs), config.envs_per_block, dtype=jnp.int32)[:, None] + within).reshape(-1)
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, envs[chosen])
        some = take(by_env, chosen)
        parts.append(copies(keys, agent, params, machine, book, some, reserved))

    num_blocks = len(envs) // config.envs_per_block

    def by_block(x: Shaped[Array, "rows ..."]) -> Shaped[Array, "L rows_of_block ..."]:
        return x.reshape((num_blocks, len(x) // num_blocks, *x.shape[1:]))

    merged: Experience = jax.tree.map(lambda *x: jnp.concatenate([by_block(some) for some in x], 1), *parts)
    return merged


def originals(book: TaskBook, rollout: Step, num_slots: int) -> Experience:
    """The rollout as it was, ``[E, T]``; episodes beyond the last slot are marked invalid."""
    envs = jnp.arange(rollout.episode.shape[0], dtype=jnp.int32)[:, None]
    tasks = jnp.zeros((envs.shape[0], num_slots), jnp.int32)
    tasks = tasks.at[envs, rollout.episode].set(rollout.task, mode="drop")
    valid = rollout.episode < num_slots
    return Experience(
        trees=take(book.tree, tasks),
        slot=jnp.minimum(rollout.episode, num_slots - 1),
        view=rollout.view,
        state=rollout.state,
        high=rollout.high,
        low=rollout.low,
        outcome=rollout.outcome,
        bootstrap=rollout.bootstrap,
        goal=book.tree.reach[rollout.task, rollout.high.edge],
        reached=book.tree.reach[rollout.task, rollout.outcome.node],
        learns_low=valid & ~rollout.low.shielded,
        learns_high=jnp.ones_like(valid),
        valid=valid,
    )


def copies(
    keys: Key[Array, " E"],
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    book: TaskBook,
    rollout: Step,
    reserved: UInt32[Array, " M"],
) -> Experience:
    """Relabelled copies of the given environments' rollouts, with both levels' estimates under the new tasks."""
    record = _record(agent, book, rollout)
    new = _relabelled(keys, agent, machine, record, reserved)
    slot = jnp.minimum(rollout.episode, new.tree.parent.shape[1] - 1)
    high, low = _estimates(agent, params, rollout, new, slot)
    shape, nothing = slot.shape, jnp.zeros_like(new.reward)
    hold = None if book.tree.hold is None else jnp.ones(new.tree.parent.shape, jnp.int32)
    blocked = jnp.zeros((*shape, new.tree.num_nodes), bool)
    return Experience(
        trees=dataclasses.replace(new.tree, hold=hold),
        slot=slot,
        view=rollout.view,
        state=TaskState(node=new.node, blocked=blocked, status=jnp.full(shape, RUNNING, jnp.int32)),
        high=high,
        low=low,
        outcome=Outcome(
            labels=rollout.outcome.labels,
            node=new.assigned,
            edge_taken=record.edge_taken & new.valid,
            satisfied=new.terminated,
            accepted=jnp.zeros_like(new.valid),
            reward=new.reward,
            terminated=new.terminated | ~new.valid,
            truncated=jnp.zeros_like(new.valid),
        ),
        bootstrap=Bootstrap(low=nothing, high=nothing),
        goal=record.reach,
        reached=record.reach,
        learns_low=new.valid & ~rollout.low.shielded,
        learns_high=jnp.full_like(new.valid, agent.high.learns_from_copies),
        valid=new.valid,
    )


def _estimates(
    agent: Agent, params: Params, rollout: Step, new: Relabelled, slot: Int32[Array, "E T"]
) -> tuple[HighDecision, LowDecision]:
    """The recorded decisions with both levels' values under the new tasks.

    PPO's ratio is taken to the probability with which an action was drawn, under the old task. A path was no choice of
    the high level: its ratio is taken to 1.
    """
    row = (jnp.arange(slot.shape[0], dtype=jnp.int32)[:, None] * new.tree.parent.shape[1] + slot).reshape(-1)
    fresh = agent.low.prepare(params, jax.tree.map(flat, new.tree))
    view, edge, node = jax.tree.map(flat, (rollout.view, new.assigned, new.node))
    instructions = _instructions(agent, params, fresh, row, edge, node, new)
    _, value = jax.vmap(agent.low.control, in_axes=(None, 0, 0))(params, view, instructions)
    judgement = _judged(agent, params, fresh, view, row, node, flat(new.decided))
    # The completed path is the one that counts; its nodes follow one another.
    judgement = judgement._replace(leaf=flat(jnp.take_along_axis(new.path_length, slot, 1)))

    def shaped(x: Shaped[Array, "R ..."]) -> Shaped[Array, "E T ..."]:
        return x.reshape((*slot.shape, *x.shape[1:]))

    high = HighDecision(
        made=new.decided,
        edge=new.assigned,
        ahead=shaped(instructions.ahead),
        log_prob=jnp.zeros_like(new.reward),
        value=shaped(judgement.value),
        advice=shaped(judgement.advice),
        leaf=shaped(judgement.leaf),
    )
    low = LowDecision(
        action=rollout.low.action,
        log_prob=rollout.low.log_prob,
        value=shaped(value),
        shielded=rollout.low.shielded,
    )
    return high, low


def _record(agent: Agent, book: TaskBook, rollout: Step) -> Record:
    """What relabelling needs, ``[E, T]``."""
    edge = rollout.outcome.node
    at = rollout.task, edge
    # What held for a while was met long before it was completed.
    kept = True if book.tree.hold is None else book.tree.hold[at] == 1
    record = Record(
        slot=rollout.episode,
        labels=rollout.outcome.labels,
        edge_taken=rollout.outcome.edge_taken & kept,
        reach=book.tree.reach[at],
        avoid=book.tree.avoid[at],
    )
    return jax.vmap(visits)(record) if agent.config.relabel.hindsight else record


def _relabelled(
    keys: Key[Array, " E"], agent: Agent, machine: RewardMachine, record: Record, reserved: UInt32[Array, " M"]
) -> Relabelled:
    """The new tasks, leading axis E."""
    config = agent.config

    def one(key: Key[Array, ""], record: Record) -> Relabelled:
        return relabel(
            key,
            record,
            machine,
            reserved,
            num_slots=config.episode_slots,
            max_path=config.curriculum.levels,
            max_nodes=config.curriculum.max_nodes,
            max_avoid=config.curriculum.max_avoid,
            branch=config.relabel.branch,
        )

    return jax.vmap(one)(keys, record)


def _instructions(
    agent: Agent,
    params: Params,
    fresh: TaskBook,
    row: Int32[Array, " R"],
    edge: Int32[Array, " R"],
    node: Int32[Array, " R"],
    new: Relabelled,
) -> Instruction:
    """The low level's instructions under the new tasks, leading axis R."""
    tree = fresh.tree
    feasible = tree.valid[row] & (tree.parent[row] == node[:, None])
    instructions = agent.low.instructions_at(
        params, fresh.instructions, (row,), edge, feasible, fresh.instructions.ahead[row, edge]
    )
    if agent.high.follows_plan and agent.method.sees == "future":
        # The plan of a relabelled task is the path that was completed; its nodes follow one another.
        later = edge[:, None] + 1 + jnp.arange(instructions.ahead.shape[1], dtype=jnp.int32)
        on_path = later <= new.path_length.reshape(-1)[row][:, None]
        ahead = tree.reach[row[:, None], jnp.minimum(later, tree.num_nodes - 1)] & on_path[..., None]
        instructions = dataclasses.replace(instructions, ahead=ahead.astype(jnp.float32))
    return instructions


def _judged(
    agent: Agent,
    params: Params,
    fresh: TaskBook,
    view: View,
    row: Int32[Array, " R"],
    node: Int32[Array, " R"],
    decided: Bool[Array, " R"],
) -> Judgement:
    """The high level's estimates of the completed path's choices, leading axis R; zeros where there was none."""

    def judge(inputs: tuple[View, Array, Array]) -> Judgement:
        view, row, node = inputs
        tree, instructions = take((fresh.tree, fresh.instructions), row)
        state = dataclasses.replace(jax.vmap(initial)(tree), node=node)
        return agent.high.judge(agent.low, params, view, tree, state, instructions)

    nothing = jnp.zeros(decided.shape, jnp.float32)
    unknown = Judgement(
        nothing, jnp.zeros((*decided.shape, fresh.tree.num_nodes), jnp.float32), nothing.astype(jnp.int32)
    )
    if agent.high.ppo is None:
        return unknown
    return in_groups(judge, decided, (view, row, node), unknown, JUDGED_AT_ONCE)
