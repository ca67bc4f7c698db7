"""Where a Zone episode takes place, and how such places are drawn.

Axes: **P** = 4 colours, **Z** = 2 zones of each.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int32, Key

from envs_jax.arrays import Array
from envs_jax.base import Thing

COLOURS = ("blue", "green", "red", "yellow")
ZONES_EACH = 2
NUM_ZONES = len(COLOURS) * ZONES_EACH

SPAWN = 2.5
"""Half the side of the square in which objects and their keep-outs lie (m)."""
ROBOT_KEEPOUT, ZONE_KEEPOUT = 0.4, 0.55
"""Radii (m): no two keep-outs overlap, and none leaves the square."""
MOST_DRAWS = 100
"""Draws for one object before the whole layout is begun anew."""

_BLOCK = 20
"""Draws made at once: most objects find their place in one block."""
_NOWHERE = 1e6
"""Coordinates of what is not placed yet: far from everything."""


@struct.dataclass
class ZoneLayout:
    """A layout of Zone.

    Attributes:
        robot: float32 ``[3]``, where the robot starts: x, y (m), heading (rad).
        zones: float32 ``[P, Z, 2]``, centres of the zones (m).
    """

    robot: Float[Array, "*lead 3"]
    zones: Float[Array, "*lead P Z 2"]


@struct.dataclass
class _Draw:
    """A layout in the making: robot first, then zones in order."""

    key: Key[Array, "*lead"]
    placed: Float[Array, "*lead _ 2"]
    count: Int32[Array, "*lead"]  # objects placed
    draws: Int32[Array, "*lead"]  # draws made for the next one
    done: Bool[Array, "*lead"]


def new_layout(key: Key[Array, ""], layout: ZoneLayout, needed: Bool[Array, ""]) -> ZoneLayout:
    """A random layout other than ``layout`` where ``needed`` (bool ``[]``), else ``layout``. The key is consumed.

    Objects are placed in order, each at the first of at most ``MOST_DRAWS`` uniform draws that keeps its distance from
    those before it; when one finds no place (2.5 % of the layouts) the layout is begun anew. All of it is one loop over
    blocks of draws, so that under ``vmap`` a layout that fails or takes long does not make the others wait for whole
    layouts, and that costs nothing where nothing is needed. The loop has no limit: a layout takes more than k attempts
    with probability 0.025^k.
    """
    heading_key, key = jax.random.split(key)
    heading = jax.random.uniform(heading_key, (), jnp.float32, 0.0, 2 * jnp.pi)
    previous = jnp.concatenate([layout.robot[None, :2], layout.zones.reshape(-1, 2)]).astype(jnp.float32)
    nothing = jnp.full((1 + NUM_ZONES, 2), _NOWHERE, jnp.float32)
    start = _Draw(key=key, placed=nothing, count=jnp.int32(0), draws=jnp.int32(0), done=~needed)
    drawn = jax.lax.while_loop(lambda draw: ~draw.done, lambda draw: _place_next(draw, previous), start)
    fresh = ZoneLayout(
        robot=jnp.concatenate([drawn.placed[0], heading[None]]),
        zones=drawn.placed[1:].reshape(len(COLOURS), ZONES_EACH, 2),
    )
    return jax.tree.map(lambda new, old: jnp.where(needed, new, old.astype(jnp.float32)), fresh, layout)


def no_layout() -> ZoneLayout:
    """Like no layout that is ever drawn."""
    return ZoneLayout(robot=jnp.zeros(3, jnp.float32), zones=jnp.zeros((len(COLOURS), ZONES_EACH, 2), jnp.float32))


def things_in(layout: ZoneLayout, names: Sequence[str]) -> tuple[Thing, ...]:
    """Zones in the order of their colours, and the robot."""
    zones = [Thing(name, (x, y)) for name, some in zip(names, layout.zones.tolist(), strict=True) for x, y in some]
    x, y = layout.robot[:2].tolist()
    return (*zones, Thing("", (x, y)))


def rearranged(layout: ZoneLayout, places: Float[np.ndarray, "_ 2"], radius: float) -> ZoneLayout:
    """The same layout with zones and robot elsewhere; it keeps its heading.

    Raises:
        ValueError: two zones overlap.
    """
    *zones, robot = places.astype(np.float32)
    apart = np.linalg.norm(places[:-1, None] - places[:-1], axis=-1) + np.diag(np.full(len(zones), np.inf))
    if apart.min() < 2 * radius:
        raise ValueError("two zones overlap")
    return ZoneLayout(
        robot=np.concatenate([robot, layout.robot[2:]]),  # type: ignore[arg-type]
        zones=np.reshape(zones, layout.zones.shape),  # type: ignore[arg-type]
    )


def _place_next(draw: _Draw, previous: Float[Array, "objects 2"]) -> _Draw:
    """One block of draws for the next object."""
    index = np.arange(1 + NUM_ZONES)
    key, draw_key = jax.random.split(draw.key)
    is_robot = draw.count == 0
    reach = jnp.where(is_robot, jnp.float32(SPAWN - ROBOT_KEEPOUT), jnp.float32(SPAWN - ZONE_KEEPOUT))
    candidates = reach * jax.random.uniform(draw_key, (_BLOCK, 2), jnp.float32, -1.0, 1.0)
    # The robot comes first, so what is being placed near something else is always a zone.
    apart = np.where(index == 0, ROBOT_KEEPOUT + ZONE_KEEPOUT, 2 * ZONE_KEEPOUT)
    least = (apart**2).astype(np.float32)
    dx = candidates[:, None, 0] - draw.placed[:, 0]
    dy = candidates[:, None, 1] - draw.placed[:, 1]
    free = (dx * dx + dy * dy >= least).all(-1)
    found = free.any()
    place = candidates[jnp.argmax(free)]
    placed = jnp.where(((index == draw.count) & found)[:, None], place, draw.placed)
    count = draw.count + found
    draws = jnp.where(found, 0, draw.draws + _BLOCK)
    complete = count == len(index)
    failed = (draws >= MOST_DRAWS) | (complete & (placed == previous).all())
    return _Draw(
        key=key,
        placed=jnp.where(failed, _NOWHERE, placed),
        count=jnp.where(failed, 0, count),
        draws=jnp.where(failed, 0, draws),
        done=complete & ~failed,
    )
