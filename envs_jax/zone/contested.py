"""Layouts of Zone that tell an agent that looks ahead from one that takes the nearest zone.

The task they are for is "first colour, then second". On a contested layout the nearer zone of the first colour lies
away from the only goal that is close to the other one, so that starting with the nearest makes the whole way longer.
Such layouts are drawn to be trained on. Whoever tests takes layouts of all kinds and asks for the `ways` in them.
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int, Key

from envs_jax.arrays import Array
from envs_jax.base import ContestedChoice, ContestedLayouts, EnvParams
from envs_jax.zone.layouts import (
    COLOURS,
    NUM_ZONES,
    SPAWN,
    ZONE_KEEPOUT,
    ZONES_EACH,
    ZoneLayout,
    no_layout,
)

ROBOT_WITHIN = 0.3
"""The robot starts this close to the middle along each axis (m)."""
GOAL_DISTANCE = (1.8, 2.4)
BETTER_SHARE = (0.5, 0.7)
"""Where the better first zone lies on the straight way to the goal, as a share of it."""
NEARER_DISTANCE = (0.8, 1.2)
APART = 1.0
"""Least distance between any two zones (m)."""
LEAST_DETOUR = 0.5
"""How much longer the way over the worse first zone is at least (m)."""
CLEARANCE = 0.55
"""Least distance of the other zones from the straight ways between robot, first zones and goal (m)."""

_MOST_TURN = 0.5
"""The nearer zone is not exactly opposite the goal, but within this angle of it (rad)."""
_NEARER_BY = 0.1
"""The nearer zone is nearer by this much at least (m)."""
_GEOMETRIES = 32
"""Draws of the contest at once; a valid one is among them 98 % of the time."""
_PLACES = 40
"""Draws for each other zone before the whole layout is begun anew; all find a place 9 times in 10."""
_REACH = SPAWN - ZONE_KEEPOUT
_REST = NUM_ZONES - 3
"""Zones besides the contest's own."""
_NOWHERE = 1e6
"""Coordinates of what is not placed yet: far from everything."""


@struct.dataclass
class _Core:
    """What the contest is about."""

    robot: Float[Array, "*lead 2"]
    better: Float[Array, "*lead 2"]  # of the first colour
    nearer: Float[Array, "*lead 2"]  # of the first colour
    goal: Float[Array, "*lead 2"]  # of the second colour


class Contests(ContestedLayouts, ContestedChoice):
    """What worlds of such zones have in common: layouts that are made to be contested, and ways in all others.

    Attributes:
        vanishing: pairs of colours (first, second) of which the first makes the second vanish.
    """

    vanishing: tuple[tuple[str, str], ...]

    def contested_layout(
        self,
        key: Key[Array, ""],
        first: Bool[Array, " P"],
        second: Bool[Array, " P"],
        params: EnvParams,
    ) -> ZoneLayout:
        """A layout on which going to the nearest zone first makes the whole way longer. The key is consumed.

        Args:
            key: of the draw.
            first: bool ``[P]``, the colour to reach first.
            second: bool ``[P]``, the colour to reach after it.
            params: of the environment.

        Returns:
            A `envs_jax.zone.contested.contested_layout`, whose right zone of the first colour is number 0; where a
            colour is missing, several are given or both are the same, what :meth:`sample_layout` draws.
        """
        wanted = (first.sum() == 1) & (second.sum() == 1) & ~(first & second).any()
        plain = self.resample_layout(key, no_layout(), ~wanted, params)
        contested = contested_layout(key, jnp.argmax(first), jnp.argmax(second), needed=wanted)
        return jax.tree.map(lambda this, other: jnp.where(wanted, this, other), contested, plain)

    @property
    def contested_pairs(self) -> tuple[tuple[int, int], ...]:
        """Colours to go to first and then that a contested layout can be about: the first leaves the second there."""
        colours = self.propositions
        names = itertools.permutations(colours, 2)
        return tuple((colours.index(a), colours.index(b)) for a, b in names if (a, b) not in self.vanishing)

    @property
    def least_detour(self) -> float:
        """Half a metre."""
        return LEAST_DETOUR

    def ways(
        self, layout: ZoneLayout, first: Bool[Array, " P"], second: Bool[Array, " P"]
    ) -> tuple[Float32[Array, " I"], Float32[Array, " I"]]:
        """See the function of that name."""
        return ways(layout, jnp.argmax(first), jnp.argmax(second))


