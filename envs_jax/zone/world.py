"""Zone: Safety Gym's Point robot among coloured zones, on MuJoCo MJX.

Axes: **P** = 4 colours (the propositions), **Z** = 2 zones of each, **L** = 16 lidar bins.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int32, Key, Shaped

from envs_jax.arrays import Array
from envs_jax.base import (
    Box,
    EnvParams,
    Rearrangeable,
    Reflections,
    StepResult,
    Symmetric,
    Thing,
    at_most_one,
)
from envs_jax.scenes import DiscScene, Region
from envs_jax.zone import physics as zone_physics
from envs_jax.zone.contested import Contests
from envs_jax.zone.layouts import COLOURS, ZoneLayout, new_layout, no_layout, rearranged, things_in
from envs_jax.zone.physics import NUM_SENSORS, Backend, import_mjx

LIDAR_BINS = 16
BOUNDARY = 3.3
"""Where the episode ends, if nothing stops the robot before (m)."""
MOST_READING = 400.0
"""Bound of any sensor reading; accelerations of a robot that hits a solid wall are the largest."""
SENSOR_SCALE = np.repeat(np.array([0.1, 1.0, 0.3, 2.0], np.float32), 3)
"""Brings accelerometer, velocimeter, gyro and magnetometer to about one; gravity is constantly among them."""


@struct.dataclass
class ZoneState:
    """A running episode.

    Attributes:
        body: float32 ``[6]``: x, y (m), heading (rad, not wrapped), their velocities.
        sensors: float32 ``[12]``, the robot's last readings.
        vanished: bool ``[P]``, colours that are gone for the rest of the episode.
        layout: where it takes place.
        time: int32 ``[]``, steps taken.
    """

    body: Float32[Array, "*lead 6"]
    sensors: Float32[Array, "*lead 12"]
    vanished: Bool[Array, "*lead P"]
    layout: ZoneLayout
    time: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class Zone(Symmetric, Contests, Rearrangeable):
    """The Zone world.

    Layout: a `ZoneLayout`, the robot's pose and two zones of each colour. Observation: float32 ``[80]``:
    accelerometer (m/s²), velocimeter (m/s), gyro (rad/s) and magnetometer, three each in the robot's frame; a lidar of
    16 bins for each colour, ``exp(-gain · distance)`` in the bin a zone lies in and shares of it in its neighbours;
    ``exp`` of minus the distance (m) to each side of the square, in the order +x, -y, -x, +y (left out, so ``[76]``,
    where walls are solid). Action: float ``[2]`` in [-1, 1], forward force and turn rate, held for 20 ms. Labels: the
    colours of the zones the robot's origin is in. Reward: 0, or ``boundary_reward`` at the boundary. Terminated when
    the robot is 3.3 m or more from the middle along an axis, unless walls are solid; truncated after ``horizon`` steps.

    Attributes:
        radius: of the zones (m).
        gain: how fast the lidar fades (1/m).
        walls: solid walls at ±2.4 m instead of a boundary that ends the episode.
        vanishing: pairs of colours (first, second): once the robot has touched the first, the second is gone from lidar
            and labels until the episode ends.
        physics: ``"mjx"``, or ``"closed-form"`` for the same equations solved by hand (no walls).
        boundary_reward: for leaving the square.
        horizon: steps in an episode.
        name: the preset's name.

    Raises:
        ValueError: if a value is out of range, or the physics has no walls.
    """

    radius: float = 0.4
    gain: float = 0.5
    walls: bool = False
    vanishing: tuple[tuple[str, str], ...] = ()
    physics: Backend = "mjx"
    boundary_reward: float = 0.0
    horizon: int = 1000
    name: str = "zone"

    def __post_init__(self) -> None:
        for field in ("radius", "gain"):
            if not 0 < getattr(self, field) < np.inf:
                raise ValueError(f"Zone: {field} is {getattr(self, field)}, expected a positive number")
        if self.horizon < 1:
            raise ValueError(f"Zone: horizon is {self.horizon}, expected at least 1")
        unknown = [colour for pair in self.vanishing for colour in pair if colour not in COLOURS]
        if unknown or any(len(pair) != 2 for pair in self.vanishing):
            raise ValueError(f"Zone: vanishing is {self.vanishing}, expected pairs of colours of {', '.join(COLOURS)}")
        zone_physics.check_backend(self.physics, walls=self.walls)

    @property
    def propositions(self) -> tuple[str, ...]:
        """``('blue', 'green', 'red', 'yellow')``."""
        return COLOURS

    @property
    def possible_labels(self) -> tuple[frozenset[str], ...]:
        """Zones that are drawn lie apart."""
        return at_most_one(self.propositions)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """``(80,)``, or ``(76,)`` between solid walls."""
        return (NUM_SENSORS + len(COLOURS) * LIDAR_BINS + (0 if self.walls else 4),)

    @property
    def observation_space(self) -> Box:
        """Readings; lidar and wall sensor are within [0, 1]."""
        return Box(low=-MOST_READING, high=MOST_READING, shape=self.observation_shape)

    @property
    def action_space(self) -> Box:
        """Forward force and turn."""
        return Box(low=-1.0, high=1.0, shape=(2,))

    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> ZoneLayout:
        """A random layout: robot and zones apart, see `envs_jax.zone.layouts.new_layout`."""
        return self.resample_layout(key, no_layout(), jnp.bool_(True), params)

    def resample_layout(
        self, key: Key[Array, ""], layout: ZoneLayout, needed: Bool[Array, ""], params: EnvParams
    ) -> ZoneLayout:
        """A random layout other than ``layout`` where ``needed``, else ``layout``."""
        del params
        return new_layout(key, layout, needed)

    @functools.cached_property
    def symmetries(self) -> Reflections:
        """Left for right, and front for back: the robot drives both ways.

        The second is not exact: the robot's centre of mass lies 2 cm before its origin.
        """
        bins = np.arange(LIDAR_BINS)
        # Signs of three readings each of accelerometer, velocimeter, gyro and magnetometer (the field is along y).
        side = [1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, 1]
        back = [-1, -1, 1] * 4
        rest = 0 if self.walls else 4
        features, shared, signs, actions = [], [], [], []
        for to_back, to_side in itertools.product((False, True), repeat=2):
            order = LIDAR_BINS - 1 - bins if to_side else bins
            features.append(np.roll(order, LIDAR_BINS // 2 * to_back))
            walls = np.array([0, 3, 2, 1] if to_side else [0, 1, 2, 3])[:rest]
            shared.append(np.concatenate([np.arange(NUM_SENSORS), NUM_SENSORS + walls]))
            sign = np.where(to_side, side, 1) * np.where(to_back, back, 1)
            signs.append(np.concatenate([sign, np.ones(rest)]))
            actions.append([1 - 2 * to_back, 1 - 2 * to_side])
        bearing = (bins + 0.5) * (2 * np.pi / LIDAR_BINS)
        return Reflections(
            features=_tuples(features),
            shared=_tuples(shared),
            signs=_tuples(signs),
            actions=_tuples(actions),
            sector=tuple((np.cos(bearing) + 0.3 * np.sin(bearing)).tolist()),
            # Whichever way it drives is forward; where that changed with the bearing alone, it could dither for ever.
            heading=tuple(4.0 * (i == 3) for i in range(NUM_SENSORS + rest)),
        )

    def instance_at(self, state: ZoneState, goal: Bool[Array, " P"]) -> Int32[Array, ""]:
        """Which zone of a colour (``goal``, one-hot bool ``[P]``) the robot is nearest to, int32 ``[]``."""
        zones = state.layout.zones[jnp.argmax(goal)]
        dx, dy = zones[:, 0] - state.body[0], zones[:, 1] - state.body[1]
        return jnp.argmin(dx * dx + dy * dy).astype(jnp.int32)

    def check_installed(self) -> None:
        """Raises ``ImportError`` without MuJoCo, unless the physics is that in closed form."""
        if self.physics == "mjx":
            import_mjx()

    def check_layout(self, layout: ZoneLayout) -> None:
        """Raises ``ValueError`` unless everything is finite and lies inside the square.

        Distances are not asked of given layouts: a hand-made one may break the rules of placement on purpose.
        """
        if not (np.isfinite(layout.robot).all() and np.isfinite(layout.zones).all()):
            raise ValueError("a coordinate is not finite")
        limit = zone_physics.WALL - zone_physics.SPHERE if self.walls else BOUNDARY
        if (np.abs(layout.robot[:2]) >= limit).any():
            raise ValueError(f"the robot starts at {tuple(layout.robot[:2])}, expected within ±{limit:.3g}")
        if (np.abs(layout.zones) > BOUNDARY).any():
            raise ValueError(f"a zone lies outside the square ±{BOUNDARY}")

    def reset_to(
        self, layout: ZoneLayout, key: Key[Array, ""], params: EnvParams
    ) -> tuple[Float32[Array, "..."], ZoneState]:
        """Starts at rest in a given layout."""
        del key
        layout = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layout)
        state = ZoneState(
            body=jnp.concatenate([layout.robot, jnp.zeros(3, layout.robot.dtype)]),
            sensors=zone_physics.at_rest(layout.robot[2]),
            vanished=jnp.zeros(len(COLOURS), bool),
            layout=layout,
            time=jnp.int32(0),
        )
        return self.observation(state, params), state

    def step_env(
        self, key: Key[Array, ""], state: ZoneState, action: Float[Array, " A"], params: EnvParams
    ) -> StepResult:
        """20 ms of physics; see :meth:`Environment.step_env`. Actions are clipped to [-1, 1]."""
        del key
        control = jnp.clip(jnp.asarray(action, state.body.dtype), -1.0, 1.0)
        body, sensors = self._physics_step(state.body, control)
        state = ZoneState(
            body=body,
            sensors=sensors,
            vanished=self._vanished(state.vanished, self._touched(body, state.layout.zones)),
            layout=state.layout,
            time=state.time + 1,
        )
        outside = jnp.maximum(jnp.abs(body[0]), jnp.abs(body[1])) >= BOUNDARY
        terminated = jnp.bool_(False) if self.walls else outside
        reward = jnp.where(terminated, jnp.float32(self.boundary_reward), jnp.float32(0.0))
        truncated = state.time >= params.horizon
        return self.observation(state, params), state, reward, terminated, truncated, {}

    def labels(self, state: ZoneState, params: EnvParams) -> Bool[Array, " P"]:
        """The colours of the zones the robot's origin is in, bool ``[P]``."""
        del params
        return self._touched(state.body, state.layout.zones) & ~state.vanished

    def observation(self, state: ZoneState, params: EnvParams) -> Float32[Array, "..."]:
        """Sensors, lidar and, without solid walls, the wall sensor: float32 ``[80]`` or ``[76]``."""
        del params
        lidar = jnp.where(state.vanished[:, None], 0.0, lidar_readings(state.body, state.layout.zones, self.gain))
        parts = [state.sensors, lidar.reshape(-1)]
        if not self.walls:
            sides = np.array([BOUNDARY, -BOUNDARY, -BOUNDARY, BOUNDARY], np.float32)
            parts.append(jnp.exp(-jnp.abs(state.body[np.array([0, 1, 0, 1])] - sides)))
        return jnp.concatenate(parts)

    def proposition_view(self, observation: Float[Array, "..."]) -> tuple[Float[Array, "P ..."], Float[Array, " F0"]]:
        """Each colour's lidar, float ``[P, L]``, and the other readings scaled to about one, ``[16]`` or ``[12]``."""
        end = NUM_SENSORS + len(COLOURS) * LIDAR_BINS
        lidar = observation[NUM_SENSORS:end].reshape(len(COLOURS), LIDAR_BINS)
        return lidar, jnp.concatenate([observation[:NUM_SENSORS] * SENSOR_SCALE, observation[end:]])

    def scene(self, layout: ZoneLayout) -> DiscScene:
        """The zones in the square."""
        regions = [
            Region(name, float(centre[0]), float(centre[1]), self.radius)
            for name, some in zip(COLOURS, np.asarray(layout.zones), strict=True)
            for centre in some
        ]
        return DiscScene(tuple(regions), -BOUNDARY, BOUNDARY)

    def position(self, state: ZoneState) -> Shaped[Array, " _"]:
        """The robot, float ``[3]``: x, y (m) and heading (rad)."""
        return state.body[:3]

    def things(self, layout: ZoneLayout) -> tuple[Thing, ...]:
        """Zones and robot."""
        return things_in(layout, COLOURS)

    def rearranged(self, layout: ZoneLayout, places: Float[np.ndarray, "_ 2"]) -> ZoneLayout:
        """See :meth:`Rearrangeable.rearranged`; zones do not overlap, and the robot keeps its heading."""
        moved = rearranged(layout, places, self.radius)
        self.check_layout(moved)
        return moved

    @property
    def _physics_step(self) -> zone_physics.Step:
        return zone_physics.step_function(self.physics, walls=self.walls)

    def _touched(self, body: Float[Array, " 6"], zones: Float[Array, "P Z 2"]) -> Bool[Array, " P"]:
        """Whether the robot's origin lies in a zone of each colour, bool ``[P]``."""
        dx, dy = zones[..., 0] - body[0], zones[..., 1] - body[1]
        return (jnp.sqrt(dx * dx + dy * dy) <= self.radius).any(-1)

    def _vanished(self, vanished: Bool[Array, " P"], touched: Bool[Array, " P"]) -> Bool[Array, " P"]:
        """Colours gone after the robot has touched these, bool ``[P]``."""
        touched = touched & ~vanished
        for first, second in self.vanishing:
            gone = np.arange(len(COLOURS)) == COLOURS.index(second)
            vanished = vanished | (touched[COLOURS.index(first)] & gone)
        return vanished


