"""Training: one iteration of collection and learning as one pure function (paper, "Algorithm").

Axes: **E** environments, **T** time steps, **L** levels, **M** tasks per level, **V**, **S**, **B** as in ``batch.py``.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from hrlspec.agent.agent import Agent, Params, TaskBook
from hrlspec.agent.distributions import Categorical
from hrlspec.agent.interaction import Decision, start
from hrlspec.agent.networks.planner import MASKED
from hrlspec.config import PPOConfig
from hrlspec.learning import ppo
from hrlspec.learning.batch import LowBatch, PlanBatch, build, plan_state
from hrlspec.learning.rollout import Collector, Trajectory, collect, fill_pool
from hrlspec.methods import option as options
from hrlspec.methods.option import Measurements
from hrlspec.spec import TaskTree
from hrlspec.tasks import curriculum
from hrlspec.tasks.curriculum import Curriculum
from hrlspec.tasks.rewards import RewardMachine

Metrics = dict[str, jax.Array]


@struct.dataclass
class TrainState:
    """Everything a run needs to go on, bit for bit.

    Attributes:
        params: parameters of the three networks.
        optimisers: their optimiser states, under the same names.
        collector: running episodes.
        tasks: the tasks of those episodes, leading axis E.
        curriculum: level and window.
        key: base key; iteration i uses ``fold_in(key, i)``.
        iteration: int32 ``[]``, iterations done. Environment steps are this times E·T, multiplied in Python.
    """

    params: Params
    optimisers: dict[str, Any]
    collector: Collector
    tasks: TaskTree
    curriculum: Curriculum
    key: jax.Array
    iteration: jax.Array


@dataclasses.dataclass(frozen=True)
class Trainer:
    """Pure training functions for one agent and one reward.

    ``bank`` arguments are :func:`hrlspec.tasks.curriculum.draw_bank`'s: L·M tasks, drawn anew as often as wanted.

    Attributes:
        agent: networks, environment and configuration.
    """

    agent: Agent

    @functools.partial(jax.jit, static_argnums=0)
    def init(self, key: jax.Array, bank: TaskTree, machine: RewardMachine) -> TrainState:
        """A fresh state. The key is consumed."""
        config, env = self.agent.config, self.agent.env
        key, init_key, layout_key, reset_key, stagger_key = jax.random.split(key, 5)
        params = self.agent.init(init_key)
        envs = jnp.arange(config.num_envs)

        def keys(key: jax.Array) -> jax.Array:
            return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, envs)

        tasks = jax.tree.map(lambda x: jnp.asarray(x)[envs % config.curriculum.tasks_per_level], bank)
        layouts = jax.vmap(env.sample_layout, in_axes=(0, None))(keys(layout_key), env.default_params)
        worker = start(self.agent, machine, layouts, envs, keys(reset_key), self.agent.open_book(params, tasks))
        # Staggered clocks: episodes that fail at first would otherwise all be truncated in the same step.
        elapsed = jax.random.randint(stagger_key, (config.num_envs,), 0, env.horizon)
        worker = dataclasses.replace(
            worker, env_state=dataclasses.replace(worker.env_state, time=elapsed.astype(jnp.int32))
        )
        # The very first sub-tasks are each task's first edge: not the planner's choice, hence no decision.
        worker = dataclasses.replace(
            worker, assigned=jnp.ones(config.num_envs, jnp.int32), awaiting=jnp.zeros(config.num_envs, bool)
        )
        zeros = jnp.zeros(config.num_envs, jnp.int32)
        nothing = jnp.zeros(config.num_envs)
        advice = jnp.zeros((config.num_envs, config.curriculum.max_nodes))
        decision = Decision(made=zeros > 0, log_prob=nothing, value=nothing, advice=advice)
        transforms = self._transforms()
        return TrainState(
            params=params,
            optimisers={name: transform.init(params[name]) for name, transform in transforms.items()},
            collector=Collector(worker=worker, decision=decision, level=zeros, started=zeros, since=zeros),
            tasks=tasks,
            curriculum=curriculum.initial(),
            key=key,
            iteration=jnp.int32(0),
        )

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
    def iterate(
        self, state: TrainState, bank: TaskTree, machine: RewardMachine, reserved: jax.Array
    ) -> tuple[TrainState, Metrics]:
        """One iteration: E×T steps of collection, then updates of all networks. ``state`` is donated.

        Args:
            state: where the run stands.
            bank: training tasks, leading axis L·M.
            machine: the rewards.
            reserved: uint32, sorted hashes of held-out tasks, which relabelling must not produce.

        Returns:
            The next state and float32 metrics: ``episodes`` and ``successes`` count what ended in the rollout,
            ``returns`` is the sum of its rewards; ``violations`` and ``shielded`` per step, the level, and losses.
        """
        agent, config = self.agent, self.agent.config
        keys = jax.random.split(jax.random.fold_in(state.key, state.iteration), 5)
        book = agent.open_book(state.params, jax.tree.map(lambda *x: jnp.concatenate(x), state.tasks, bank))
        collector = dataclasses.replace(
            state.collector,
            worker=dataclasses.replace(state.collector.worker, task=jnp.arange(config.num_envs, dtype=jnp.int32)),
        )
        pool = fill_pool(keys[0], agent, book, state.curriculum.level, size=config.episode_slots)
        correlation = ppo.annealed(config.noise_correlation, config.final_noise_correlation, self._progress(state))
        collector, trajectory = collect(keys[1], agent, state.params, machine, book, collector, pool, correlation)
        low, plan = build(keys[2], agent, state.params, machine, book, trajectory, reserved)
        params, optimisers, losses = self._learn(keys[3], state, low, plan, trajectory)
        if config.options:
            params["options"] = measured(params["options"], book, trajectory, config.discount)
        ended = trajectory.terminated | trajectory.truncated
        current = ended & (trajectory.level == state.curriculum.level)
        new_curriculum = curriculum.update(
            state.curriculum, current.sum(), (current & trajectory.satisfied).sum(), config.curriculum
        )
        metrics = losses | _summary(trajectory, ended) | {"level": 1.0 + state.curriculum.level}
        new_state = TrainState(
            params=params,
            optimisers=optimisers,
            collector=collector,
            tasks=jax.tree.map(lambda x: x[collector.worker.task], book.tree),
            curriculum=new_curriculum,
            key=state.key,
            iteration=state.iteration + 1,
        )
        return new_state, metrics

    def _progress(self, state: TrainState) -> jax.Array:
        """Share of the iterations that are done."""
        return state.iteration / self.agent.config.num_iterations

    def _transforms(self) -> dict[str, optax.GradientTransformation]:
        config = self.agent.config
        return {
            "planner": ppo.optimiser(config.high.max_grad_norm),
            "controller": ppo.optimiser(config.low.max_grad_norm),
            "reach_critic": ppo.optimiser(1.0),
        }

    def _learn(
        self, key: jax.Array, state: TrainState, low: LowBatch, plan: PlanBatch, trajectory: Trajectory
    ) -> tuple[Params, dict[str, Any], Metrics]:
        """Updates the three networks; metrics are means over the gradient steps."""
        agent, config = self.agent, self.agent.config
        progress = self._progress(state)
        transforms = self._transforms()
        keys = jax.random.split(key, 3)
        params, optimisers, metrics = dict(state.params), dict(state.optimisers), {}

        def train(name: str, key: jax.Array, batch: Any, settings: PPOConfig, loss: Callable[..., Any]) -> None:
            rate = ppo.annealed(settings.learning_rate, settings.final_learning_rate, progress)
            params[name], optimisers[name], result = _fit(
                key,
                lambda p, sample: loss(agent, p, sample, settings, progress),
                params[name],
                optimisers[name],
                transforms[name],
                rate,
                batch,
                settings.epochs,
                settings.minibatches,
            )
            metrics.update({f"{name}/{k}": v for k, v in result.items()})

        train("controller", keys[0], low, config.low, controller_loss)
        if config.plans:
            train("planner", keys[1], plan, config.high, planner_loss)
        if config.shield.mode != "off":
            settings = PPOConfig(
                learning_rate=config.shield.learning_rate,
                final_learning_rate=config.shield.learning_rate,
                epochs=1,
                minibatches=config.shield.minibatches,
            )
            batch = reach_batch(agent, trajectory)
            train("reach_critic", keys[2], batch, settings, reach_loss)
        return params, optimisers, metrics


def controller_loss(
    agent: Agent, params: Any, batch: LowBatch, settings: PPOConfig, progress: jax.Array
) -> tuple[jax.Array, Metrics]:
    """PPO loss of the low level on a minibatch ``[V, T]``; steps the shield replaced count for the value alone."""
    own = {"controller": params}
    told = jax.vmap(jax.vmap(agent.instruct, in_axes=(None, 0)), in_axes=(None, 0))(own, batch.tree)
    row = jnp.arange(batch.slot.shape[0])[:, None]
    now = agent.told_now(own, told, (row, batch.slot), batch.edge, batch.feasible, batch.ahead)
    view, told = jax.tree.map(flat, (batch.view, now))
    outputs, value = jax.vmap(agent.control, in_axes=(None, 0, 0))(own, view, told)
    log_prob = jax.vmap(agent.actions.log_prob)(outputs, flat(batch.action))
    on_policy, valid = flat(batch.on_policy), flat(batch.valid)
    advantage = ppo.normalise(flat(batch.advantage), on_policy)
    policy = ppo.policy_loss(log_prob, flat(batch.log_prob), advantage, on_policy, settings)
    value_loss = ppo.value_loss(value, flat(batch.target), valid, settings.expectile)
    randomness = ppo.masked_mean(jax.vmap(agent.actions.entropy)(outputs), on_policy)
    loss = policy + settings.value_coefficient * value_loss + ppo.entropy_loss(randomness, settings, progress)
    return loss, {"policy_loss": policy, "value_loss": value_loss, "entropy": randomness}


def planner_loss(
    agent: Agent, params: Any, batch: PlanBatch, settings: PPOConfig, progress: jax.Array
) -> tuple[jax.Array, Metrics]:
    """PPO and TransE loss of the planner on a minibatch ``[B]`` (eqs. 4 and 5)."""
    config = agent.config
    apply: Any = agent.planner.apply
    logits, value = jax.vmap(apply, in_axes=(None, 0, 0, 0, 0))(
        params, batch.view, batch.tree, plan_state(batch), batch.advice
    )
    choices = Categorical(logits.shape[-1])
    log_prob = jax.vmap(choices.log_prob)(logits, batch.edge)
    # Where only one edge is open there is nothing to learn, and the mean of the advantages is another one.
    free = batch.chosen & ((logits > MASKED / 2).sum(-1) > 1)
    advantage = ppo.normalise(batch.advantage, free)
    policy = ppo.policy_loss(log_prob, batch.log_prob, advantage, free, settings)
    value_loss = ppo.value_loss(value, batch.target, batch.valid, settings.expectile)
    randomness = ppo.masked_mean(jax.vmap(choices.entropy)(logits), free)
    loss = policy + settings.value_coefficient * value_loss + ppo.entropy_loss(randomness, settings, progress)
    metrics = {"policy_loss": policy, "value_loss": value_loss, "entropy": randomness}
    if config.transe:
        metrics["transe_loss"] = transe_loss(agent, params, batch)
        loss = loss + config.transe * metrics["transe_loss"]
    return loss, metrics


def transe_loss(agent: Agent, params: Any, batch: PlanBatch) -> jax.Array:
    """Predicted latents near the ones reached, other states' latents at least the margin away (eq. 4)."""
    planner: Any = agent.planner

    def encode(view: Any) -> Any:
        return jax.vmap(lambda v: planner.apply(params, v, method="encode"))(view)

    here, there = encode(batch.view), encode(batch.next_view)
    predicted = jax.vmap(lambda h, r: planner.apply(params, h, r, method="predict"))(here, batch.reached)
    error = _distance(predicted, there)
    other = _distance(here, jnp.roll(here, 1, axis=0))
    both = batch.valid & jnp.roll(batch.valid, 1)
    margin = jnp.maximum(0.0, agent.config.transe_margin - other)
    return ppo.masked_mean(error, batch.valid & batch.completed) + ppo.masked_mean(margin, both)


