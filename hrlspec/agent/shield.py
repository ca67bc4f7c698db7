"""The shield: no action that would step on a forbidden proposition (paper, "Avoiding Propositions").

Axes: **P** atomic propositions, **K** candidate actions, **A** components of an action.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32

from envs_jax.arrays import Array
from hrlspec.agent.low_level import LowLevel


def shielded_action(
    low: LowLevel,
    reach_values: Float32[Array, "P K"],
    avoid: Bool[Array, " P"],
    action: Int32[Array, ""] | Float32[Array, " A"],
) -> Int32[Array, ""] | Float32[Array, " A"]:
    """Replaces the action where a forbidden proposition is near.

    With k = argmax over p₋ of V(s, g_k): if V(s, g_k) > ν, the action becomes argmin_a Q(s, g_k, a). Maxima and minima
    are over the candidate actions: exact for discrete actions.

    Args:
        low: the networks.
        reach_values: float32 ``[P, K]``, Q(s, g, a) of each proposition and candidate action.
        avoid: bool ``[P]``, p₋ of the sub-task in force.
        action: int32 ``[]`` or float32 ``[A]``, what the policy drew.
    """
    values = jnp.where(avoid[:, None], reach_values, 0.0)
    danger = values.max(-1)
    nearest = jnp.argmax(danger)
    safest = low.actions.candidates()[jnp.argmin(values[nearest])]
    return jnp.where(danger[nearest] > low.config.shield.threshold, safest, action)
