"""How much nearest-first loses in a layout: which layouts have something to teach about looking ahead.

Axes: **S** states of a finite environment, **P** atomic propositions.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hrlspec.spec import TaskTree

FAR = 10_000  # twice this fits 16 bits, which halve the time


def opening(tree: TaskTree) -> tuple[jax.Array, jax.Array]:
    """What a task's first edge reaches and what the first edge after it does, bool ``[P]`` each; all false if none."""
    second = (tree.parent == 1) & tree.valid
    return tree.reach[1], tree.reach[jnp.argmax(second)] & second.any()


def myopia_regret(
    distances: jax.Array, labels: jax.Array, start: jax.Array, first: jax.Array, second: jax.Array
) -> jax.Array:
    """Steps lost by nearest-first: to the nearest place of ``first``, from there to the nearest of ``second``.

    Among equally near places the worst counts, and nothing is avoided: this ranks layouts, it does not solve
    them (``hrlspec.solver`` does).

    Args:
        distances: int ``[S, S]``, steps between any two states, less than 10,000.
        labels: bool ``[S, P]``.
        start: int32 ``[]``.
        first, second: bool ``[P]``, propositions to hold together; a task without a second step has no regret.

    Returns:
        int32 ``[]``, 0 where nothing is lost or a step cannot be met.
    """
    distances = distances.astype(jnp.int16)
    here = (labels | ~first).all(-1)
    there = (labels | ~second).all(-1)
    far = jnp.int16(FAR)
    onward = jnp.where(there[None, :], distances, far).min(-1)
    near = jnp.where(here, distances[start], far)
    total = near + onward
    nearest = jnp.where(near == near.min(), total, jnp.int16(-1)).max()
    regret = nearest - jnp.where(here, total, far).min()
    return jnp.where(here.any() & there.any() & second.any(), regret, 0).astype(jnp.int32)
