"""Applying a costly function only to the environments that need it.

Axes: **E** environments.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Bool

from envs_jax.arrays import Array

Inputs = TypeVar("Inputs")
Outputs = TypeVar("Outputs")


def in_groups(
    function: Callable[[Inputs], Outputs], needed: Bool[Array, " E"], inputs: Inputs, outputs: Outputs, group: int
) -> Outputs:
    """Computes ``function`` where it is needed, ``group`` environments at a time.

    A vmapped ``cond`` would compute it for all of them at every step. Instead the waiting ones are gathered
    in groups of fixed size, computed, and scattered back, until none waits.

    Args:
        function: maps gathered inputs (leading axis ``group``) to outputs of the same leading axis.
        needed: bool ``[E]``.
        inputs: pytree, leading axis E.
        outputs: pytree, leading axis E: what the others keep.
        group: how many at a time.
    """
    num_envs = needed.shape[0]
    group = min(group, num_envs)

    def body(carry: tuple[Bool[Array, " E"], Outputs]) -> tuple[Bool[Array, " E"], Outputs]:
        waiting, outputs = carry
        index = jnp.nonzero(waiting, size=group, fill_value=num_envs)[0]
        results = function(jax.tree.map(lambda x: x[jnp.minimum(index, num_envs - 1)], inputs))
        outputs = jax.tree.map(lambda out, new: out.at[index].set(new, mode="drop"), outputs, results)
        return waiting.at[index].set(False, mode="drop"), outputs

    return jax.lax.while_loop(lambda carry: carry[0].any(), body, (needed, outputs))[1]
