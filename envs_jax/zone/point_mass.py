"""Zone with a point mass, as Jaxolotl and StructLTL have it: their physics, layouts and observation, for comparisons.

The robot knows neither where it is nor which way it faces, and sees its velocity along the axes of the square.

Axes: **P** = 4 colours (the propositions), **Z** = 2 zones of each, **L** = 16 lidar bins.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int32, Key, Shaped

from envs_jax.arrays import Array
from envs_jax.base import Box, EnvParams, Rearrangeable, StepResult, Thing, at_most_one
from envs_jax.scenes import DiscScene, Region
from envs_jax.zone.contested import Contests
from envs_jax.zone.layouts import NUM_ZONES, ZONES_EACH, ZoneLayout, no_layout, rearranged, things_in
from envs_jax.zone.world import LIDAR_BINS, lidar_readings

COLOURS = ("red", "green", "purple", "yellow")
RADIUS = 0.4
"""Of the zones (m); the robot is inside where it is nearer."""
BOUNDARY = 3.3
"""Beyond it along an axis the episode ends (m)."""
SPAWN = 1.95
"""Centres of zones and the robot's start lie within this of the middle along each axis (m)."""
APART = 1.1
"""Least distance between any two of them (m)."""
MOST_DRAWS = 1000
"""Draws for all zones, and for the robot."""
STEP, DRAG = 0.05, 0.08
"""Seconds of a step; the share of the velocity that it takes away."""
MOST_FORCE, MOST_TURN, MOST_SPEED = 2.0, 3.0, 3.0
"""Bounds of force (N, on 1 kg), turn rate (rad/s) and speed (m/s)."""
GAIN = 0.5
"""How fast the lidar fades (1/m)."""
FALLBACK = (
    ((-1.60, -0.54), (0.82, 0.10)),
    ((-0.18, -1.12), (-1.91, 1.68)),
    ((1.58, 1.23), (1.82, -1.71)),
    ((-0.70, 0.58), (-0.49, 1.83)),
)
"""The zones where all draws were in vain."""
NUM_SHARED = 5
SHARED_SCALE = np.array([0.5, 0.5, 1.0, 1.0, 0.3], np.float32)
"""Brings acceleration, velocity and turn rate to about one."""

_BLOCK = 20
"""Draws made at once; those after the first that finds a place are not counted."""
_NOWHERE = 1e6
"""Coordinates of what is not placed yet: far from everything."""


