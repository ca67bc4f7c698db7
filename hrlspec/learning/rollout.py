"""Collecting experience: E environments, T steps, one scan.

Axes: **T** time steps, **E** environments, **S** layouts of an environment's pool, **M** tasks, **N** tree nodes,
**P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from hrlspec.agent.agent import Agent, Params, TaskBook, View
from hrlspec.agent.interaction import Decision, Worker, act, plan_where, restart_where, transition
from hrlspec.spec import TaskTree
from hrlspec.tasks import curriculum
from hrlspec.tasks.rewards import RewardMachine


@struct.dataclass
class Trajectory:
    """What was collected; every field has leading axes ``[T, E]``. "Before" and "after" are relative to the step."""

    view: View  # observation before
    task: jax.Array  # int32, row of the task book
    episode: jax.Array  # int32, which episode of this rollout, 0-based
    node: jax.Array  # int32, task node before
    blocked: jax.Array  # bool [..., N], blocked edges before
    assigned: jax.Array  # int32, edge pursued
    ahead: jax.Array  # float32 [..., D, P], what the planner meant to reach after it
    decided: jax.Array  # bool, the planner decided before
    since: jax.Array  # int32, steps since the edge was assigned
    plan_log_prob: jax.Array  # float32, where decided
    plan_value: jax.Array  # float32, where decided
    advice: jax.Array  # float32 [..., N], where decided
    action: jax.Array  # int32, or float32 [..., A]
    log_prob: jax.Array  # float32
    value: jax.Array  # float32
    shielded: jax.Array  # bool, the shield replaced the action
    labels: jax.Array  # bool [..., P], after
    edge: jax.Array  # int32, node whose edge was taken, or the node before when none was
    edge_taken: jax.Array  # bool
    reward: jax.Array  # float32
    terminated: jax.Array  # bool
    truncated: jax.Array  # bool
    bootstrap: jax.Array  # float32, low level's value after; where truncated and at T - 1
    plan_bootstrap: jax.Array  # float32, planner's value after; likewise
    reach_value: jax.Array  # float32 [..., P], reach critic's value after, before any reset; empty without a shield
    satisfied: jax.Array  # bool
    level: jax.Array  # int32, curriculum level of the task


@struct.dataclass
class Pool:
    """What the next episodes start with, leading axes ``[E, S]``; environment e takes its S entries in turn."""

    layout: Any
    task: jax.Array  # int32, row of the task book
    level: jax.Array  # int32, its curriculum level


@struct.dataclass
class Collector:
    """What goes on from one rollout to the next; leading axis E."""

    worker: Worker
    decision: Decision  # made for the state that the worker is in
    level: jax.Array  # int32 [E], curriculum level of each task
    started: jax.Array  # int32 [E], episodes started so far, for the pool
    since: jax.Array  # int32 [E], steps since the sub-task in force was assigned


def fill_pool(key: jax.Array, agent: Agent, book: TaskBook, level: jax.Array, size: int) -> Pool:
    """Draws tasks of the curriculum's levels and layouts for them, ``size`` for each environment. The key is consumed.

    A share ``contested`` of the layouts is contested, in environments that know how to draw such layouts.
    """
    config = agent.config.curriculum
    env: Any = agent.env  # to draw contested layouts is no duty of environments
    selective = config.contested > 0 and hasattr(env, "contested_layout")

    def draw(key: jax.Array, task: jax.Array, wanted: jax.Array) -> Any:
        if not selective:
            return env.sample_layout(key, env.default_params)
        first, second = opening(jax.tree.map(lambda x: x[task], book.tree))
        return env.contested_layout(key, first & wanted, second & wanted, env.default_params)

    def one(index: jax.Array) -> Pool:
        keys = jax.random.split(jax.random.fold_in(key, index), size + 1)
        chance = jax.random.uniform(keys[size], (4, size))
        levels = curriculum.draw_levels(chance[:2], level, config.earlier)
        rows = (chance[2] * config.tasks_per_level).astype(jnp.int32)
        tasks = agent.config.num_envs + levels * config.tasks_per_level + rows
        layouts = jax.vmap(draw)(keys[:size], tasks, chance[3] < config.contested)
        return Pool(layout=layouts, task=tasks, level=levels)

    return jax.vmap(one)(jnp.arange(agent.config.num_envs))


def opening(tree: TaskTree) -> tuple[jax.Array, jax.Array]:
    """What a task's first edge reaches and what the first edge after it does, bool ``[P]`` each; all false if none."""
    second = (tree.parent == 1) & tree.valid
    return tree.reach[1], tree.reach[jnp.argmax(second)] & second.any()


