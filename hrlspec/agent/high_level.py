"""The high level as an interface: it chooses the next sub-task and says what the remaining task is worth.

Implementations live with their methods, in ``hrlspec/methods``. They are static, hashable values (frozen dataclasses of
settings); what they learn lives in ``params["high"]``.

Axes: **B** environments of a batch, **N** tree nodes, **D** later sub-tasks, **P** atomic propositions, **T** time
steps, **E** environments, **V** environments and relabelled copies.
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Int32, Key

from envs_jax.arrays import Array
from hrlspec.agent.experience import Experience, HighBatch, Step, View
from hrlspec.agent.low_level import LowLevel, Params, TaskBook
from hrlspec.agent.networks.controller import Instruction
from hrlspec.config import Config, PPOConfig
from hrlspec.spec import TaskState, TaskTree, open_edges

Metrics = dict[str, Float32[Array, ""]]


@struct.dataclass
class Choice:
    """Logits and values of the open edges; leading axis B."""

    logits: Float32[Array, "B N"]  # over edges
    value: Float32[Array, " B"]  # V^h of the remaining task
    advice: Float32[Array, "B N"]  # the low level's value of each edge; zeros where it is not used
    ahead: Float32[Array, "B N D P"]  # reach sets of the sub-tasks planned after each edge
    leaf: Int32[Array, "B N"]  # where the path through each edge ends that is meant to be taken

    @property
    def judgement(self) -> Judgement:
        """What was thought of the task, whichever edge is taken; the path is that through the likeliest."""
        likeliest = self.logits.argmax(-1, keepdims=True)
        return Judgement(self.value, self.advice, jnp.take_along_axis(self.leaf, likeliest, 1)[:, 0])


class Judgement(NamedTuple):
    """What the high level thinks of a task; leading axis B."""

    value: Float32[Array, " B"]
    advice: Float32[Array, "B N"]
    leaf: Int32[Array, " B"]  # where the path ends that it would take


class Rewards(NamedTuple):
    """What the low level learns from, leading axes ``[V, T]``."""

    reward: Float32[Array, "V T"]
    terminated: Bool[Array, "V T"]
    truncated: Bool[Array, "V T"]


class HighLevel(abc.ABC):
    """Chooses sub-tasks. `init` and `choose` are what acting needs; the others are how it learns."""

    ppo: PPOConfig | None = None
    """How `loss` is descended; ``None`` where nothing is learned by gradient."""
    max_operator: bool = False
    """Whether the low level's target at a new sub-task is raised to V^h (eq. 6)."""
    learns_unfinished: bool = False
    """Whether sub-tasks that were assigned but not completed are learned from."""
    learns_from_copies: bool = False
    """Whether the policy learns from relabelled copies, whose path it did not choose; the rest always does."""

    @property
    def follows_plan(self) -> bool:
        """Whether a choice comes with the sequence of sub-tasks that is meant to follow it."""
        return False

    def num_samples(self, config: Config) -> int:
        """B, decisions that a block learns from in an iteration, at most."""
        return config.envs_per_block * config.num_steps

    def check(self, config: Config) -> None:
        """Refuses shared settings that do not go with these.

        Raises:
            ConfigError: naming the setting, what was found and what was expected.
        """
        del config

    @property
    def uses_values(self) -> bool:
        """Whether V^h at decisions is learned from."""
        return self.ppo is not None or self.max_operator

    @abc.abstractmethod
    def init(self, key: Key[Array, ""], low: LowLevel, view: View, tree: TaskTree) -> Any:
        """What ``params["high"]`` begins as: where `ppo` is given, standard deviations of the weights to be drawn.

        Args:
            key: consumed.
            low: the low level.
            view: an observation, for shapes.
            tree: a task, for shapes.
        """

    @abc.abstractmethod
    def choose(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> Choice:
        """Evaluates the open edges in B environments.

        Args:
            low: the low level, whose values may be used.
            params: parameters of all parts.
            view: what is seen.
            tree: the tasks.
            state: where they stand.
            instructions: the instruction for each edge, leading axes ``[B, N]``.
        """

    def settled(self, tree: TaskTree, state: TaskState, forks: Bool[Array, "B N"]) -> Int32[Array, " B"]:
        """The edge to take where there is nothing to choose, so that `choose` need not be asked; else ``NO_NODE``.

        There is nothing to choose where one edge is open and, where a plan is wanted, one way leads on from it.

        Args:
            tree: the tasks.
            state: where they stand.
            forks: as in a `TaskBook`.
        """
        feasible = jax.vmap(open_edges)(tree, state)
        only = feasible.argmax(-1).astype(jnp.int32)
        several = self.follows_plan & jnp.take_along_axis(forks, only[:, None], 1)[:, 0]
        return jnp.where((feasible.sum(-1) == 1) & ~several, only, TaskTree.NO_NODE)

    def judge(
        self,
        low: LowLevel,
        params: Params,
        view: View,
        tree: TaskTree,
        state: TaskState,
        instructions: Instruction,
    ) -> Judgement:
        """What it thinks of relabelled tasks, where the choice was not its own."""
        return self.choose(low, params, view, tree, state, instructions).judgement

    def low_level_rewards(self, experience: Experience) -> Rewards:
        """What the low level is paid, and when that ends: the task's rewards, until the episode ends."""
        outcome = experience.outcome
        return Rewards(outcome.reward, outcome.terminated, outcome.truncated)

    def loss(
        self, low: LowLevel, params: Any, batch: HighBatch, progress: Float32[Array, ""]
    ) -> tuple[Float32[Array, ""], Metrics]:
        """Loss of ``params["high"]``, which ``params`` is, on a minibatch; called where `ppo` is given.

        Args:
            low: the low level.
            params: parameters of this part.
            batch: decisions and what they led to.
            progress: float32 ``[]``, share of the training that is done.
        """
        raise NotImplementedError(f"{type(self).__name__} has nothing to learn by gradient")

    def measure(self, book: TaskBook, steps: Step, config: Config) -> Any:
        """What is measured in a rollout ``[T, E]`` rather than learned by gradient: a pytree of sums.

        Those of all environments are added up for `observe`.
        """
        del book, steps, config
        return ()

    def observe(self, params: Any, measured: Any) -> Any:
        """``params["high"]`` after a rollout, from the sums of `measure`."""
        del measured
        return params
