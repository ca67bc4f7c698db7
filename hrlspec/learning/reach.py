"""Training of the reach critic: Q-learning of all goals from every transition (paper, "Avoiding Propositions").

Axes: **E** environments, **T** time steps, **P** atomic propositions.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.experience import Step, View, flat
from hrlspec.agent.low_level import LowLevel
from hrlspec.learning.optimiser import Metrics


@struct.dataclass
class ReachBatch:
    """Transitions, leading axes ``[E, T]``."""

    view: View
    action: Int32[Array, "E T"] | Float32[Array, "E T A"]
    target: Float32[Array, "E T P"]


def reach_batch(low: LowLevel, steps: Step) -> ReachBatch:
    """Transitions of a rollout ``[T, E]``.

    The target is 1 where the goal holds after the step, else discount · max_a Q(s', g, a): the end of a task is not the
    end of the world in which its other letters can be reached.
    """
    target = jnp.where(steps.outcome.labels, 1.0, low.config.shield.discount * steps.reach_value)
    batch = ReachBatch(steps.view, steps.low.action, target)
    by_env: ReachBatch = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch)
    return by_env


def reach_loss(low: LowLevel, params: Any, batch: ReachBatch) -> tuple[Float32[Array, ""], Metrics]:
    """Mean squared error of Q(s, g, a) over all goals g; ``params`` is ``params["reach_critic"]``."""
    batch = jax.tree.map(flat, batch)
    own = {"reach_critic": params}
    values = jax.vmap(low.reach_values_of, in_axes=(None, 0, 0))(own, batch.view, batch.action)
    loss = ((values - batch.target) ** 2).mean()
    return loss, {"value_loss": loss}
