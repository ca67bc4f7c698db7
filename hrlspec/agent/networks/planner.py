"""The implicit planner: high-level policy and value over the remaining task (paper, "High-level Module").

Axes: **N** tree nodes, **P** atomic propositions, **F** features.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32

from envs_jax.arrays import Array
from hrlspec.agent.distributions import MASKED
from hrlspec.agent.networks.encoder import MLP, Encoder, Planes, Shared, initializer
from hrlspec.agent.networks.messages import Rounds, Sweep
from hrlspec.agent.networks.rows import where_needed
from hrlspec.agent.networks.transition import Transition
from hrlspec.config import Checked, NetworkConfig, setting
from hrlspec.spec import TaskState, TaskTree, initial, open_edges, subtask_avoid


@dataclasses.dataclass(frozen=True)
class PlannerConfig(Checked):
    """Sizes of the planner's networks (paper, "High-level Architecture"), and what they see."""

    features: int = setting(64, least=1)
    """F, node features of the GNN."""
    hidden: int = setting(128, least=1)
    """Hidden units of the transition model and the critic."""
    policy: tuple[int, ...] = setting((128, 128, 128), least=1)
    """Hidden units of the policy, which is applied to every edge."""
    rounds: int = setting(8, least=0)
    """Rounds of message passing, each normalised; look-ahead ends at this depth. 0: one sweep from the leaves to the
    root, which looks ahead without limit and costs an eighth."""
    child_embeddings: bool = False
    """Whether the logit of an edge also sees the embedding of the node it leads to."""
    advice: float = setting(0.0, least=0, most=1e6)
    """Weight of the low level's value of each candidate sub-task in the logits (gradient stopped); the planner learns a
    correction to it. 0: the planner judges alone, as in the paper."""


@functools.cache
def _at_edges(policy: MLP) -> Callable[..., Any]:
    """The policy at every edge of a tree, or, of many trees, at the open ones alone: few of the nodes are."""

    @jax.custom_batching.custom_vmap
    def one(variables: Any, edges: Float32[Array, "N F"], feasible: Bool[Array, " N"]) -> Float32[Array, "N 1"]:
        del feasible
        return cast(Array, policy.apply(variables, edges))

    @one.def_vmap
    def many(
        size: int, batched: Any, variables: Any, edges: Float32[Array, "B N F"], feasible: Bool[Array, "B N"]
    ) -> tuple[Float32[Array, "B N 1"], bool]:
        del size
        if any(jax.tree.leaves(batched[0])) or not all(batched[1:]):
            axes = jax.tree.map(lambda yes: 0 if yes else None, batched)
            return jax.vmap(one.fun, in_axes=tuple(axes))(variables, edges, feasible), True
        rows = edges.reshape(-1, edges.shape[-1])
        found = where_needed(
            lambda some, _: cast(Array, policy.apply(variables, some)), feasible.reshape(-1), rows, len(rows) // 4
        )
        return found.reshape(*feasible.shape, 1), True

    return one


class Planner(nn.Module):
    """Encoder E, latent transition model T, tree GNN (M, U), policy and value, trained end to end.

    Attributes:
        config: sizes.
        encoding: sizes of the encoder.
    """

    config: PlannerConfig
    encoding: NetworkConfig

    def setup(self) -> None:
        """Declares the parts under the paper's names."""
        c, e = self.config, self.encoding
        self.encoder = Encoder(e.latent, e.conv_channels, e.encoder_mlp)
        self.transition = Transition(c.hidden, e.latent)
        self.project = nn.Dense(c.features, kernel_init=initializer(1.0))
        self.messages = Rounds(c.features, c.rounds) if c.rounds else Sweep(c.features)
        self.policy = MLP((*c.policy, 1), final_scale=0.01)
        self.value = MLP((c.hidden, c.hidden, 1), tanh=True, final_scale=1.0)

    def encode(self, view: tuple[Planes, Shared]) -> Float32[Array, " latent"]:
        """Latent of one observation, float32 ``[latent]``."""
        return self.encoder(*view)

    def predict(self, latent: Float32[Array, " latent"], reach: Bool[Array, " P"]) -> Float32[Array, " latent"]:
        """Latent after completing a sub-task."""
        return self.transition(latent, reach)

    def embed(self, latents: Float32[Array, "N latent"], tree: TaskTree, state: TaskState) -> Float32[Array, "N F"]:
        """Backward pass: messages flow from children to parents over reversed edges (eq. 3), ``[N, F]``.

        A blocked edge sends no message.
        """
        return self.messages(self.project(latents), tree, state)

    def worth(self, latent: Float32[Array, " latent"], sequence: TaskTree) -> Float32[Array, ""]:
        """V^h of a sequence of sub-tasks, none of them done, from the latent of an observation, ``[]``."""
        start = initial(sequence)
        embeddings = self.embed(self.transition.down(latent, sequence, start.node), sequence, start)
        return self.value(embeddings[TaskTree.ROOT])[0]

    def worth_of_view(self, view: tuple[Planes, Shared], sequence: TaskTree) -> Float32[Array, ""]:
        """The same from an observation."""
        return self.worth(self.encode(view), sequence)

    def __call__(
        self, view: tuple[Planes, Shared], tree: TaskTree, state: TaskState, advice: Float32[Array, " N"]
    ) -> tuple[Float32[Array, " N"], Float32[Array, ""]]:
        """Chooses among the open edges and estimates the return of the remaining task.

        Args:
            view: the observation, as ``env.proposition_view`` gives it.
            tree: the task.
            state: where it stands.
            advice: float32 ``[N]``, the low level's value of each edge's sub-task; zeros when not used.

        Returns:
            Logits ``[N]`` (``MASKED`` where infeasible) and the value ``[]``.
        """
        latent = self.encode(view)
        embeddings = self.embed(self.transition.down(latent, tree, state.node), tree, state)
        root = embeddings[state.node]
        feasible = open_edges(tree, state)
        inputs = [jnp.broadcast_to(root, embeddings.shape), tree.reach, subtask_avoid(tree)]
        if self.config.child_embeddings:
            inputs.append(embeddings)
        # The advice counts relative to the best candidate's, which is also the first guess of the value.
        best = jnp.where(feasible.any(), jnp.where(feasible, advice, -jnp.inf).max(), 0.0)
        behind = jnp.where(feasible, self.config.advice * (advice - best), 0.0)
        if self.config.advice:
            inputs.append(behind[:, None])
        edges = jnp.concatenate([x.astype(jnp.float32) for x in inputs], -1)
        if self.is_initializing():
            self.policy(edges)
        logits = _at_edges(self.policy.clone(parent=None))(self.policy.variables, edges, feasible)[:, 0] + behind
        value = self.value(root)[0] + best
        return jnp.where(feasible, logits, MASKED), value