def flat(x: jax.Array) -> jax.Array:
    """Merges the two leading axes (zero-sized arrays too)."""
    return x.reshape((x.shape[0] * x.shape[1], *x.shape[2:]))


def _distance(x: jax.Array, y: jax.Array) -> jax.Array:
    """Euclidean distance over the last axis, with a finite gradient at zero."""
    return jnp.sqrt(((x - y) ** 2).sum(-1) + 1e-8)


def measured(known: Measurements, book: TaskBook, trajectory: Trajectory, discount: float) -> Measurements:
    """Adds what the options of a rollout took and earned."""
    x = trajectory
    following = jnp.roll(x.decided, -1, 0).at[-1].set(False)
    return options.measure(
        known,
        jax.vmap(options.origins)(book.tree)[x.task, x.node],
        book.tree.reach[x.task, x.assigned],
        x.edge_taken | x.terminated | x.truncated | following,
        x.edge_taken & (x.edge == x.assigned),
        x.satisfied,
        x.since + 1,
        x.reward,
        discount=discount,
    )


def reach_batch(agent: Agent, trajectory: Trajectory) -> tuple[Any, ...]:
    """Q-learning data for all goals from every transition, leading axes E, T.

    The target is 1 where the goal holds after the step, else discount · max_a Q(s', g, a): the end of a task is not the
    end of the world in which its other letters can be reached.
    """
    target = jnp.where(trajectory.labels, 1.0, agent.config.shield.discount * trajectory.reach_value)
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (trajectory.view, trajectory.action, target))


