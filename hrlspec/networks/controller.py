"""The low level: a policy and value conditioned on the assigned sub-task and on what remains after it.

Paper, "Low-level Module". Axes: **N** tree nodes, **P** atomic propositions, **G** channels, **F** features.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from hrlspec.config import NetworkConfig
from hrlspec.networks.encoder import MLP, Encoder
from hrlspec.networks.tree import TaskEmbedding
from hrlspec.spec import TaskTree


class Controller(nn.Module):
    """Encoder, embedding of the remaining task, actor and critic of the low level (discrete actions)."""

    config: NetworkConfig
    num_actions: int
    num_propositions: int

    def setup(self) -> None:
        """Declares the parts."""
        c = self.config
        self.task_embedding = TaskEmbedding(c.task_features, c.task_rounds)
        self.spotlights = nn.Dense(c.spotlights * self.num_propositions)
        self.encoder = Encoder(c.latent, c.conv_channels, c.encoder_mlp)
        self.actor = MLP((*c.actor, self.num_actions), final_scale=0.01)
        self.critic = MLP((*c.critic, 1), tanh=True, final_scale=1.0)

    def embed(self, tree: TaskTree) -> jax.Array:
        """Embeddings of every progression of a task, float32 ``[N, F]``."""
        return self.task_embedding(tree)

    def channels(self, planes: jax.Array, reach: jax.Array, avoid: jax.Array, future: jax.Array) -> jax.Array:
        """What the encoder looks at, ``[G, ...]``.

        With spotlights these are mixtures of the propositions' planes: the goal's, the forbidden ones', and some
        that the embedding of the remaining task picks. The encoder then sees roles instead of names, and
        need not push the whole observation through its latent. Without them, one channel per proposition.
        """
        if not self.config.spotlights:
            return planes
        picked = nn.tanh(self.spotlights(future)).reshape(self.config.spotlights, self.num_propositions)
        roles = jnp.concatenate([reach[None], avoid[None], picked])
        return jnp.tensordot(roles, planes, axes=1)

    def __call__(
        self, view: tuple[jax.Array, jax.Array], reach: jax.Array, avoid: jax.Array, future: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Acts on one sub-task.

        Args:
            view: the observation, as ``env.proposition_view`` gives it.
            reach: p₊, ``[P]``.
            avoid: p₋, ``[P]``.
            future: embedding of the task that remains after the sub-task, ``[F]``.

        Returns:
            Logits over actions ``[A]`` and the value ``[]``.
        """
        planes, shared = view
        reach, avoid = reach.astype(jnp.float32), avoid.astype(jnp.float32)
        latent = nn.relu(self.encoder(self.channels(planes, reach, avoid, future), shared))
        x = jnp.concatenate([latent, reach, avoid, future])
        return self.actor(x), self.critic(x)[0]

    def everything(self, view: tuple[jax.Array, jax.Array], tree: TaskTree) -> tuple[jax.Array, jax.Array]:
        """Touches every parameter, for initialisation."""
        embeddings = self.embed(tree)
        return self(view, tree.reach[0], tree.avoid[0], embeddings[0])
