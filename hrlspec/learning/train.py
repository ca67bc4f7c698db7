"""Training: one iteration of collection and learning as one pure function (paper, "Algorithm").

Axes: **E** environments, **T** time steps, **L** levels, **M** tasks per level.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Float32, Int32, Key, UInt32

from envs_jax.arrays import Array
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import Experience, Step
from hrlspec.agent.groups import take
from hrlspec.agent.interaction import start
from hrlspec.agent.low_level import Params
from hrlspec.learning.batch import high_batch, low_batch
from hrlspec.learning.experience import gather
from hrlspec.learning.optimiser import Metrics, annealed, fit, optimiser
from hrlspec.learning.ppo import low_level_loss
from hrlspec.learning.reach import reach_batch, reach_loss
from hrlspec.learning.rollout import RETRIED, Collector, Setting, collect, fill_pool
from hrlspec.learning.shards import SPREAD, WHOLE, Shards
from hrlspec.spec import TaskTree
from hrlspec.tasks import curriculum
from hrlspec.tasks.curriculum import Curriculum
from hrlspec.tasks.rewards import RewardMachine


@struct.dataclass
class TrainState:
    """Everything a run needs to go on, bit for bit.

    Attributes:
        params: parameters by part: ``low``, ``high`` and ``reach_critic``.
        optimisers: optimiser states of the parts that learn by gradient, under the same names.
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
    key: Key[Array, ""]
    iteration: Int32[Array, ""]