@struct.dataclass
class PointMassState:
    """A running episode.

    Attributes:
        position: float32 ``[2]``, x and y (m).
        heading: float32 ``[]`` (rad), in [-π, π).
        velocity: float32 ``[2]``, along x and y (m/s).
        acceleration: float32 ``[2]``, of the last step, along x and y (m/s²).
        turn_rate: float32 ``[]``, of the last step (rad/s).
        vanished: bool ``[P]``, colours that are gone for the rest of the episode.
        layout: where it takes place.
        time: int32 ``[]``, steps taken.
    """

    position: Float32[Array, "*lead 2"]
    heading: Float32[Array, "*lead"]
    velocity: Float32[Array, "*lead 2"]
    acceleration: Float32[Array, "*lead 2"]
    turn_rate: Float32[Array, "*lead"]
    vanished: Bool[Array, "*lead P"]
    layout: ZoneLayout
    time: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class PointMass(Contests, Rearrangeable):
    """Zone with a point mass.

    Layout: a `ZoneLayout`. Observation: float32 ``[69]``: acceleration and velocity along x and y, turn rate, and a
    lidar of 16 bins for each colour as in `envs_jax.zone.world.Zone`. Action: float ``[2]`` in [-1, 1], forward force
    and turn rate, held for 50 ms. Labels: the colours of the zones that the robot is in. Reward: 0. Terminated when the
    robot is farther than 3.3 m from the middle along an axis; truncated after ``horizon`` steps.

    Attributes:
        vanishing: pairs of colours (first, second): once the robot has been in the first, the second is gone from lidar
            and labels until the episode ends.
        horizon: steps in an episode.
        name: the preset's name.

    Raises:
        ValueError: if a value is out of range.
    """

    vanishing: tuple[tuple[str, str], ...] = ()
    horizon: int = 1000
    name: str = "zone-jaxolotl"

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ValueError(f"PointMass: horizon is {self.horizon}, expected at least 1")
        unknown = [colour for pair in self.vanishing for colour in pair if colour not in COLOURS]
        if unknown or any(len(pair) != 2 for pair in self.vanishing):
            raise ValueError(f"PointMass: vanishing is {self.vanishing}, expected pairs of {', '.join(COLOURS)}")

    @property
    def propositions(self) -> tuple[str, ...]:
        """``('red', 'green', 'purple', 'yellow')``."""
        return COLOURS

    @property
    def possible_labels(self) -> tuple[frozenset[str], ...]:
        """Zones that are drawn lie apart."""
        return at_most_one(COLOURS)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """``(69,)``."""
        return (NUM_SHARED + len(COLOURS) * LIDAR_BINS,)

    @property
    def observation_space(self) -> Box:
        """Bounds of all readings; the speed is the largest."""
        return Box(low=-MOST_SPEED, high=MOST_SPEED, shape=self.observation_shape)

    @property
    def action_space(self) -> Box:
        """Forward force and turn rate, as shares of the most."""
        return Box(low=-1.0, high=1.0, shape=(2,))

    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> ZoneLayout:
        """A random layout."""
        return self.resample_layout(key, no_layout(), jnp.bool_(True), params)

    def resample_layout(
        self, key: Key[Array, ""], layout: ZoneLayout, needed: Bool[Array, ""], params: EnvParams
    ) -> ZoneLayout:
        """A random layout other than ``layout`` where ``needed``, else ``layout``."""
        del params
        fresh = _new_layout(key, layout.robot[:2], needed)
        return jax.tree.map(lambda new, old: jnp.where(needed, new, old.astype(jnp.float32)), fresh, layout)

    def instance_at(self, state: PointMassState, goal: Bool[Array, " P"]) -> Int32[Array, ""]:
        """Which zone of a colour (``goal``, one-hot bool ``[P]``) the robot is nearest to, int32 ``[]``."""
        offset = state.layout.zones[jnp.argmax(goal)] - state.position
        return jnp.argmin((offset**2).sum(-1)).astype(jnp.int32)

    def check_layout(self, layout: ZoneLayout) -> None:
        """Raises ``ValueError`` unless everything is finite and lies inside the square."""
        if not (np.isfinite(layout.robot).all() and np.isfinite(layout.zones).all()):
            raise ValueError("a coordinate is not finite")
        if (np.abs(layout.robot[:2]) > BOUNDARY).any():
            raise ValueError(f"the robot starts at {tuple(layout.robot[:2])}, expected within ±{BOUNDARY}")
        if (np.abs(layout.zones) > BOUNDARY).any():
            raise ValueError(f"a zone lies outside the square ±{BOUNDARY}")

    def reset_to(
        self, layout: ZoneLayout, key: Key[Array, ""], params: EnvParams
    ) -> tuple[Float32[Array, "..."], PointMassState]:
        """Starts at rest in a given layout."""
        del key
        layout = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layout)
        still = jnp.zeros(2, jnp.float32)
        state = PointMassState(
            position=layout.robot[:2],
            heading=layout.robot[2],
            velocity=still,
            acceleration=still,
            turn_rate=jnp.float32(0.0),
            vanished=jnp.zeros(len(COLOURS), bool),
            layout=layout,
            time=jnp.int32(0),
        )
        return self.observation(state, params), state

    def step_env(
        self, key: Key[Array, ""], state: PointMassState, action: Float[Array, " A"], params: EnvParams
    ) -> StepResult:
        """50 ms; see :meth:`Environment.step_env`. The force acts along the heading before the turn."""
        del key
        most = np.array([MOST_FORCE, MOST_TURN], np.float32)
        force, turn = most * jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        acceleration = force * jnp.stack([jnp.cos(state.heading), jnp.sin(state.heading)])
        velocity = (state.velocity + acceleration * STEP) * (1.0 - DRAG)
        velocity *= jnp.minimum(1.0, MOST_SPEED / jnp.maximum(jnp.sqrt((velocity**2).sum()), 1e-6))
        position = state.position + velocity * STEP
        touched = _touched(position, state.layout.zones) & ~state.vanished
        state = PointMassState(
            position=position,
            heading=(state.heading + turn * STEP + jnp.pi) % (2 * jnp.pi) - jnp.pi,
            velocity=velocity,
            acceleration=acceleration,
            turn_rate=turn,
            vanished=state.vanished | self._gone(touched),
            layout=state.layout,
            time=state.time + 1,
        )
        outside = (jnp.abs(position) > BOUNDARY).any()
        return self.observation(state, params), state, jnp.float32(0.0), outside, state.time >= params.horizon, {}

    def labels(self, state: PointMassState, params: EnvParams) -> Bool[Array, " P"]:
        """The colours of the zones that the robot is in, bool ``[P]``."""
        del params
        return _touched(state.position, state.layout.zones) & ~state.vanished

    def observation(self, state: PointMassState, params: EnvParams) -> Float32[Array, "..."]:
        """Acceleration, velocity, turn rate and lidar, float32 ``[69]``."""
        del params
        pose = jnp.concatenate([state.position, state.heading[None]])
        lidar = jnp.where(state.vanished[:, None], 0.0, lidar_readings(pose, state.layout.zones, GAIN))
        return jnp.concatenate([state.acceleration, state.velocity, state.turn_rate[None], lidar.reshape(-1)])

    def proposition_view(self, observation: Float[Array, "..."]) -> tuple[Float[Array, "P ..."], Float[Array, " F0"]]:
        """Each colour's lidar, float ``[P, L]``, and the other readings scaled to about one, ``[5]``."""
        lidar = observation[NUM_SHARED:].reshape(len(COLOURS), LIDAR_BINS)
        return lidar, observation[:NUM_SHARED] * SHARED_SCALE

    def scene(self, layout: ZoneLayout) -> DiscScene:
        """The zones in the square."""
        regions = [
            Region(name, float(centre[0]), float(centre[1]), RADIUS)
            for name, some in zip(COLOURS, np.asarray(layout.zones), strict=True)
            for centre in some
        ]
        return DiscScene(tuple(regions), -BOUNDARY, BOUNDARY)

    def position(self, state: PointMassState) -> Shaped[Array, " _"]:
        """The robot, float ``[3]``: x, y (m) and heading (rad)."""
        return jnp.concatenate([state.position, state.heading[..., None]], -1)

    def things(self, layout: ZoneLayout) -> tuple[Thing, ...]:
        """Zones and robot."""
        return things_in(layout, COLOURS)

    def rearranged(self, layout: ZoneLayout, places: Float[np.ndarray, "_ 2"]) -> ZoneLayout:
        """See :meth:`Rearrangeable.rearranged`; zones do not overlap, and the robot keeps its heading."""
        moved = rearranged(layout, places, RADIUS)
        self.check_layout(moved)
        return moved

    def _gone(self, touched: Bool[Array, " P"]) -> Bool[Array, " P"]:
        """Colours that are gone after these were touched."""
        gone = jnp.zeros(len(COLOURS), bool)
        for first, second in self.vanishing:
            gone = gone.at[COLOURS.index(second)].set(gone[COLOURS.index(second)] | touched[COLOURS.index(first)])
        return gone


