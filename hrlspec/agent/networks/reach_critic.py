"""The reach critic behind the shield: Q(s, g, a) of reaching one proposition (paper, "Avoiding Propositions")."""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.distributions import Categorical, Distribution
from hrlspec.agent.networks.encoder import MLP, Planes, Shared


class ReachCritic(nn.Module):
    """One small network, applied to each proposition's part of the observation; values in [0, 1].

    Discrete actions have an output each; continuous ones are an input. Axes: **P** atomic propositions, **K** candidate
    actions, **A** components of an action.
    """

    hidden: Sequence[int]
    actions: Distribution

    def setup(self) -> None:
        """Declares the network."""
        discrete = isinstance(self.actions, Categorical)
        self.network = MLP((*self.hidden, self.actions.num_outputs if discrete else 1), final_scale=0.1)

    def __call__(self, view: tuple[Planes, Shared]) -> Float32[Array, "P K"]:
        """Q values of every goal and candidate action, float32 ``[P, K]``."""
        if isinstance(self.actions, Categorical):
            return nn.sigmoid(self.network(_goals(view)))
        return jnp.stack([self.of(view, action) for action in self.actions.candidates()], -1)

    def of(self, view: tuple[Planes, Shared], action: Int32[Array, ""] | Float32[Array, " A"]) -> Float32[Array, " P"]:
        """Q values of every goal and one action, float32 ``[P]``."""
        if isinstance(self.actions, Categorical):
            return self(view)[:, action]
        goals = _goals(view)
        actions = jnp.broadcast_to(action, (goals.shape[0], *action.shape))
        return nn.sigmoid(self.network(jnp.concatenate([goals, actions], -1)))[:, 0]


def _goals(view: tuple[Planes, Shared]) -> Float32[Array, "P F"]:
    """What the network sees of each goal: its part of the observation, the shared part, and its one-hot code."""
    planes, shared = view
    num_propositions = planes.shape[0]
    return jnp.concatenate(
        [
            planes.reshape(num_propositions, -1),
            jnp.broadcast_to(shared, (num_propositions, shared.shape[0])),
            jnp.eye(num_propositions, dtype=jnp.float32),
        ],
        axis=-1,
    )
