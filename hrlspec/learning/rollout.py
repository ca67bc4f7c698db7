"""Collecting experience: E environments, T steps, one scan.

Axes: **T** time steps, **E** environments, **S** layouts of an environment's pool, **M** tasks, **N** tree nodes,
**P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Int32, Key

from envs_jax import ContestedLayouts
from envs_jax.arrays import Array
from envs_jax.base import Layout
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import Bootstrap, HighDecision, LowDecision, Step, View, flat
from hrlspec.agent.groups import if_any, in_groups, one_by_one, take, where
from hrlspec.agent.high_level import Judgement
from hrlspec.agent.interaction import Worker, act, decide, start, task_of, transition
from hrlspec.agent.low_level import Params, TaskBook
from hrlspec.spec import TaskState, TaskTree
from hrlspec.tasks import curriculum
from hrlspec.tasks.rewards import RewardMachine

JUDGED_AT_ONCE = 128
"""Decisions that the high level evaluates at a time when acting does not wait for them."""
RETRIED = -1
"""The level of an episode that was begun again: of none, for it says nothing about how hard a level's tasks are."""


@struct.dataclass
class Pool:
    """What the next episodes start with, leading axes ``[E, S]``; environment e takes its S entries in turn."""

    layout: Layout
    task: Int32[Array, "*lead S"]  # row of the task book
    level: Int32[Array, "*lead S"]  # its curriculum level


@struct.dataclass
class Collector:
    """What goes on from one rollout to the next; leading axis E."""

    worker: Worker
    level: Int32[Array, " E"]  # curriculum level of each task, or `RETRIED`
    started: Int32[Array, " E"]  # episodes started so far, for the pool
    since: Int32[Array, " E"]  # steps since the sub-task in force was assigned
    layout: Layout | None  # of the running episodes, where those that fail may be begun again


@dataclasses.dataclass(frozen=True)
class Setting:
    """What stays the same throughout a rollout.

    Attributes:
        agent: both levels.
        params: their parameters.
        machine: the rewards.
        book: tasks: the E running ones, then the bank, level by level.
        pool: what the next episodes start with.
        envs: which environments these are, int32 ``[E]``; their randomness derives from it.
    """

    agent: Agent
    params: Params
    machine: RewardMachine
    book: TaskBook
    pool: Pool
    envs: Int32[Array, " E"]


class _Chance(NamedTuple):
    """Randomness of one step, leading axis E; of a rollout, leading axes ``[T, E]``."""

    high: Float32[Array, "E N"]
    low: Float32[Array, "E ..."]
    keys: Key[Array, " E"]
    retry: Float32[Array, " E"]


def fill_pool(
    key: Key[Array, ""], agent: Agent, book: TaskBook, level: Int32[Array, ""], envs: Int32[Array, " E"], size: int
) -> Pool:
    """Draws tasks of the curriculum's levels and layouts for them, ``size`` for each environment. The key is consumed.

    A share ``contested`` of the layouts is contested, in environments that know how to draw such layouts.
    """
    config, env = agent.config.curriculum, agent.env

    def draw(key: Key[Array, ""], task: Int32[Array, ""], wanted: Bool[Array, ""]) -> Layout:
        if not config.contested or not isinstance(env, ContestedLayouts):
            return env.sample_layout(key, env.default_params)
        first, second = opening(take(book.tree, task))
        return env.contested_layout(key, first & wanted, second & wanted, env.default_params)

    def one(index: Int32[Array, ""]) -> Pool:
        keys = jax.random.split(jax.random.fold_in(key, index), size + 1)
        chance = jax.random.uniform(keys[size], (4, size), jnp.float32)
        levels = curriculum.draw_levels(chance[:2], level, config.earlier)
        rows = (chance[2] * config.tasks_per_level).astype(jnp.int32)
        tasks = envs.shape[0] + levels * config.tasks_per_level + rows
        layouts = jax.vmap(draw)(keys[:size], tasks, chance[3] < config.contested)
        return Pool(layout=layouts, task=tasks, level=levels)

    return jax.vmap(one)(envs)


def opening(tree: TaskTree) -> tuple[Bool[Array, " P"], Bool[Array, " P"]]:
    """What a task's first edge reaches and what the first edge after it does, bool ``[P]`` each; all false if none."""
    second = (tree.parent == 1) & tree.valid
    return tree.reach[1], tree.reach[jnp.argmax(second)] & second.any()