def reach_loss(
    agent: Agent, params: Any, batch: tuple[Any, ...], settings: PPOConfig, progress: jax.Array
) -> tuple[jax.Array, Metrics]:
    """Squared error of Q(s, g, a) for all goals g (paper, "Avoiding Propositions")."""
    del settings, progress
    view, action, target = jax.tree.map(flat, batch)
    values = jax.vmap(agent.reach_values_of, in_axes=(None, 0, 0))({"reach_critic": params}, view, action)
    loss = ((values - target) ** 2).mean()
    return loss, {"value_loss": loss}


def _fit(
    key: jax.Array,
    loss: Callable[[Any, Any], tuple[jax.Array, Metrics]],
    params: Any,
    optimiser_state: Any,
    transform: optax.GradientTransformation,
    rate: jax.Array,
    batch: Any,
    epochs: int,
    minibatches: int,
) -> tuple[Any, Any, Metrics]:
    """Epochs of minibatch steps over the leading axis of ``batch``, shuffled anew for each."""
    size = jax.tree.leaves(batch)[0].shape[0]
    if size % minibatches:
        raise ValueError(f"{size} rows do not divide into {minibatches} minibatches")
    order = jnp.argsort(jax.random.bits(key, (epochs, size)), axis=-1).reshape(epochs * minibatches, -1)

    def step(carry: tuple[Any, Any], rows: jax.Array) -> tuple[tuple[Any, Any], Metrics]:
        sample = jax.tree.map(lambda x: x[rows], batch)
        params, state, metrics = ppo.gradient_step(lambda p: loss(p, sample), *carry, transform, rate)
        return (params, state), metrics

    (params, optimiser_state), metrics = jax.lax.scan(step, (params, optimiser_state), order)
    return params, optimiser_state, jax.tree.map(jnp.mean, metrics)


def _summary(trajectory: Trajectory, ended: jax.Array) -> Metrics:
    """Finished episodes and the sum of rewards in a rollout, and rates per step."""
    return {
        "episodes": ended.sum().astype(jnp.float32),
        "successes": trajectory.satisfied.sum().astype(jnp.float32),
        "returns": trajectory.reward.sum(),
        "violations": (trajectory.terminated & ~trajectory.satisfied).mean(),
        "shielded": trajectory.shielded.mean(),
    }