def _touched(position: Float[Array, " 2"], zones: Float[Array, "P Z 2"]) -> Bool[Array, " P"]:
    """Whether a place lies in a zone of each colour, bool ``[P]``."""
    offset = zones - position
    return (jnp.sqrt((offset**2).sum(-1)) < RADIUS).any(-1)


class _Draw(NamedTuple):
    """Objects in the making: zones in the order of colours, then the robot."""

    key: Key[Array, ""]
    placed: Float32[Array, "_ 2"]
    number: Int32[Array, ""]  # of objects placed
    draws: Int32[Array, ""]  # draws made for the zones, or for the robot


def _new_layout(key: Key[Array, ""], before: Float[Array, " 2"], needed: Bool[Array, ""]) -> ZoneLayout:
    """A random layout; where it is not needed, what is returned means nothing. The key is consumed.

    Each zone is at the first of the uniform draws that keeps its distance from those before it; after `MOST_DRAWS` in
    all they lie as in `FALLBACK`. Then the robot likewise, but not where it was ``before``; after as many draws it is
    where the last one was.
    """
    heading_key, key = jax.random.split(key)
    order = np.arange(NUM_ZONES + 1)
    fallback = jnp.array(np.concatenate([np.reshape(FALLBACK, (-1, 2)), [[_NOWHERE] * 2]]), jnp.float32)

    def attempt(draw: _Draw) -> _Draw:
        key, draw_key = jax.random.split(draw.key)
        candidates = SPAWN * jax.random.uniform(draw_key, (_BLOCK, 2), jnp.float32, -1.0, 1.0)
        dx, dy = (candidates[:, None, axis] - draw.placed[:, axis] for axis in (0, 1))
        in_time = draw.draws + np.arange(_BLOCK) < MOST_DRAWS
        free = (dx * dx + dy * dy >= APART**2).all(-1) & in_time
        is_robot = draw.number == NUM_ZONES
        free &= ~(is_robot & (candidates == before).all(-1))
        found = free.any()
        draws = draw.draws + jnp.where(found, jnp.argmax(free) + 1, _BLOCK)
        over = ~found & (draws >= MOST_DRAWS)
        place = candidates[jnp.where(found, jnp.argmax(free), _BLOCK - 1)]
        placed = jnp.where(((order == draw.number) & (found | (over & is_robot)))[:, None], place, draw.placed)
        count = draw.number + (found | (over & is_robot))
        # The zones are complete, or given up: the robot has draws of its own.
        gave_up = over & ~is_robot
        placed, count = jnp.where(gave_up, fallback, placed), jnp.where(gave_up, NUM_ZONES, count)
        draws = jnp.where(~is_robot & (count == NUM_ZONES), 0, draws)
        return _Draw(key, placed, count.astype(jnp.int32), draws.astype(jnp.int32))

    nothing = jnp.full((NUM_ZONES + 1, 2), _NOWHERE, jnp.float32)
    begun = _Draw(key, nothing, jnp.where(needed, 0, NUM_ZONES + 1).astype(jnp.int32), jnp.int32(0))
    done = jax.lax.while_loop(lambda draw: draw.number <= NUM_ZONES, attempt, begun)
    heading = jax.random.uniform(heading_key, (1,), jnp.float32, -jnp.pi, jnp.pi)
    zones = done.placed[:NUM_ZONES].reshape(len(COLOURS), ZONES_EACH, 2)
    return ZoneLayout(robot=jnp.concatenate([done.placed[NUM_ZONES], heading]), zones=zones)


PRESETS = {
    "zone-jaxolotl": functools.partial(PointMass, name="zone-jaxolotl"),
    "zone-nm-jaxolotl": functools.partial(PointMass, name="zone-nm-jaxolotl", vanishing=(("purple", "green"),)),
}
"""Constructors of the presets, by name."""
