"""The baseline LTL2Action: one flat policy conditioned on the whole remaining task (Vaezipoor et al., 2021).

Relabelling and curriculum as the paper grants them. Axes: **B** environments of a batch, **N** tree nodes.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Int32, Key

from envs_jax.arrays import Array
from hrlspec.agent.distributions import MASKED
from hrlspec.agent.experience import View
from hrlspec.agent.high_level import Choice, HighLevel
from hrlspec.agent.low_level import LowLevel, Params
from hrlspec.agent.method import Method
from hrlspec.agent.networks.controller import Instruction, Sees
from hrlspec.config import Checked, Config, ConfigError, NetworkConfig, evolve
from hrlspec.spec import TaskState, TaskTree, open_edges


@dataclasses.dataclass(frozen=True)
class NoChoice(Checked, HighLevel):
    """Assigns nothing: the policy may take any edge. V^h is the value of the one policy there is."""

    def init(self, key: Key[Array, ""], low: LowLevel, view: View, tree: TaskTree) -> Any:
        """Nothing is learned."""
        del key, low, view, tree
        return {}

    def check(self, config: Config) -> None:
        """Refuses to be trained to stay: the policy is told of no single sub-task."""
        if config.curriculum.stay:
            raise ConfigError(f"Config.curriculum.stay is {config.curriculum.stay:g}, which LTL2Action cannot be told")

    def settled(self, tree: TaskTree, state: TaskState, forks: Bool[Array, "B N"]) -> Int32[Array, " B"]:
        """The root, which is no edge, wherever the task stands."""
        del tree, forks
        return jnp.full_like(state.node, TaskTree.ROOT)

    def choose(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> Choice:
        """The root, which is no edge."""
        feasible = jax.vmap(open_edges)(tree, state)
        root = jnp.arange(tree.num_nodes, dtype=jnp.int32) == TaskTree.ROOT
        logits = jnp.where(root, jnp.zeros(feasible.shape, jnp.float32), MASKED)
        value = low.value_of(params, view, instructions, logits.argmax(-1).astype(jnp.int32), feasible)
        nothing = jnp.zeros(logits.shape, jnp.float32)
        return Choice(logits, value, nothing, instructions.ahead, jnp.zeros(logits.shape, jnp.int32))


@dataclasses.dataclass(frozen=True)
class LTL2Action(Method):
    """One flat policy, conditioned on the whole remaining task."""

    high: NoChoice = NoChoice()

    name: ClassVar[str] = "ltl2action"
    about: ClassVar[str] = "one flat policy sees the whole remaining task"
    sees: ClassVar[Sees] = "whole task"

    def configure(self, config: Config) -> Config:
        """Without a sub-task there are no roles to encode the observation by, no avoid set for the shield, no stays."""
        network = dataclasses.replace(
            config.network,
            # Images are not seen by role, which is what makes convolutions superfluous.
            conv_channels=NetworkConfig.conv_channels,
            # The only features of the task that it is conditioned on.
            task_features=NetworkConfig.task_features,
            task_rounds=0,
            roles=False,
            names=False,
            forbidden=False,
            memory=0,
            symmetric=False,
        )
        shield = dataclasses.replace(config.shield, enabled=False)
        return dataclasses.replace(evolve(config, {"curriculum.stay": 0.0}), network=network, shield=shield)


LTL2ACTION = LTL2Action()
