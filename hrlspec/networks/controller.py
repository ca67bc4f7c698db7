"""The low level: a policy and value conditioned on the assigned sub-task and on what remains after it.

Paper, "Low-level Module". Axes: **N** tree nodes, **P** atomic propositions, **G** channels, **D** later sub-tasks,
**F** features.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from hrlspec.config import NetworkConfig
from hrlspec.networks.encoder import MLP, Encoder
from hrlspec.networks.tree import TaskEmbedding, lookahead
from hrlspec.spec import TaskTree, subtask_avoid


@struct.dataclass
class Instruction:
    """What the low level is told.

    Attributes:
        reach: float32 ``[P]``, p₊ of the assigned sub-task.
        avoid: float32 ``[P]``, p₋ (eq. 2).
        ahead: float32 ``[D, P]``, what may be reached 1, 2, ... sub-tasks after it.
        future: float32 ``[F]``, embedding of the task that remains after it.
    """

    reach: jax.Array
    avoid: jax.Array
    ahead: jax.Array
    future: jax.Array


class Controller(nn.Module):
    """Encoder, embedding of the remaining task, actor and critic of the low level.

    Attributes:
        config: sizes.
        num_outputs: of the actor; they describe a distribution of ``hrlspec.actions``.
    """

    config: NetworkConfig
    num_outputs: int

    def setup(self) -> None:
        """Declares the parts."""
        c = self.config
        self.task_embedding = TaskEmbedding(c.task_features, c.task_rounds)
        self.encoder = Encoder(c.latent, c.conv_channels, c.encoder_mlp)
        self.actor = MLP((*c.actor, self.num_outputs), final_scale=0.01)
        self.critic = MLP((*c.critic, 1), tanh=True, final_scale=1.0)

    def instruct(self, tree: TaskTree) -> Instruction:
        """The instruction for every edge of a task at once, leading axis N."""
        depth = self.config.lookahead if self.config.roles else 0
        return Instruction(
            reach=tree.reach.astype(jnp.float32),
            avoid=subtask_avoid(tree).astype(jnp.float32),
            ahead=lookahead(tree, depth).astype(jnp.float32),
            future=self.task_embedding(tree),
        )

    def __call__(self, view: tuple[jax.Array, jax.Array], told: Instruction) -> tuple[jax.Array, jax.Array]:
        """Acts on one sub-task.

        Args:
            view: the observation, as ``env.proposition_view`` gives it.
            told: the assigned sub-task and what follows.

        Returns:
            The actor's outputs ``[num_outputs]`` and the value ``[]``.
        """
        planes, shared = view
        if self.config.roles:
            # By role the encoder need not push the whole observation through its latent to find the goal afterwards.
            planes = jnp.tensordot(jnp.concatenate([told.reach[None], told.avoid[None], told.ahead]), planes, axes=1)
        latent = nn.relu(self.encoder(planes, shared))
        # With the planner's advice there is a plan, and what remains is the rest of the plan.
        future = self.task_embedding.of_way(told.ahead) if self.config.advice else told.future
        x = jnp.concatenate([latent, told.reach, told.avoid, future])
        return self.actor(x), self.critic(x)[0]

    def everything(self, view: tuple[jax.Array, jax.Array], tree: TaskTree) -> tuple[jax.Array, jax.Array]:
        """Touches every parameter, for initialisation."""
        return self(view, jax.tree.map(lambda x: x[0], self.instruct(tree)))
