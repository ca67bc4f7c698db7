"""The low level: a policy and value conditioned on the assigned sub-task and on what remains after it.

Paper, "Low-level Module". Axes: **N** tree nodes, **P** atomic propositions, **G** channels, **D** later sub-tasks,
**C** completed sub-tasks, **F** features.
"""

from __future__ import annotations

import itertools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_jax import Reflections, Symmetries
from hrlspec.agent.networks.encoder import MLP, Encoder
from hrlspec.agent.networks.tree import TaskEmbedding, lookahead, lookback
from hrlspec.config import NetworkConfig
from hrlspec.spec import TaskTree, subtask_avoid


@struct.dataclass
class Instruction:
    """What the low level is told.

    Attributes:
        reach: float32 ``[P]``, p₊ of the assigned sub-task.
        avoid: float32 ``[P]``, p₋ (eq. 2).
        ahead: float32 ``[D, P]``, what may be reached 1, 2, ... sub-tasks after it.
        behind: float32 ``[C, P]``, what was reached 1, 2, ... sub-tasks before it.
        future: float32 ``[F]``, embedding of the task that remains after it, or of the whole remaining task where no
            sub-task is assigned.
    """

    reach: jax.Array
    avoid: jax.Array
    ahead: jax.Array
    behind: jax.Array
    future: jax.Array


def turn(planes: jax.Array, symmetries: Symmetries, lookahead: int) -> tuple[jax.Array, jax.Array]:
    """Turns images by role so that the goal, and then what comes after it, lies in one sector.

    Args:
        planes: float32 ``[R, H, H]``, the agent in the middle: the goal, what to avoid, what lies ahead, anything else.
        symmetries: says that they may be turned.
        lookahead: images of what lies ahead.

    Returns:
        The images, and for each action its place among the turned ones, int32 ``[A]``.
    """
    size = planes.shape[-1]
    # What is seen of each goal, one number for every turn, which is largest where most of it lies in the sector.
    # Turning the images back turns the weights forth, hence their inverse permutation.
    cells = np.array([turned(np.arange(size**2).reshape(size, size), *bits).reshape(-1) for bits in TURNS])
    seen = planes.reshape(planes.shape[0], -1) @ sector_weights(size)[np.argsort(cells)].T
    score = seen[0] + 0.05 * seen[2 : 2 + lookahead].sum(0)
    best = jnp.argmax(score)
    # One select after the other: to gather by an index that is computed takes longer. The barrier keeps XLA from
    # computing what the images are made of anew in each branch of each select.
    planes = jax.lax.optimization_barrier(planes)
    for which in np.eye(3, dtype=bool):
        wanted = jnp.asarray([bool((bits & which).any()) for bits in np.array(TURNS)])[best]
        planes = jnp.where(wanted, turned(planes, *which), planes)
    return planes, jnp.asarray(symmetries.actions, jnp.int32)[best]


