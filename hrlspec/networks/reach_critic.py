"""The reach critic behind the shield: Q(s, g, a) of reaching one proposition (paper, "Avoiding Propositions")."""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from hrlspec.networks.encoder import MLP


class ReachCritic(nn.Module):
    """One small network, applied to each proposition's part of the observation; values in [0, 1].

    Axes: **P** atomic propositions, **A** actions.
    """

    hidden: Sequence[int]
    num_actions: int

    @nn.compact
    def __call__(self, view: tuple[jax.Array, jax.Array]) -> jax.Array:
        """Q values of every goal and action, float32 ``[P, A]``."""
        planes, shared = view
        num_propositions = planes.shape[0]
        inputs = jnp.concatenate(
            [
                planes.reshape(num_propositions, -1),
                jnp.broadcast_to(shared, (num_propositions, shared.shape[0])),
                jnp.eye(num_propositions),
            ],
            axis=-1,
        )
        return nn.sigmoid(MLP((*self.hidden, self.num_actions), final_scale=0.1)(inputs))
