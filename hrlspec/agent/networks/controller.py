"""The low level: a policy and value conditioned on the assigned sub-task and on what remains after it.

Paper, "Low-level Module". Axes: **N** tree nodes, **P** atomic propositions, **G** channels, **D** later sub-tasks,
**C** completed sub-tasks, **F** features, **A** actions or their components.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Shaped

from envs_jax import Reflections, Symmetries
from envs_jax.arrays import Array
from hrlspec.agent.networks.encoder import MLP, Encoder, Planes, Shared
from hrlspec.agent.networks.exclusions import Exclusions
from hrlspec.agent.networks.symmetry import reflect, turn
from hrlspec.agent.networks.tree import TaskEmbedding, lookahead, lookback, with_stays
from hrlspec.config import NetworkConfig
from hrlspec.spec import TaskTree, forbidden, subtask_avoid


@struct.dataclass
class Instruction:
    """The instruction of the low level: the assigned sub-task and the tasks around it.

    Attributes:
        reach: float32 ``[P]``, p₊ of the assigned sub-task.
        avoid: float32 ``[P]``, p₋ (eq. 2).
        forbidden: float32 ``[P]``, what violates the task; ``[0]`` where it has no role of its own.
        ahead: float32 ``[D, P]``, what may be reached 1, 2, ... sub-tasks after it.
        behind: float32 ``[C, P]``, what was reached 1, 2, ... sub-tasks before it.
        future: float32 ``[F]``, embedding of the task that remains after it, or of the whole remaining task where no
            sub-task is assigned.
    """

    reach: Float32[Array, "*lead P"]
    avoid: Float32[Array, "*lead P"]
    forbidden: Float32[Array, "*lead P_or_0"]
    ahead: Float32[Array, "*lead D P"]
    behind: Float32[Array, "*lead C P"]
    future: Float32[Array, "*lead F"]


class Sight(NamedTuple):
    """What the low level sees of the world on a sub-task, before any of its parameters."""

    planes: Planes
    shared: Shared
    frame: Shaped[Array, " A"] | None  # places of the actions, or their signs, in the form of the world that is seen


Sees = Literal["future", "sub-task", "whole task"]
"""What the low level is conditioned on: its sub-task and what remains after it, its sub-task alone, or the whole
remaining task, with the avoid sets of its edges, and no sub-task."""


class Controller(nn.Module):
    """Encoder, embedding of the remaining task, actor and critic of the low level.

    Attributes:
        config: sizes.
        num_outputs: of the actor; they describe a distribution of `hrlspec.agent.distributions`.
        num_propositions: P.
        sees: the part of the task that it is conditioned on.
        follows_plan: whether what remains is the one sequence planned by the high level, instead of a tree.
        symmetries: how the world can be turned or reflected, if at all.
    """

    config: NetworkConfig
    num_outputs: int
    num_propositions: int
    sees: Sees = "future"
    follows_plan: bool = False
    symmetries: Symmetries | Reflections | None = None

    def setup(self) -> None:
        """Declares the parts."""
        c = self.config
        self.task_embedding = TaskEmbedding(c.task_features, c.task_rounds, negatives=self.sees == "whole task")
        charted = (*c.chart[:-1], self.num_propositions * c.chart[-1]) if c.chart else None
        self.exclusions = Exclusions(later=self.sees != "sub-task") if c.exclusions else None
        self.encoder = Encoder(c.latent, c.conv_channels, c.encoder_mlp)
        self.chart = MLP(charted) if charted else None
        self.critic_encoder = Encoder(c.latent, c.conv_channels, c.encoder_mlp) if c.critic_encoder else None
        self.critic_chart = MLP(charted) if charted and c.critic_encoder else None
        self.actor = MLP((*c.actor, self.num_outputs), final_scale=0.01)
        self.critic = MLP((*c.critic, 1), tanh=True, final_scale=1.0)

    def instruct(self, tree: TaskTree) -> Instruction:
        """The instruction for every edge of a task at once, leading axis N.

        Where the whole task is seen, what is said of the future is meant for `remaining`; where the sub-task alone is
        seen, nothing is said of it.
        """
        depth = self.config.lookahead if self.config.roles else 0
        embed = self.task_embedding.messages if self.sees == "whole task" else self.task_embedding
        avoid, violates = subtask_avoid(tree), forbidden(tree)
        if self.exclusions is not None:
            spoils = self.exclusions(tree)
            avoid, violates = avoid | spoils, violates | spoils
        instruction = Instruction(
            reach=tree.reach.astype(jnp.float32),
            avoid=avoid.astype(jnp.float32),
            forbidden=violates[:, : None if self.config.forbidden else 0].astype(jnp.float32),
            ahead=lookahead(tree, depth).astype(jnp.float32),
            behind=lookback(tree, self.config.memory).astype(jnp.float32),
            future=embed(tree),
        )
        if self.sees == "sub-task":
            instruction = dataclasses.replace(
                instruction, ahead=jnp.zeros_like(instruction.ahead), future=jnp.zeros_like(instruction.future)
            )
        return dataclasses.replace(instruction, ahead=with_stays(tree, instruction.ahead))

    def remaining(
        self, messages: Float32[Array, "*lead N F"], edges: Bool[Array, "*lead N"]
    ) -> Float32[Array, "*lead F"]:
        """Embedding of what remains while some edges are open (bool ``[..., N]``), ``[..., F]``."""
        return self.task_embedding.of_edges(messages, edges)

    def see(self, view: tuple[Planes, Shared], instruction: Instruction) -> Sight:
        """What is seen on a sub-task, by role and turned or reflected where the settings say so.

        Args:
            view: the observation, as ``env.proposition_view`` gives it.
            instruction: the assigned sub-task and what follows.
        """
        planes, shared = view
        close = (planes / self.config.near) ** 8 if self.config.near and planes.ndim == 2 else None
        if not self.config.roles:
            return Sight(planes if close is None else jnp.concatenate([planes, close]), shared, None)
        planes, lookahead = self._by_role(planes, instruction), instruction.ahead.shape[0]
        if close is not None:
            now = dataclasses.replace(instruction, ahead=instruction.ahead[:0])
            planes = jnp.concatenate([planes, self._by_role(close, now)])
        if self.config.symmetric and isinstance(self.symmetries, Symmetries):
            planes, order = turn(planes, self.symmetries, lookahead)
            return Sight(planes, shared, order)
        if self.config.symmetric and isinstance(self.symmetries, Reflections):
            return Sight(*reflect(planes, shared, self.symmetries, lookahead))
        return Sight(planes, shared, None)

    def respond(self, sight: Sight, instruction: Instruction) -> tuple[Float32[Array, " outputs"], Float32[Array, ""]]:
        """The actor's outputs ``[num_outputs]`` and the value ``[]`` of what is seen, see `__call__`."""
        x = self._encoded(self.encoder, self.chart, sight, instruction)
        outputs, frame = self.actor(x), sight.frame
        if frame is not None and isinstance(self.symmetries, Symmetries):
            outputs = outputs[frame]
        elif frame is not None:
            # The outputs are means and deviations: a mean changes its sign with the action, its deviation does not.
            outputs = outputs * jnp.concatenate([frame, jnp.ones(self.num_outputs - len(frame), jnp.float32)])
        if self.critic_encoder is not None:
            x = self._encoded(self.critic_encoder, self.critic_chart, sight, instruction)
        return outputs, self.critic(x)[0]

    def __call__(
        self, view: tuple[Planes, Shared], instruction: Instruction
    ) -> tuple[Float32[Array, " outputs"], Float32[Array, ""]]:
        """Acts on one sub-task.

        Args:
            view: the observation, as ``env.proposition_view`` gives it.
            instruction: the assigned sub-task and what follows.

        Returns:
            The actor's outputs ``[num_outputs]`` and the value ``[]``.
        """
        return self.respond(self.see(view, instruction), instruction)

    def everything(
        self, view: tuple[Planes, Shared], tree: TaskTree
    ) -> tuple[Float32[Array, " outputs"], Float32[Array, ""]]:
        """Touches every parameter, for initialisation."""
        return self(view, jax.tree.map(lambda x: x[0], self.instruct(tree)))

    def _encoded(
        self, encoder: Encoder, chart: MLP | None, sight: Sight, instruction: Instruction
    ) -> Float32[Array, " _"]:
        """What actor or critic start from: the latent, the sub-task, and the embedding of what remains."""
        shared = sight.shared
        if chart is not None:
            charted = chart(with_waves(shared, self.config.waves)).reshape(self.num_propositions, -1)
            shared = jnp.concatenate([shared, self._by_role(charted, instruction).reshape(-1)])
        return jnp.concatenate([nn.relu(encoder(sight.planes, shared)), *self._of_task(instruction)])

    def _by_role(self, planes: Planes, instruction: Instruction) -> Float32[Array, "R ..."]:
        """What is seen of the goal, of what to avoid, of what lies ahead and of what is forbidden, ``[R, ...]``.

        By role the encoder need not push the whole observation through its latent to find the goal afterwards.
        """
        alone = instruction.forbidden.reshape(-1, planes.shape[0])  # a row, or none
        weights = jnp.concatenate([instruction.reach[None], instruction.avoid[None], instruction.ahead, alone])
        roles = jnp.tensordot(weights, planes, axes=1)
        return jnp.concatenate([roles, planes]) if self.config.names else roles

    def _of_task(self, instruction: Instruction) -> tuple[Float32[Array, " _"], Float32[Array, " F"]]:
        """Features of the sub-task and of those before it, scaled, and the embedding of what remains."""
        future = self.task_embedding.of_sequence(instruction.ahead) if self.follows_plan else instruction.future
        told = (instruction.reach, instruction.avoid, instruction.forbidden, *instruction.behind)
        current = self.config.task_scale * jnp.concatenate(told)
        # An embedding of the same scale would outweigh the sub-task; without a sub-task it is the only conditioning.
        return current, future * (self.config.task_scale if self.sees == "whole task" else 1.0)


def with_waves(x: Float32[Array, " F0"], octaves: int) -> Float32[Array, " _"]:
    """Features with their sines and cosines at wavelengths 4, 2, 1, ...: ``[F0 (1 + 2 octaves)]``."""
    angles = (x * (jnp.pi / 2) * 2.0 ** jnp.arange(octaves)[:, None]).reshape(-1)
    return jnp.concatenate([x, jnp.sin(angles), jnp.cos(angles)])