def collect(
    key: Key[Array, ""], setting: Setting, collector: Collector, correlation: Float32[Array, ""] | float
) -> tuple[Collector, Step]:
    """Rolls out E×T steps. Workers come and go with a sub-task in force: decisions are made at the end of a step.

    Args:
        key: consumed; every environment's randomness derives from its index.
        setting: agent, parameters, rewards and tasks.
        collector: where the last rollout stopped.
        correlation: of the noise of successive steps, for continuous actions, float32 ``[]``.

    Returns:
        Where this one stopped, and its steps, leading axes ``[T, E]``.
    """
    agent = setting.agent
    num_envs = setting.envs.shape[0]
    chance = _draw(key, setting, correlation)
    collector = dataclasses.replace(collector, started=jnp.zeros(num_envs, jnp.int32))
    reach = _reach_values(setting, collector.worker.view)
    (collector, _), steps = jax.lax.scan(functools.partial(_step, setting), (collector, reach), chance)
    silence = jnp.zeros((num_envs, *agent.low.actions.noise_shape), jnp.float32)
    worth = _act(setting, collector.worker, silence, None).value
    high, value = steps.high, worth
    if agent.high.uses_values:
        high, value = _with_values(setting, steps, collector.worker, worth)
    truncated, before = steps.outcome.truncated[-1], steps.bootstrap.high
    bootstrap = jax.tree.map(lambda x: before.at[-1].set(jnp.where(truncated, before[-1], x)), Bootstrap(worth, value))
    return collector, dataclasses.replace(steps, bootstrap=bootstrap, high=high)


def _to_learn_from(state: TaskState) -> TaskState:
    """Without what neither level sees: for how long something has held."""
    return dataclasses.replace(state, held=None)


def _with_values(
    setting: Setting, steps: Step, end: Worker, worth: Float32[Array, " E"]
) -> tuple[HighDecision, Float32[Array, " E"]]:
    """V^h where acting did not wait for it: at decisions without a choice, and of the states in the end.

    A low level that is told the one way there is knows what that is worth: V^l, ``worth`` in the end, is V^h then.
    """
    agent, book = setting.agent, setting.book
    rows = jax.tree.map(flat, (steps.view, steps.task, steps.state))
    last = (end.view, end.task, _to_learn_from(end.task_state))
    settled, settled_last = (
        agent.high.settled(task_of(book, task), state, book.forks[task]) != TaskTree.NO_NODE
        for _, task, state in (rows, last)
    )

    def judge(inputs: tuple[View, Int32[Array, " B"], TaskState]) -> Judgement:
        view, task, state = inputs
        tree, instructions = take((book.tree, book.instructions), task)
        return agent.high.choose(agent.low, setting.params, view, tree, state, instructions).judgement

    high = steps.high
    made, before = jax.tree.map(flat, (high.made, Judgement(high.value, high.advice, high.leaf)))
    unknown = jax.tree.map(lambda x: jnp.zeros_like(x[: len(worth)]), before)._replace(value=worth)
    if agent.high.follows_plan and agent.method.sees == "future":
        low = flat(steps.low.value)
        known = where(
            settled, before._replace(value=low, advice=jnp.broadcast_to(low[:, None], before.advice.shape)), before
        )
        value_last = in_groups(judge, ~settled_last, last, unknown, JUDGED_AT_ONCE).value
    else:
        rows, known, asked = jax.tree.map(
            lambda *x: jnp.concatenate(x),
            (rows, before, made & settled),
            (last, unknown, jnp.ones_like(settled_last)),
        )
        known = in_groups(judge, asked, rows, known, JUDGED_AT_ONCE)
        value_last = known.value[len(made) :]
        known = jax.tree.map(lambda x: x[: len(made)], known)
    found = jax.tree.map(lambda x: x.reshape((*steps.task.shape, *x.shape[1:])), known)
    return dataclasses.replace(high, **found._asdict()), value_last


def _draw(key: Key[Array, ""], setting: Setting, correlation: Float32[Array, ""] | float) -> _Chance:
    """The randomness of a rollout, leading axes ``[T, E]``."""
    num_steps, num_nodes = setting.agent.config.num_steps, setting.book.tree.num_nodes
    actions = setting.agent.low.actions

    def one(env: Int32[Array, ""]) -> _Chance:
        keys = jax.random.split(jax.random.fold_in(key, env), 4)
        return _Chance(
            jax.random.gumbel(keys[0], (num_steps, num_nodes), jnp.float32),
            actions.noise_sequence(keys[1], num_steps, correlation),
            jax.random.split(keys[2], num_steps),
            jax.random.uniform(keys[3], (num_steps,), jnp.float32),
        )

    chance: _Chance = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), jax.vmap(one)(setting.envs))
    return chance


_Reach = Float32[Array, "E P K"] | None
"""Q(s, g, a) of the states that the next action is taken in; ``None`` without a shield."""


