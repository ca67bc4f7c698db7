"""Letter layouts with something to teach about looking ahead: going to the nearest place first costs steps later.

Axes: **n** rows and columns, **P** letters.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, Int8, Int32, Key

from envs_jax.arrays import Array

FAR = 60
"""Steps to a letter that is not there; twice this fits 8 bits, which make the search eight times as fast as 32."""


def myopia_regret(layout: Int[Array, "n n"], num_letters: int) -> Int8[Array, "P P"]:
    """Steps lost by nearest-first for every pair of letters, on the way from (0, 0) to the first, then to the second.

    Among equally near cells of the first letter the worst counts, and nothing is avoided: this ranks layouts, it does
    not solve them.

    Args:
        layout: int8 ``[n, n]``, the letter of each cell, negative for none.
        num_letters: P.

    Returns:
        int8 ``[P, P]``, row: the first letter, column: the second; 0 where nothing is lost or a letter is missing.
    """
    size = layout.shape[0]
    gap = np.abs(np.arange(size)[:, None] - np.arange(size)[None, :])
    wrapped = np.minimum(gap, size - gap).astype(np.int8)
    here = layout == jnp.arange(num_letters, dtype=layout.dtype)[:, None, None]
    # Steps from every cell to each letter: along the row first, then along the column.
    onward = jnp.where(here, 0, FAR).astype(jnp.int8)
    onward = (onward[:, :, None, :] + wrapped[:, :]).min(-1)
    onward = (onward[:, None, :, :] + wrapped[:, :, None]).min(-2)
    near = jnp.where(here, wrapped[0][:, None] + wrapped[0][None, :], jnp.int8(FAR)).reshape(num_letters, -1)
    total = jnp.minimum(near[:, None] + onward.reshape(1, num_letters, -1), jnp.int8(FAR))
    nearest = (near == near.min(-1, keepdims=True))[:, None]
    return jnp.where(nearest, total, jnp.int8(-1)).max(-1) - total.min(-1)


def most_contested(
    key: Key[Array, ""], regret: Int8[Array, "P P"], tries: int
) -> tuple[Int32[Array, ""], Int32[Array, ""]]:
    """The pair of letters with the largest regret among ``tries`` random ones, int32 ``[]`` each. Consumes the key."""
    num_letters = regret.shape[0]
    chance = jax.random.uniform(key, (2, tries), jnp.float32)
    first = (chance[0] * num_letters).astype(jnp.int32)
    second = (first + 1 + (chance[1] * (num_letters - 1)).astype(jnp.int32)) % num_letters
    best = jnp.argmax(regret[first, second])
    return first[best], second[best]