def contested_layout(
    key: Key[Array, ""],
    first: Int[Array, ""] | int,
    second: Int[Array, ""] | int,
    *,
    needed: Bool[Array, ""] | bool = True,
) -> ZoneLayout:
    """A random contested layout. The key is consumed.

    Args:
        key: decides everything but the colours.
        first: int ``[]``, index of the colour to go to first.
        second: int ``[]``, index of the colour to go to then; another one.
        needed: bool ``[]``; where false, no layout is drawn and what is returned means nothing.

    Returns:
        The layout. ``zones[first, 0]`` is the better zone of the first colour, ``zones[first, 1]`` the other, and
        ``zones[second, 0]`` the goal; the nearer zone of the first colour is number 1.
    """

    def attempt(carry: tuple[Array, _Core, Array, Array]) -> tuple[Array, _Core, Array, Array]:
        key, core_key, rest_key = jax.random.split(carry[0], 3)
        core, found = _draw_core(core_key)
        rest, placed = _draw_rest(rest_key, core)
        return key, core, rest, found & placed

    heading_key, key = jax.random.split(key)
    heading = jax.random.uniform(heading_key, (), jnp.float32, maxval=2 * jnp.pi)
    nowhere = jnp.zeros(2, jnp.float32)
    start = (key, _Core(nowhere, nowhere, nowhere, nowhere), jnp.zeros((_REST, 2), jnp.float32), ~jnp.bool_(needed))
    _, core, rest, _ = jax.lax.while_loop(lambda carry: ~carry[3], attempt, start)

    pair = jnp.stack([core.better, core.nearer])
    index = jnp.arange(len(COLOURS), dtype=jnp.int32)
    other = (index != first) & (index != second)
    zones = rest[1:].reshape(-1, ZONES_EACH, 2)[jnp.clip(jnp.cumsum(other) - 1, 0, 1)]
    zones = jnp.where((index == first)[:, None, None], pair, zones)
    zones = jnp.where((index == second)[:, None, None], jnp.stack([core.goal, rest[0]]), zones)
    return ZoneLayout(robot=jnp.concatenate([core.robot, heading[None]]), zones=zones)


def _draw_core(key: Key[Array, ""]) -> tuple[_Core, Bool[Array, ""]]:
    """Robot, goal and the two zones of the first colour, and whether a valid draw was found (bool ``[]``)."""
    # All numbers in one draw, for one call of the generator: it is what drawing a layout costs.
    unit = jax.random.uniform(key, (_GEOMETRIES, 7), jnp.float32)

    def between(column: int, limits: tuple[float, float]) -> Float[Array, "..."]:
        return limits[0] + (limits[1] - limits[0]) * unit[:, column]

    robot = ROBOT_WITHIN * (2 * unit[:, :2] - 1)
    # Of the ranges only what leaves the better zone its distance from the goal: all else would be drawn in vain.
    distance = between(2, (APART / (1 - BETTER_SHARE[0]), GOAL_DISTANCE[1]))
    better = distance * between(4, (BETTER_SHARE[0], 1 - APART / GOAL_DISTANCE[1]))
    nearer = between(3, NEARER_DISTANCE)
    angle = between(5, (0.0, 2 * np.pi))
    turned = angle + between(6, (-_MOST_TURN, _MOST_TURN))
    ahead = jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    back = -jnp.stack([jnp.cos(turned), jnp.sin(turned)], -1)
    core = _Core(
        robot=robot,
        better=robot + better[:, None] * ahead,
        nearer=robot + nearer[:, None] * back,
        goal=robot + distance[:, None] * ahead,
    )
    zones = jnp.stack([core.better, core.nearer])
    valid = (_distance(zones, core.goal) >= APART).all(0) & (nearer + _NEARER_BY <= better)
    valid &= (jnp.abs(zones) <= _REACH).all((0, 2)) & (jnp.abs(core.goal) <= _REACH).all(-1)
    best = jnp.argmax(valid)
    return jax.tree.map(lambda x: x[best], core), valid.any()


