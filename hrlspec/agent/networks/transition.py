"""The latent transition model: what completing a sub-task makes of a latent state (paper, "Latent Transition Model").

Axes: **N** tree nodes, **P** atomic propositions, **H** hidden units.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.networks.encoder import initializer
from hrlspec.spec import TaskTree


class Transition(nn.Module):
    """h + T(h, p₊), with a perceptron T of two hidden layers and a linear end.

    Attributes:
        hidden: H, units of each hidden layer.
        latent: width of a latent.
    """

    hidden: int
    latent: int

    def setup(self) -> None:
        """Declares the weights: of the latent, of the sub-task, between the hidden layers, and of the change."""
        gain = 2.0**0.5
        self.state = self.param("state", initializer(gain), (self.latent, self.hidden))
        self.goal = nn.Dense(self.hidden, kernel_init=initializer(gain))
        self.inner = self.param("inner", initializer(gain), (self.hidden, self.hidden))
        self.inner_bias = self.param("inner_bias", nn.initializers.zeros, (self.hidden,), jnp.float32)
        self.change = self.param("change", initializer(0.1), (self.hidden, self.latent))

    def __call__(self, latent: Float32[Array, " latent"], reach: Bool[Array, " P"]) -> Float32[Array, " latent"]:
        """The latent after completing a sub-task."""
        return latent + self._hidden(latent @ self.state, self._goals(reach)) @ self.change

    def down(
        self, latent: Float32[Array, " latent"], tree: TaskTree, root: Int32[Array, ""]
    ) -> Float32[Array, "N latent"]:
        """Latents of every node below ``root``, each from its parent's, ``[N, latent]``; meaningless elsewhere.

        A latent is the root's and a linear function of the hidden units on the way added up, so these alone are handed
        on, and the two linear maps between one node's last hidden layer and the next one's first are one matrix. Nodes
        come in topological order.
        """
        start, goals, between = latent @ self.state, self._goals(tree.reach), self.change @ self.state

        def expand(sums: Float32[Array, "N H"], node: Int32[Array, ""]) -> tuple[Float32[Array, "N H"], None]:
            above = sums[tree.parent[node]]
            here = above + self._hidden(start + above @ between, goals[node])
            return sums.at[node].set(jnp.where(node == root, 0.0, here)), None

        nothing = jnp.zeros((tree.num_nodes, self.hidden), jnp.float32)
        sums: Any = jax.lax.scan(expand, nothing, jnp.arange(tree.num_nodes, dtype=jnp.int32))[0]
        return latent + sums @ self.change

    def _goals(self, reach: Bool[Array, "*lead P"]) -> Float32[Array, "*lead H"]:
        """What sub-tasks contribute to the first layer."""
        return self.goal(reach.astype(jnp.float32))

    def _hidden(self, state: Float32[Array, " H"], goal: Float32[Array, " H"]) -> Float32[Array, " H"]:
        """The second hidden layer, from what the latent and the sub-task contribute to the first."""
        return nn.relu(nn.relu(state + goal) @ self.inner + self.inner_bias)