def _step(setting: Setting, carry: tuple[Collector, _Reach], chance: _Chance) -> tuple[tuple[Collector, _Reach], Step]:
    """One step of all environments: act, step the worlds, restart what ended, decide what is due."""
    agent, book, pool = setting.agent, setting.book, setting.pool
    collector, reach = carry
    before, num_envs = collector.worker, collector.level.shape[0]
    low = _act(setting, before, chance.low, reach)
    step_keys, reset_keys = jax.vmap(jax.random.split, out_axes=1)(chance.keys)
    worker, outcome = transition(step_keys, agent.env, setting.machine, book, before, low.action)
    ended = outcome.terminated | outcome.truncated
    started = collector.started + ended
    fresh = take(pool, jnp.arange(num_envs, dtype=jnp.int32), (started - 1) % pool.task.shape[1])
    if collector.layout is not None:
        retried = ~outcome.satisfied & (chance.retry < agent.config.curriculum.retry)
        again = Pool(collector.layout, worker.task, jnp.full_like(fresh.level, RETRIED))
        fresh = where(retried, again, fresh)
    after = if_any(lambda: start(reset_keys, agent.env, setting.machine, book, fresh.layout, fresh.task), ended, worker)
    reached = _reach_values(setting, worker.view)
    decision, bootstrap = _plan(setting, after, worker, outcome.truncated, chance.high)
    record = Step(
        view=before.view,
        task=before.task,
        level=collector.level,
        episode=collector.started,
        since=collector.since,
        state=_to_learn_from(before.task_state),
        high=before.decision,
        low=low,
        outcome=outcome,
        bootstrap=Bootstrap(low=bootstrap, high=bootstrap),
        reach_value=jnp.zeros((num_envs, 0), jnp.float32) if reached is None else reached.max(-1),
    )
    collector = Collector(
        worker=dataclasses.replace(after, decision=decision, awaiting=jnp.zeros(num_envs, bool)),
        level=jnp.where(ended, fresh.level, collector.level),
        started=started,
        since=jnp.where(after.awaiting, 0, collector.since + 1),
        layout=None if collector.layout is None else where(ended, fresh.layout, collector.layout),
    )
    if reached is not None:  # of the state that the next action is taken in: another one where an episode began
        values = functools.partial(jax.vmap(agent.low.reach_values, (None, 0)), setting.params)
        reached = in_groups(values, ended, after.view, reached, agent.config.group)
    return (collector, reached), record


def _act(setting: Setting, worker: Worker, noise: Float32[Array, "E ..."], reach: _Reach) -> LowDecision:
    """Actions, block by block, so that they do not depend on how many blocks a device has."""
    agent, rows = setting.agent, setting.agent.config.envs_per_block

    def one(block: tuple[Worker, Float32[Array, "E_of_block ..."], _Reach]) -> LowDecision:
        return act(agent, setting.params, setting.book, *block)

    if agent.config.blocks == 1:
        return one((worker, noise, reach))
    parts = jax.tree.map(lambda x: x.reshape((len(x) // rows, rows, *x.shape[1:])), (worker, noise, reach))
    decisions: LowDecision = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), one_by_one(one, parts))
    return decisions


def _plan(
    setting: Setting,
    after: Worker,
    ended: Worker,
    truncated: Bool[Array, " E"],
    noise: Float32[Array, "E N"],
) -> tuple[HighDecision, Float32[Array, " E"]]:
    """Decisions for the next step, and V^h of the states that this one truncated.

    One pass of the high level serves both: compiled once.
    """
    num_envs, due = truncated.shape[0], after.awaiting
    both = jax.tree.map(lambda *x: jnp.concatenate(x), after, ended)
    nowhere = jnp.zeros_like(due)
    valued = jnp.concatenate([nowhere, truncated])
    noise = jnp.concatenate([noise, jnp.zeros_like(noise)])
    due_of_both = jnp.concatenate([due, nowhere])
    planned = decide(setting.agent, setting.params, setting.book, both, due_of_both, noise, valued)
    bootstrap = planned.value[num_envs:]
    planned = jax.tree.map(lambda x: x[:num_envs], planned)
    in_force = after.decision
    decision = dataclasses.replace(
        planned,
        made=due,
        edge=jnp.where(due, planned.edge, in_force.edge),
        ahead=jnp.where(due[:, None, None], planned.ahead, in_force.ahead),
    )
    return decision, bootstrap


def _reach_values(setting: Setting, view: View) -> _Reach:
    """Q(s, g, a) of what is seen, where there is a shield."""
    if not setting.agent.config.shield.enabled:
        return None
    values: Float32[Array, "E P K"] = jax.vmap(setting.agent.low.reach_values, (None, 0))(setting.params, view)
    return values