@dataclasses.dataclass(frozen=True)
class Trainer:
    """Pure training functions for one agent.

    ``bank`` arguments are :func:`hrlspec.tasks.curriculum.draw_bank`'s: L·M tasks, drawn anew as often as wanted.

    Attributes:
        agent: environment, settings and method.
        devices: how many to spread the environments over; it must divide the settings' ``blocks``. The results do not
            depend on it.

    Raises:
        ConfigError: the devices do not share the blocks evenly, or there are not as many.
    """

    agent: Agent
    devices: int = 1

    def __post_init__(self) -> None:
        self.shards  # noqa: B018  refuses what does not go together

    @functools.cached_property
    def shards(self) -> Shards:
        """How the environments lie on the devices."""
        config = self.agent.config
        return Shards(config.num_envs, config.blocks, self.devices)

    @functools.partial(jax.jit, static_argnums=0)
    def init(self, key: Key[Array, ""], bank: TaskTree, machine: RewardMachine) -> TrainState:
        """A fresh state. The key is consumed."""
        config = self.agent.config
        self._check(bank)
        key, init_key, *start_keys = jax.random.split(key, 5)
        params = self.agent.init(init_key)
        rows = jnp.arange(config.num_envs, dtype=jnp.int32) % config.curriculum.tasks_per_level
        tasks = jax.tree.map(lambda x: jnp.asarray(x)[rows], bank)
        state = TrainState(
            params=params,
            optimisers={name: optimiser(some).init(params[name]) for name, some in self._optimisers().items()},
            collector=self._first_collector(start_keys, params, tasks, machine),
            tasks=tasks,
            curriculum=curriculum.initial(),
            key=key,
            iteration=jnp.int32(0),
        )
        return self.shards.placed(state, _places(state))

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
    def iterate(
        self, state: TrainState, bank: TaskTree, machine: RewardMachine, reserved: UInt32[Array, " M"]
    ) -> tuple[TrainState, Metrics]:
        """One iteration: E×T steps of collection, then updates of all parts. ``state`` is donated.

        Args:
            state: where the run stands.
            bank: training tasks, leading axis L·M.
            machine: the rewards.
            reserved: uint32, sorted hashes of held-out tasks, which relabelling must not produce.

        Returns:
            The next state and float32 metrics. Of the rollout's episodes, but for those that were begun again:
            ``episodes`` and ``successes`` count what ended, ``steps`` is how many there were, ``returns`` the sum of
            rewards. Of all: ``violations`` and ``shielded`` per step; the level, and losses.
        """
        self._check(bank)
        chex.assert_rank(reserved, 1)
        chex.assert_type(reserved, jnp.uint32)
        places = _places(state)
        on_each = self.shards.on_each(self._iterate, (places, WHOLE, WHOLE, WHOLE), (places, WHOLE))
        new_state, metrics = on_each(state, bank, machine, reserved)
        return self.shards.placed(new_state, places), metrics

    def _iterate(
        self, state: TrainState, bank: TaskTree, machine: RewardMachine, reserved: UInt32[Array, " M"]
    ) -> tuple[TrainState, Metrics]:
        """The iteration on one device, with its share of the environments."""
        agent, config, shards = self.agent, self.agent.config, self.shards
        envs = shards.envs()
        progress = state.iteration / config.num_iterations
        keys = jax.random.split(jax.random.fold_in(state.key, state.iteration), 5)
        book = agent.low.prepare(state.params, jax.tree.map(lambda *x: jnp.concatenate(x), state.tasks, bank))
        collector = dataclasses.replace(
            state.collector,
            worker=dataclasses.replace(state.collector.worker, task=jnp.arange(len(envs), dtype=jnp.int32)),
        )
        pool = fill_pool(keys[0], agent, book, state.curriculum.level, envs, size=config.episode_slots - 1)
        correlation = annealed(config.noise_correlation, config.final_noise_correlation, progress)
        setting = Setting(agent, state.params, machine, book, pool, envs)
        collector, steps = collect(keys[1], setting, collector, correlation)
        relabel_key, pick_key = jax.random.split(keys[2])
        experience = gather(relabel_key, agent, state.params, machine, book, steps, reserved, envs)
        params, optimisers, losses = self._learn(keys[3], pick_key, state, experience, steps, progress)
        measured = self._measured(lambda block: agent.high.measure(book, block, config), steps)
        params["high"] = agent.high.observe(params["high"], measured)
        params["low"] = agent.low.observe(params["low"], self._measured(agent.low.measure, steps))
        new_state = TrainState(
            params=params,
            optimisers=optimisers,
            collector=dataclasses.replace(collector, worker=dataclasses.replace(collector.worker, task=envs)),
            tasks=take(book.tree, collector.worker.task),
            curriculum=self._promoted(state.curriculum, steps),
            key=state.key,
            iteration=state.iteration + 1,
        )
        level = 1.0 + state.curriculum.level.astype(jnp.float32)
        return new_state, losses | _summary(steps, shards) | {"level": level}

    def _check(self, bank: TaskTree) -> None:
        """Raises ``AssertionError`` unless these are as many tasks of the size that the settings ask for."""
        config, num_propositions = self.agent.config.curriculum, self.agent.env.num_propositions
        chex.assert_shape(bank.reach, (config.levels * config.tasks_per_level, config.max_nodes, num_propositions))

    def _first_collector(
        self, keys: list[Key[Array, ""]], params: Params, tasks: TaskTree, machine: RewardMachine
    ) -> Collector:
        """Running episodes with staggered clocks; those that fail at first would otherwise all end in the same step."""
        agent, env = self.agent, self.agent.env
        envs = jnp.arange(agent.config.num_envs, dtype=jnp.int32)
        layout_key, reset_key, stagger_key = keys

        def each(key: Key[Array, ""]) -> Key[Array, " E"]:
            return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, envs)

        layouts = jax.vmap(env.sample_layout, in_axes=(0, None))(each(layout_key), env.default_params)
        worker = start(each(reset_key), env, machine, agent.low.prepare(params, tasks), layouts, envs)
        elapsed = jax.random.randint(stagger_key, envs.shape, 0, env.horizon, jnp.int32)
        worker = dataclasses.replace(
            worker,
            env_state=dataclasses.replace(worker.env_state, time=elapsed.astype(jnp.int32)),
            # The very first sub-tasks are each task's first edge: not the high level's choice, hence no decision.
            decision=dataclasses.replace(worker.decision, edge=jnp.ones(envs.shape, jnp.int32)),
            awaiting=jnp.zeros(envs.shape, bool),
        )
        zeros = jnp.zeros(envs.shape, jnp.int32)
        kept = layouts if agent.config.curriculum.retry else None
        return Collector(worker=worker, level=zeros, started=zeros, since=zeros, layout=kept)

    def _optimisers(self) -> dict[str, Any]:
        """Optimiser settings of the parts that learn by gradient."""
        agent = self.agent
        settings = {"low": agent.config.low.optimiser}
        if agent.high.ppo is not None:
            settings["high"] = agent.high.ppo.optimiser
        if agent.config.shield.enabled:
            settings["reach_critic"] = agent.config.shield.optimiser
        return settings

    def _learn(
        self,
        key: Key[Array, ""],
        pick_key: Key[Array, ""],
        state: TrainState,
        experience: Experience,
        steps: Step,
        progress: Float32[Array, ""],
    ) -> tuple[Params, dict[str, Any], Metrics]:
        """Updates all parts that learn by gradient; metrics are means over the gradient steps."""
        agent, config, ppo = self.agent, self.agent.config, self.agent.high.ppo
        keys = dict(zip(("low", "high", "reach_critic"), jax.random.split(key, 3), strict=True))
        lessons: dict[str, tuple[Any, Any]] = {
            "low": (
                self.shards.each_block(functools.partial(low_batch, agent, state.params), experience),
                lambda p, sample: low_level_loss(agent.low, p, sample, config.low, progress),
            )
        }
        if ppo is not None:
            lessons["high"] = (
                self.shards.each_block(lambda block: high_batch(pick_key, agent, block, ppo), experience),
                lambda p, sample: agent.high.loss(agent.low, p, sample, progress),
            )
        if config.shield.enabled:
            lessons["reach_critic"] = (
                jax.tree.map(self.shards.in_blocks, reach_batch(agent.low, steps)),
                lambda p, sample: reach_loss(agent.low, p, sample),
            )
        params, optimisers, metrics = dict(state.params), dict(state.optimisers), {}
        for name, settings in self._optimisers().items():
            batch, loss = lessons[name]
            params[name], optimisers[name], result = fit(
                keys[name], loss, params[name], optimisers[name], batch, settings, progress, self.shards.mean
            )
            metrics.update({f"{name}/{k}": v for k, v in result.items()})
        return params, optimisers, metrics

    def _promoted(self, before: Curriculum, steps: Step) -> Curriculum:
        """The curriculum after the episodes of its level that ended in a rollout."""
        outcome = steps.outcome
        current = (outcome.terminated | outcome.truncated) & (steps.level == before.level)
        kinds = jnp.stack([current, current & outcome.satisfied]).astype(jnp.int32)
        episodes, successes = self.shards.total(self.shards.in_blocks(kinds.T).sum((1, 2), dtype=jnp.int32))
        return curriculum.update(before, episodes, successes, self.agent.config.curriculum)

    def _measured(self, measure: Callable[[Step], Any], steps: Step) -> Any:
        """A level's measurements, added up over all environments."""
        blocks = jax.tree.map(lambda x: self.shards.in_blocks(jnp.swapaxes(x, 0, 1)), steps)

        def one(block: Step) -> Any:
            in_time = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), block)
            return measure(in_time)

        return jax.tree.map(self.shards.total, self.shards.each_block(one, blocks))


def _places(state: TrainState) -> TrainState:
    """Where the leaves of a state lie: what belongs to environments is spread over the devices."""

    def place(path: Any, _: Any) -> Any:
        return SPREAD if path[0].name in ("collector", "tasks") else WHOLE

    places: TrainState = jax.tree_util.tree_map_with_path(place, state)
    return places


def _summary(steps: Step, shards: Shards) -> Metrics:
    """Sums over a rollout, and rates per step."""
    outcome = steps.outcome
    first = steps.level != RETRIED
    sums = {
        "episodes": (outcome.terminated | outcome.truncated) & first,
        "successes": outcome.satisfied & first,
        "steps": first,
        "returns": outcome.reward * first,
        "violations": outcome.terminated & ~outcome.satisfied,
        "shielded": steps.low.shielded,
    }
    total = {name: shards.total(shards.in_blocks(x.T.astype(jnp.float32)).sum((1, 2))) for name, x in sums.items()}
    num_steps = shards.num_envs * len(outcome.reward)
    return {name: x / num_steps if name in ("violations", "shielded") else x for name, x in total.items()}
