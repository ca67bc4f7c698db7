"""Turning and reflecting what the low level sees, so that what is learned in one direction is known in all.

Axes: **R** roles, **H** rows and columns, **L** features of a proposition, **A** actions or their components.
"""

from __future__ import annotations

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Int32, Shaped

from envs_jax import Reflections, Symmetries
from envs_jax.arrays import Array


def turn(
    planes: Float32[Array, "R H H"], symmetries: Symmetries, lookahead: int
) -> tuple[Float32[Array, "R H H"], Int32[Array, " A"]]:
    """Turns images by role so that the goal, and then what comes after it, lies in one sector.

    Args:
        planes: float32 ``[R, H, H]``, the agent in the middle: the goal, what to avoid, what lies ahead, anything else.
        symmetries: says that they may be turned.
        lookahead: images of what lies ahead.

    Returns:
        The images, and for each action its place among the turned ones, int32 ``[A]``.
    """
    size = planes.shape[-1]
    # What is seen of each goal, one number for every turn, which is largest where most of it lies in the sector.
    # Turning the images back turns the weights forth, hence their inverse permutation.
    cells = np.array([turned(np.arange(size**2).reshape(size, size), *bits).reshape(-1) for bits in TURNS])
    seen = planes.reshape(planes.shape[0], -1) @ sector_weights(size)[np.argsort(cells)].T
    score = seen[0] + 0.05 * seen[2 : 2 + lookahead].sum(0)
    best = jnp.argmax(score)
    # One select after the other: to gather by an index that is computed takes longer. The barrier keeps XLA from
    # computing what the images are made of anew in each branch of each select.
    planes = jax.lax.optimization_barrier(planes)
    for which in np.eye(3, dtype=bool).tolist():
        wanted = jnp.asarray([bool((bits & np.array(which)).any()) for bits in np.array(TURNS)])[best]
        planes = jnp.where(wanted, turned(planes, *which), planes)
    return planes, jnp.asarray(symmetries.actions, jnp.int32)[best]


def reflect(
    planes: Float32[Array, "R L"], shared: Float32[Array, " F0"], reflections: Reflections, lookahead: int
) -> tuple[Float32[Array, "R L"], Float32[Array, " F0"], Shaped[Array, " A"]]:
    """Reflects vectors by role so that the agent moves forward, and at rest towards what comes after the goal.

    Were it the goal first, the nearest of its instances would nearly always be right; see `sector_weights`.

    Args:
        planes: float32 ``[R, L]``: the goal, what to avoid, what lies ahead.
        shared: float32 ``[F0]``.
        reflections: how they may be reflected.
        lookahead: how many rows tell what lies ahead.

    Returns:
        Both, reflected, and the signs of actions, float32 ``[A]``.
    """
    orders = np.array(reflections.features)
    # Weights of the features as they are, one row for each reflection.
    weights = np.array(reflections.sector, np.float32)[np.argsort(orders)]
    after = planes[2] if lookahead else jnp.zeros_like(planes[0])
    signs = np.array(reflections.signs, np.float32)
    moves = signs * np.array(reflections.heading, np.float32)
    best = jnp.argmax(weights @ (0.05 * planes[0] + after) + (shared[np.array(reflections.shared)] * moves).sum(-1))

    def chosen(rows: Any) -> Shaped[Array, "..."]:
        return jnp.asarray(np.array(rows))[best]

    planes = planes[:, chosen(orders)]
    return planes, shared[chosen(reflections.shared)] * chosen(signs), chosen(reflections.actions)


TURNS = tuple(itertools.product((False, True), repeat=3))
"""Transpose, reverse rows, reverse columns: in the order of :class:`envs_jax.Symmetries`."""


def turned(image: Any, transpose: bool, rows: bool, columns: bool) -> Any:
    """An image ``[..., H, W]`` after one turn (numpy or JAX)."""
    image = image.swapaxes(-1, -2) if transpose else image
    image = image[..., ::-1, :] if rows else image
    return image[..., ::-1] if columns else image


def sector_weights(size: int) -> Float32[np.ndarray, " cells"]:
    """Weights ``[size²]`` that fall with the distance from the middle, and for equal distance prefer a sector."""
    rows, columns = np.divmod(np.arange(size**2), size)
    down, right = rows - size // 2, columns - size // 2
    # All instances of the goal count, near ones a little more. Were the nearest to decide, the same action would nearly
    # always be right, and a policy that is sure of it never finds out where another instance is better.
    return ((2 + down / size + right / (3 * size)) * 1.5 ** -(np.abs(down) + np.abs(right))).astype(np.float32)