def reflect(
    planes: jax.Array, shared: jax.Array, reflections: Reflections, lookahead: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Reflects vectors by role so that the agent moves forward, and at rest towards what comes after the goal.

    Were it the goal first, the nearest of its instances would nearly always be right; see `sector_weights`.

    Args:
        planes: float32 ``[R, L]``: the goal, what to avoid, what lies ahead.
        shared: float32 ``[F0]``.
        reflections: how they may be reflected.
        lookahead: how many rows tell what lies ahead.

    Returns:
        Both, reflected, and the signs of actions, float32 ``[A]``.
    """
    orders = np.array(reflections.features)
    # Weights of the features as they are, one row for each reflection.
    weights = np.array(reflections.sector, np.float32)[np.argsort(orders)]
    after = planes[2] if lookahead else jnp.zeros_like(planes[0])
    moves = np.array(reflections.signs, np.float32) * np.array(reflections.heading, np.float32)
    best = jnp.argmax(weights @ (0.05 * planes[0] + after) + (shared[np.array(reflections.shared)] * moves).sum(-1))

    def chosen(rows: Any) -> jax.Array:
        return jnp.asarray(np.array(rows))[best]

    planes = planes[:, chosen(orders)]
    return planes, shared[chosen(reflections.shared)] * chosen(reflections.signs), chosen(reflections.actions)


TURNS = tuple(itertools.product((False, True), repeat=3))
"""Transpose, reverse rows, reverse columns: in the order of :class:`envs_jax.Symmetries`."""


def turned(image: Any, transpose: bool, rows: bool, columns: bool) -> Any:
    """An image ``[..., H, W]`` after one turn (numpy or JAX)."""
    image = image.swapaxes(-1, -2) if transpose else image
    image = image[..., ::-1, :] if rows else image
    return image[..., ::-1] if columns else image


def sector_weights(size: int) -> np.ndarray:
    """Weights ``[size²]`` that fall with the distance from the middle, and for equal distance prefer a sector."""
    rows, columns = np.divmod(np.arange(size**2), size)
    down, right = rows - size // 2, columns - size // 2
    # All instances of the goal count, near ones a little more. Were the nearest to decide, the same action would nearly
    # always be right, and a policy that is sure of it never finds out where another instance is better.
    return ((2 + down / size + right / (3 * size)) * 1.5 ** -(np.abs(down) + np.abs(right))).astype(np.float32)


class Controller(nn.Module):
    """Encoder, embedding of the remaining task, actor and critic of the low level.

    Attributes:
        config: sizes.
        num_outputs: of the actor; they describe a distribution of ``hrlspec.agent.distributions``.
        symmetries: how the world can be turned or reflected, if at all.
    """

    config: NetworkConfig
    num_outputs: int
    symmetries: Symmetries | Reflections | None = None

    def setup(self) -> None:
        """Declares the parts."""
        c = self.config
        self.task_embedding = TaskEmbedding(c.task_features, c.task_rounds, negatives=c.whole_task)
        self.encoder = Encoder(c.latent, c.conv_channels, c.encoder_mlp)
        self.actor = MLP((*c.actor, self.num_outputs), final_scale=0.01)
        self.critic = MLP((*c.critic, 1), tanh=True, final_scale=1.0)

    def instruct(self, tree: TaskTree) -> Instruction:
        """The instruction for every edge of a task at once, leading axis N.

        With ``whole_task`` what is said of the future is meant for `remaining`.
        """
        depth = self.config.lookahead if self.config.roles else 0
        embed = self.task_embedding.messages if self.config.whole_task else self.task_embedding
        return Instruction(
            reach=tree.reach.astype(jnp.float32),
            avoid=subtask_avoid(tree).astype(jnp.float32),
            ahead=lookahead(tree, depth).astype(jnp.float32),
            behind=lookback(tree, self.config.memory).astype(jnp.float32),
            future=embed(tree),
        )

    def remaining(self, messages: jax.Array, edges: jax.Array) -> jax.Array:
        """Embedding of what remains while some edges are open (bool ``[..., N]``), ``[..., F]``."""
        return self.task_embedding.of_edges(messages, edges)

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
            roles = jnp.tensordot(jnp.concatenate([told.reach[None], told.avoid[None], told.ahead]), planes, axes=1)
            planes = jnp.concatenate([roles, planes]) if self.config.names else roles
        order = signs = None
        symmetries = self.symmetries if self.config.roles and self.config.symmetric else None
        if isinstance(symmetries, Symmetries):
            planes, order = turn(planes, symmetries, told.ahead.shape[0])
        elif isinstance(symmetries, Reflections):
            planes, shared, signs = reflect(planes, shared, symmetries, told.ahead.shape[0])
        latent = nn.relu(self.encoder(planes, shared))
        # With the planner's advice there is a plan, and what remains is the rest of the plan.
        future = self.task_embedding.of_way(told.ahead) if self.config.advice else told.future
        told_now = [told.reach, told.avoid, *told.behind]
        # A future as loud as the sub-task drowns it; where there is no sub-task, it is all that is told.
        told_later = future * (self.config.task_scale if self.config.whole_task else 1.0)
        x = jnp.concatenate([latent, self.config.task_scale * jnp.concatenate(told_now), told_later])
        outputs = self.actor(x)
        if order is not None:
            outputs = outputs[order]
        elif signs is not None:
            # The outputs are means and deviations: a mean changes its sign with the action, its deviation does not.
            outputs = outputs * jnp.concatenate([signs, jnp.ones(self.num_outputs - len(signs))])
        return outputs, self.critic(x)[0]

    def everything(self, view: tuple[jax.Array, jax.Array], tree: TaskTree) -> tuple[jax.Array, jax.Array]:
        """Touches every parameter, for initialisation."""
        return self(view, jax.tree.map(lambda x: x[0], self.instruct(tree)))
