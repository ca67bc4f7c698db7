"""The implicit planner: high-level policy and value over the remaining task (paper, "High-level Module").

Axes: **N** tree nodes, **P** atomic propositions, **F** features.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.distributions import MASKED
from hrlspec.agent.networks.encoder import MLP, Encoder, Planes, Shared, initializer
from hrlspec.agent.networks.tree import sum_to_parents, sweep_up
from hrlspec.config import Checked, NetworkConfig, setting
from hrlspec.spec import TaskState, TaskTree, open_edges, subtask_avoid


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
        features = c.features
        self.encoder = Encoder(e.latent, e.conv_channels, e.encoder_mlp)
        self.transition = MLP((c.hidden, c.hidden, e.latent), final_scale=0.1)
        self.project = nn.Dense(features, kernel_init=initializer(1.0))
        self.message = MLP((features, features))
        self.update = MLP((features, features))
        self.normalise = nn.LayerNorm(use_bias=False, use_scale=False)
        self.policy = MLP((*c.policy, 1), final_scale=0.01)
        self.value = MLP((c.hidden, c.hidden, 1), tanh=True, final_scale=1.0)

    def encode(self, view: tuple[Planes, Shared]) -> Float32[Array, " latent"]:
        """Latent of one observation, float32 ``[latent]``."""
        return self.encoder(*view)

    def predict(self, latent: Float32[Array, " latent"], reach: Bool[Array, " P"]) -> Float32[Array, " latent"]:
        """Latent after completing a sub-task, ``h + T(h, p₊)``."""
        return latent + self.transition(jnp.concatenate([latent, reach.astype(latent.dtype)], -1))

    def latent_tree(
        self, latent: Float32[Array, " latent"], tree: TaskTree, root: Int32[Array, ""]
    ) -> Float32[Array, "N latent"]:
        """Forward pass: predicted latents of every node below ``root``, ``[N, latent]``; meaningless elsewhere.

        Nodes come in topological order, so each is computed once, from its parent.
        """

        def expand(
            self: Planner, latents: Float32[Array, "N latent"], node: Int32[Array, ""]
        ) -> tuple[Float32[Array, "N latent"], None]:
            child = self.predict(latents[tree.parent[node]], tree.reach[node])
            return latents.at[node].set(jnp.where(node == root, latent, child)), None

        scan = nn.scan(expand, variable_broadcast="params", split_rngs={"params": False})
        return scan(
            self,
            jnp.zeros((tree.num_nodes, latent.shape[-1]), jnp.float32),
            jnp.arange(tree.num_nodes, dtype=jnp.int32),
        )[0]

    def embed(self, latents: Float32[Array, "N latent"], tree: TaskTree, state: TaskState) -> Float32[Array, "N F"]:
        """Backward pass: messages flow from children to parents over reversed edges (eq. 3), ``[N, F]``.

        A blocked edge sends no message.
        """
        goal = tree.reach.astype(jnp.float32)
        edge = jnp.concatenate([goal, subtask_avoid(tree).astype(jnp.float32)], -1)
        sends = tree.edges & ~state.blocked
        x = self.project(latents)
        if not self.config.rounds:

            def visit(
                self: Planner, incoming: Float32[Array, "N F"], node: Int32[Array, ""]
            ) -> tuple[Float32[Array, "N F"], Float32[Array, " F"]]:
                parent = tree.parent[node]
                here = self.update(jnp.concatenate([x[node], goal[node], incoming[node]]))
                sent = jnp.concatenate([here, goal[node], x[parent], goal[parent], edge[node]])
                return incoming.at[parent].add(self.message(sent) * sends[node]), here

            return sweep_up(visit, self, jnp.zeros_like(x))
        for _ in range(self.config.rounds):
            x = jnp.concatenate([x, goal], -1)
            incoming = self.message(jnp.concatenate([x, x[tree.parent], edge], -1))
            x = self.update(jnp.concatenate([x, sum_to_parents(incoming, tree.parent, sends)], -1))
            # The rounds share their weights: what grows in one grows in all, at first to a hundredfold.
            x = self.normalise(x)
        return x

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
        embeddings = self.embed(self.latent_tree(latent, tree, state.node), tree, state)
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
        logits = self.policy(jnp.concatenate([x.astype(jnp.float32) for x in inputs], -1))[:, 0] + behind
        value = self.value(root)[0] + best
        return jnp.where(feasible, logits, MASKED), value
