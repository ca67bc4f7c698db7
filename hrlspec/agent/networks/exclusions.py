"""What cannot be reached any more once something else has been: learned by counting, and avoided where it is owed.

Not in the paper. A world may take away what a task still asks for: where blue makes green vanish, a task that asks for
green has failed at blue, although no part of it forbids blue. The agent sees in its own experience that green is never
entered after blue, however often that was to be expected, and adds blue to p₋ while green is owed.

Axes: **T** time steps, **E** environments, **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.networks.tree import sweep_up
from hrlspec.spec import TaskTree

EXPECTED = 100.0
"""Entries to be expected before their absence says anything."""
RARE = 0.01
"""Share of the entries to be expected up to which they count as absent."""


@struct.dataclass
class Entries:
    """What was entered after what, counted in rollouts: sums, which can be added up.

    Attributes:
        after: float32 ``[P, P]``, how often the second proposition was entered when the first had held before, in the
            same episode and rollout.
        exposed: float32 ``[P]``, steps at which a proposition had held before.
        entered: float32 ``[P]``, how often each was entered.
        steps: float32 ``[]``.
    """

    after: Float32[Array, "P P"]
    exposed: Float32[Array, " P"]
    entered: Float32[Array, " P"]
    steps: Float32[Array, ""]

    @classmethod
    def none(cls, num_propositions: int) -> Entries:
        """Before anything was counted."""
        each = jnp.zeros(num_propositions, jnp.float32)
        return cls(jnp.zeros((num_propositions, num_propositions), jnp.float32), each, each, jnp.float32(0))

    def excluded(self) -> Bool[Array, "P P"]:
        """Whether the second proposition is out of reach once the first has held, as far as is known, ``[P, P]``."""
        expected = self.exposed[:, None] * self.entered / jnp.maximum(self.steps, 1.0)
        return (expected >= EXPECTED) & (self.after <= RARE * expected)


def entries(labels: Bool[Array, "T E P"], episode: Int32[Array, "T E"]) -> Entries:
    """Counts a rollout: what holds after each step, and which of the environment's episodes the step belongs to."""
    first = jnp.ones(episode.shape[1:], bool)[None]
    first = jnp.concatenate([first, episode[1:] != episode[:-1]])[..., None]
    begun = labels & (first | ~jnp.roll(labels, 1, 0))
    total = jnp.cumsum(labels, 0, jnp.int32)
    earlier = total - labels
    before = earlier > jax.lax.cummax(jnp.where(first, earlier, 0), 0)
    return Entries(
        after=jnp.einsum("tep,teq->pq", before.astype(jnp.float32), begun.astype(jnp.float32)),
        exposed=before.sum((0, 1), jnp.float32),
        entered=begun.sum((0, 1), jnp.float32),
        steps=jnp.float32(episode.size),
    )


def owed(tree: TaskTree) -> Bool[Array, "N P"]:
    """What every way through an edge reaches, on the edge itself or later, bool ``[N, P]``."""
    parent, edges = jnp.asarray(tree.parent), jnp.asarray(tree.edges)
    leads_on = jnp.zeros(tree.num_nodes, bool).at[parent].max(edges)

    def visit(common: Bool[Array, "N P"], node: Int32[Array, ""]) -> tuple[Bool[Array, "N P"], Bool[Array, " P"]]:
        reached = jnp.asarray(tree.reach)[node] | (common[node] & leads_on[node])
        return common.at[parent[node]].min(reached | ~edges[node]), reached

    found: Bool[Array, "N P"] = sweep_up(visit, jnp.ones(tree.reach.shape, bool))
    return found


def spoils(owed: Bool[Array, "N P"], reach: Bool[Array, "N P"], excluded: Bool[Array, "P P"]) -> Bool[Array, "N P"]:
    """What puts something owed on each edge out of reach, bool ``[N, P]``; not what the edge itself is there for."""
    return ((owed.astype(jnp.float32) @ excluded.T.astype(jnp.float32)) > 0) & ~reach


class Exclusions(nn.Module):
    """Holds the counts, as a collection beside the parameters, without gradient.

    Attributes:
        later: whether what is owed after a sub-task counts as well as the sub-task itself.
    """

    COLLECTION = "experience"
    later: bool

    @nn.compact
    def __call__(self, tree: TaskTree) -> Bool[Array, "N P"]:
        """What each edge must avoid by experience, bool ``[N, P]``."""
        counts: Any = self.variable(self.COLLECTION, "entries", Entries.none, tree.num_propositions)
        return spoils(owed(tree) if self.later else tree.reach, tree.reach, counts.value.excluded())