def lidar_readings(
    body: Float[Array, " _"], zones: Float[Array, "P Z 2"], gain: float | Float[Array, ""]
) -> Float[Array, "..."]:
    """What the lidar of each colour sees, float ``[P, L]``.

    A zone at distance d fills the bin its bearing lies in with ``exp(-gain · d)``, the next one with the share of the
    bin that lies before the bearing, and the one before with the rest; a bin keeps the largest of its colour.
    """
    dx, dy = zones[..., 0] - body[0], zones[..., 1] - body[1]
    cos, sin = jnp.cos(body[2]), jnp.sin(body[2])
    bearing = jnp.arctan2(cos * dy - sin * dx, cos * dx + sin * dy)
    place = jnp.where(bearing < 0, bearing + 2 * jnp.pi, bearing) * (LIDAR_BINS / (2 * jnp.pi))
    # Rounding can take a bearing just below a whole turn to the turn itself.
    bin_index = jnp.minimum(jnp.floor(place), LIDAR_BINS - 1)[..., None]
    value = jnp.exp(-gain * jnp.sqrt(dx * dx + dy * dy))[..., None]
    before, after = value * (1 - (place[..., None] - bin_index)), value * (place[..., None] - bin_index)
    bins = np.arange(LIDAR_BINS)
    near = jnp.where(bin_index == (bins + 1) % LIDAR_BINS, before, jnp.where(bin_index == bins, value, 0.0))
    return jnp.where(bin_index == (bins - 1) % LIDAR_BINS, after, near).max(-2)


def _tuples(rows: Any) -> tuple[tuple[Any, ...], ...]:
    return tuple(tuple(row) for row in np.array(rows).tolist())


PRESETS = {
    "zone": functools.partial(Zone, name="zone"),
    "zone-ltl2action": functools.partial(Zone, name="zone-ltl2action", radius=0.25, gain=1.0, walls=True),
    # StructLTL's ZoneEnvNM, whose purple is our blue: touching it makes green vanish, no other colour has an effect.
    "zone-nm": functools.partial(Zone, name="zone-nm", vanishing=(("blue", "green"),)),
}
"""Constructors of the presets, by name."""