def collect(
    key: jax.Array,
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    book: TaskBook,
    collector: Collector,
    pool: Pool,
    correlation: jax.Array | float,
) -> tuple[Collector, Trajectory]:
    """Rolls out E×T steps. Workers come and go with a sub-task assigned: decisions are made at the end of a step.

    Args:
        key: consumed; every environment's randomness derives from its index.
        agent: the networks.
        params: their parameters.
        machine: the rewards.
        book: tasks: the E running ones, then the bank, level by level.
        collector: where the last rollout stopped.
        pool: what the next episodes start with.
        correlation: of the noise of successive steps, for continuous actions, float32 ``[]``.
    """
    config = agent.config
    num_envs, num_nodes = config.num_envs, book.tree.parent.shape[-1]
    pool_size = pool.task.shape[1]
    envs = jnp.arange(num_envs)

    def randomness(env: jax.Array) -> tuple[jax.Array, ...]:
        keys = jax.random.split(jax.random.fold_in(key, env), 3)
        return (
            jax.random.gumbel(keys[0], (config.num_steps, num_nodes)),
            agent.actions.noise_sequence(keys[1], config.num_steps, correlation),
            jax.random.split(keys[2], config.num_steps),
        )

    def reach_value(params: Params, view: View) -> jax.Array:
        if config.shield.mode == "off":
            return jnp.zeros((num_envs, 0))
        return jax.vmap(agent.reach_values, in_axes=(None, 0))(params, view).max(-1)

    def step(collector: Collector, inputs: tuple[jax.Array, ...]) -> tuple[Collector, Trajectory]:
        plan_noise, noise, keys, last = inputs
        before, decision = collector.worker, collector.decision
        action, log_prob, value, shielded = act(agent, params, book, before, noise, shield=config.shield.mode != "off")
        step_keys, reset_keys = jax.vmap(jax.random.split, out_axes=1)(keys)
        worker, outcome = transition(agent, machine, book, before, action, step_keys)
        ended = outcome.terminated | outcome.truncated
        started = collector.started + ended
        fresh = jax.tree.map(lambda x: x[envs, started % pool_size], pool)
        after = restart_where(agent, machine, worker, ended, fresh.layout, fresh.task, reset_keys, book)
        # One pass of the planner serves the decisions that are due, the values of truncated states, and in the end
        # those of all states reached: compiled once.
        both = jax.tree.map(lambda *x: jnp.concatenate(x), after, worker)
        needed = jnp.concatenate([after.awaiting | last, outcome.truncated])
        plan_noise = jnp.concatenate([plan_noise, jnp.zeros_like(plan_noise)])
        choice, ahead, planned = plan_where(agent, params, book, both, needed, plan_noise)
        choice = jnp.where(after.awaiting, choice[:num_envs], after.assigned)
        ahead = jnp.where(after.awaiting[:, None, None], ahead[:num_envs], after.ahead)
        bootstrap = jnp.where(outcome.truncated, planned.value[num_envs:], planned.value[:num_envs])
        record = Trajectory(
            view=before.view,
            task=before.task,
            episode=collector.started,
            node=before.task_state.node,
            blocked=before.task_state.blocked,
            assigned=before.assigned,
            ahead=before.ahead,
            decided=decision.made,
            since=collector.since,
            plan_log_prob=decision.log_prob,
            plan_value=decision.value,
            advice=decision.advice,
            action=action,
            log_prob=log_prob,
            value=value,
            shielded=shielded,
            labels=outcome.labels,
            edge=worker.task_state.node,
            edge_taken=outcome.edge_taken,
            reward=outcome.reward,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            bootstrap=bootstrap,
            plan_bootstrap=bootstrap,
            reach_value=reach_value(params, worker.view),
            satisfied=outcome.satisfied,
            level=collector.level,
        )
        collector = Collector(
            worker=dataclasses.replace(after, assigned=choice, ahead=ahead, awaiting=jnp.zeros(num_envs, bool)),
            decision=dataclasses.replace(jax.tree.map(lambda x: x[:num_envs], planned), made=after.awaiting),
            level=jnp.where(ended, fresh.level, collector.level),
            started=started,
            since=jnp.where(after.awaiting, 0, collector.since + 1),
        )
        return collector, record

    last = jnp.arange(config.num_steps) == config.num_steps - 1
    inputs = (*jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), jax.vmap(randomness)(envs)), last)
    collector = dataclasses.replace(collector, started=jnp.zeros(num_envs, jnp.int32))
    collector, trajectory = jax.lax.scan(step, collector, inputs)
    worker = collector.worker
    low = act(agent, params, book, worker, jnp.zeros((num_envs, *agent.actions.noise_shape)), shield=False)[2]
    low = jnp.where(trajectory.truncated[-1], trajectory.bootstrap[-1], low)
    return collector, dataclasses.replace(trajectory, bootstrap=trajectory.bootstrap.at[-1].set(low))
