"""Computing the nodes of many trees only where they are needed: most are padding, or other branches.

Axes: **R** rows: nodes of one tree or of several, one after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32

from envs_jax.arrays import Array


def where_needed(
    function: Callable[..., Float32[Array, "R _"]], needed: Bool[Array, " R"], rows: Any, most: int
) -> Float32[Array, "R _"]:
    """What a function makes of rows: of those that are needed alone if they are no more than ``most``, else of all.

    Args:
        function: ``(rows, place)``, rows in and out; ``place`` says where each of the R went, int32 ``[R]``.
        needed: bool ``[R]``. What comes out for the others is meaningless, but finite.
        rows: pytree, leading axis R.
        most: how many rows the smaller of both programs computes.
    """
    num_rows = needed.shape[0]

    def some() -> Float32[Array, "R _"]:
        index = jnp.nonzero(needed, size=most, fill_value=num_rows)[0]
        place = jnp.cumsum(needed, dtype=jnp.int32) - 1
        found = function(jax.tree.map(lambda x: x.at[index].get(mode="fill", fill_value=0), rows), place)
        return jnp.zeros((num_rows, found.shape[1]), found.dtype).at[index].set(found, mode="drop")

    def all_of_them() -> Float32[Array, "R _"]:
        return function(rows, jnp.arange(num_rows, dtype=jnp.int32))

    return jax.lax.cond(needed.sum() <= most, some, all_of_them)