def _draw_rest(key: Key[Array, ""], core: _Core) -> tuple[Float[Array, "..."], Bool[Array, ""]]:
    """The other zone of the second colour and those of the other two ``[5, 2]``, and whether all found a place."""
    core_zones = jnp.stack([core.goal, core.better, core.nearer])
    draws = jax.random.uniform(key, (_REST, _PLACES, 2), jnp.float32, minval=-_REACH, maxval=_REACH)

    def place(
        placed: Float[Array, "objects 2"], inputs: tuple[Array, Array]
    ) -> tuple[Float[Array, "objects 2"], tuple[Array, Array]]:
        index, candidates = inputs
        free = (index > 0) | _is_contested(core, candidates)
        for zones in (placed, core_zones):
            free &= (_distance(candidates[:, None], zones) >= 2 * ZONE_KEEPOUT).all(-1)
        for end in (core.goal, core.nearer):
            free &= _distance_to_way(candidates, core.robot, end) >= CLEARANCE
        found = candidates[jnp.argmax(free)]
        return jnp.where((np.arange(_REST) == index)[:, None], found, placed), (found, free.any())

    nothing = jnp.full((_REST, 2), _NOWHERE, jnp.float32)
    _, (rest, found) = jax.lax.scan(place, nothing, (jnp.arange(_REST, dtype=jnp.int32), draws))
    return rest, found.all()


def _is_contested(core: _Core, other_goal: Float[Array, "... 2"]) -> Bool[Array, "..."]:
    """Whether the better zone makes the whole way shorter; bool ``[...]`` for ``[..., 2]``."""

    def way(over: Float[Array, "... 2"]) -> Float[Array, "..."]:
        onward = jnp.minimum(_distance(over, core.goal), _distance(over, other_goal))
        return _distance(core.robot, over) + onward

    return way(core.better) + LEAST_DETOUR <= way(core.nearer)


def ways(
    layout: ZoneLayout, first: Int[Array, ""] | int, second: Int[Array, ""] | int
) -> tuple[Float[Array, " zones"], Float[Array, " zones"]]:
    """How far each zone of one colour is from the robot (m), and how long the way over it to another colour is (m).

    The latter is infinite where another zone of the first colour lies on the straight way to it.
    """
    robot, zones = layout.robot[:2], layout.zones[first]
    near = _distance(zones, robot)
    onward = _distance(zones[:, None], layout.zones[second]).min(-1)
    beside = jax.vmap(lambda end: _distance_to_way(zones, robot, end))(zones)
    over_another = ((beside < CLEARANCE) & ~jnp.eye(ZONES_EACH, dtype=bool)).any(-1)
    return near, jnp.where(over_another, jnp.inf, near + onward)


def _distance(left: Float[Array, "... 2"], right: Float[Array, "... 2"]) -> Float[Array, "..."]:
    # Not as a sum over the last axis: short reductions are slow on a CPU.
    dx, dy = left[..., 0] - right[..., 0], left[..., 1] - right[..., 1]
    return jnp.sqrt(dx * dx + dy * dy)


def _distance_to_way(
    points: Float[Array, "... 2"], start: Float[Array, "... 2"], end: Float[Array, "... 2"]
) -> Float[Array, "..."]:
    """Distance of points ``[..., 2]`` from a straight way."""
    along, offset = end - start, points - start
    projected = offset[..., 0] * along[0] + offset[..., 1] * along[1]
    share = jnp.clip(projected / (along[0] ** 2 + along[1] ** 2), 0.0, 1.0)
    return _distance(offset, share[..., None] * along)
