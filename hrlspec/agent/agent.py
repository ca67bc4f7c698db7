"""The agent: an environment, shared settings and a method put together.

Axes: **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
import functools

import jax.numpy as jnp
from jaxtyping import Key

from envs_jax import Environment
from envs_jax.arrays import Array
from hrlspec.agent.experience import view_of
from hrlspec.agent.high_level import HighLevel
from hrlspec.agent.low_level import LowLevel, Params
from hrlspec.agent.method import Method
from hrlspec.agent.networks.encoder import randomised
from hrlspec.config import Config
from hrlspec.spec import TaskTree


@dataclasses.dataclass(frozen=True)
class Agent:
    """Both levels for one environment. Static: close over it, or pass it as a static argument.

    Attributes:
        env: the environment the agent acts in.
        config: the settings that all methods share.
        method: the high level, and the conditioning of the low level.

    Raises:
        ConfigError: if the method's settings do not go with the shared ones.
    """

    env: Environment
    config: Config
    method: Method

    def __post_init__(self) -> None:
        self.method.high.check(self.config)

    @property
    def high(self) -> HighLevel:
        """The high level."""
        return self.method.high

    @functools.cached_property
    def low(self) -> LowLevel:
        """The low level."""
        return LowLevel(self.env, self.config, self.method.sees, self.high.follows_plan)

    def init(self, key: Key[Array, ""]) -> Params:
        """Fresh parameters of all parts: ``low``, ``high`` and ``reach_critic``. The key is consumed."""
        view = view_of(self.env, jnp.zeros(self.env.observation_shape, jnp.float32))
        tree = _blank_tree(self.env.num_propositions)
        low = self.low.controller.init(key, view, tree, method="everything")
        high = self.high.init(key, self.low, view, tree)
        reach_critic = self.low.reach_critic.init(key, view)
        learned = self.high.ppo is not None
        low, drawn, reach_critic = randomised(key, (low, high if learned else {}, reach_critic))
        return {"low": low, "high": drawn if learned else high, "reach_critic": reach_critic}

    def acting(self, params: Params) -> Params:
        """The parts that acting needs: the reach critic is left out where it does not learn, as no shield collects."""
        return {name: part for name, part in params.items() if name != "reach_critic" or self.config.shield.enabled}


def _blank_tree(num_propositions: int) -> TaskTree:
    """Two nodes and no edge, to initialise the networks with; no parameter's shape depends on N."""
    return TaskTree(
        parent=jnp.full(2, TaskTree.NO_NODE, jnp.int32),
        reach=jnp.zeros((2, num_propositions), bool),
        avoid=jnp.zeros((2, num_propositions), bool),
        accepting=jnp.zeros(2, bool),
        valid=jnp.array([True, False]),
        depth=jnp.zeros(2, jnp.int32),
    )
