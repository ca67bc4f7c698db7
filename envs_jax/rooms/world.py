"""Rooms: three in a row, a locked door, and a key that no task speaks of; the paper's motivating example.

Axes: **H** rows, **W** columns.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32, Key, Shaped

from envs_jax.arrays import Array
from envs_jax.base import Box, Discrete, Drawable, EnvParams, StepResult, at_most_one
from envs_jax.scenes import GridScene

ROOM = 3
"""Cells along each side of a room."""
ROWS, COLUMNS = ROOM, 3 * ROOM + 2
DOORS = (ROOM, 2 * ROOM + 1)
"""Columns of the two walls, each with a door in the middle; the second is locked."""
MIDDLE = ROOM // 2
_MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)], np.int32)


@struct.dataclass
class RoomsLayout:
    """Cells, row and column: the start and the key in the first room, a red ball in the second, a blue in the third."""

    start: Int32[Array, "*lead 2"]
    key: Int32[Array, "*lead 2"]
    red: Int32[Array, "*lead 2"]
    blue: Int32[Array, "*lead 2"]


@struct.dataclass
class RoomsState:
    """A running episode."""

    position: Int32[Array, "*lead 2"]
    has_key: Bool[Array, "*lead"]
    layout: RoomsLayout
    time: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class Rooms(Drawable):
    """Three rooms in a row; the door to the last is locked, and the key, which no task speaks of, lies in the first.

    Observation: float32 ``[4, H, W]``: red ball, blue ball, agent, key (gone when it was taken). Actions: 0 up, 1 down,
    2 left, 3 right; walls and the locked door let nobody through. Labels: in which ball's cell the agent is.
    """

    horizon: int = 150
    name: str = "rooms"
    propositions = ("blue", "red")
    action_space = Discrete(n=4)
    observation_shape = (4, ROWS, COLUMNS)
    observation_space = Box(low=0.0, high=1.0, shape=(4, ROWS, COLUMNS))

    @property
    def possible_labels(self) -> tuple[frozenset[str], ...]:
        """The balls lie in different cells."""
        return at_most_one(self.propositions)

    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> RoomsLayout:
        """Uniform cells in their rooms; the key at the far wall, on no direct way from the start to the door."""
        del params
        rows = jax.random.randint(key, (4,), 0, ROOM, jnp.int32)
        columns = jax.random.randint(jax.random.fold_in(key, 1), (4,), jnp.array([1, 0, 0, 0]), ROOM, jnp.int32)
        columns = columns.at[1].set(0) + (ROOM + 1) * np.array([0, 0, 1, 2])
        return RoomsLayout(*jnp.stack([rows, columns], -1).astype(jnp.int32))

    def resample_layout(
        self, key: Key[Array, ""], layout: RoomsLayout, needed: Bool[Array, ""], params: EnvParams
    ) -> RoomsLayout:
        """Another layout where ``needed``; the start moves on by a cell if all were drawn alike."""
        drawn = self.sample_layout(key, params)
        same = jnp.stack([(x == y).all() for x, y in zip(jax.tree.leaves(drawn), jax.tree.leaves(layout), strict=True)])
        start = jnp.where(same.all(), drawn.start.at[0].set((drawn.start[0] + 1) % ROWS), drawn.start)
        return jax.tree.map(
            lambda new, old: jnp.where(needed, new, old), dataclasses.replace(drawn, start=start), layout
        )

    def check_layout(self, layout: RoomsLayout) -> None:
        """Raises ``ValueError`` unless everything lies in its room."""
        for name, room in (("start", 0), ("key", 0), ("red", 1), ("blue", 2)):
            row, column = np.asarray(getattr(layout, name)) - (0, room * (ROOM + 1))
            if not (0 <= row < ROOM and 0 <= column < ROOM):
                raise ValueError(f"{name} is not in room {room + 1}")

    def reset_to(
        self, layout: RoomsLayout, key: Key[Array, ""], params: EnvParams
    ) -> tuple[Float32[Array, "..."], RoomsState]:
        """Starts without the key."""
        del key
        layout = jax.tree.map(jnp.asarray, layout)
        state = RoomsState(layout.start, (layout.start == layout.key).all(), layout, jnp.int32(0))
        return self.observation(state, params), state

    def step_env(self, key: Key[Array, ""], state: RoomsState, action: Int[Array, ""], params: EnvParams) -> StepResult:
        """One move."""
        del key
        there = state.position + jnp.asarray(_MOVES)[action]
        row, column = there
        inside = (row >= 0) & (row < ROWS) & (column >= 0) & (column < COLUMNS)
        through = (row == MIDDLE) & ((column == DOORS[0]) | state.has_key)
        wall = (column == DOORS[0]) | (column == DOORS[1])
        position = jnp.where(inside & (~wall | through), there, state.position)
        has_key = state.has_key | (position == state.layout.key).all()
        state = RoomsState(position, has_key, state.layout, state.time + 1)
        return (
            self.observation(state, params),
            state,
            jnp.float32(0),
            jnp.bool_(False),
            state.time >= params.horizon,
            {},
        )

    def labels(self, state: RoomsState, params: EnvParams) -> Bool[Array, " P"]:
        """Which ball's cell the agent is in."""
        del params
        return jnp.stack([(state.position == ball).all() for ball in (state.layout.blue, state.layout.red)])

    def observation(self, state: RoomsState, params: EnvParams) -> Float32[Array, "..."]:
        """One image each for blue, red, the agent and the key."""
        del params
        layout = state.layout
        images = [_image(x) for x in (layout.blue, layout.red, state.position)]
        return jnp.stack([*images, _image(layout.key) * ~state.has_key]).astype(jnp.float32)

    def proposition_view(
        self, observation: Float32[Array, "..."]
    ) -> tuple[Float32[Array, "P ..."], Float32[Array, " F0"]]:
        """The balls belong to propositions, agent and key to none."""
        return observation[:2], observation[2:].reshape(-1)

    def scene(self, layout: RoomsLayout) -> GridScene:
        """Balls and key, walls, and the locked door, which is one of the cells."""
        cells = [[""] * COLUMNS for _ in range(ROWS)]
        cells[MIDDLE][DOORS[1]] = "door"
        for name in ("key", *self.propositions):
            row, column = np.asarray(getattr(layout, name)).tolist()
            cells[row][column] = name
        walls = tuple((row, column) for row in range(ROWS) for column in DOORS if row != MIDDLE)
        return GridScene(tuple(map(tuple, cells)), walls)

    def position(self, state: RoomsState) -> Shaped[Array, " _"]:
        """Row and column, int32 ``[2]``."""
        return state.position


def _image(cell: Int32[Array, " 2"]) -> Bool[Array, "H W"]:
    return (np.arange(ROWS)[:, None] == cell[0]) & (np.arange(COLUMNS) == cell[1])


def fewest_steps(layout: RoomsLayout, *, key_first: bool) -> int:
    """Steps to the red and then the blue ball, with the key fetched before the red ball or only afterwards."""
    between = (layout.key, layout.red) if key_first else (layout.red, layout.key)
    stops = [np.asarray(stop) for stop in (layout.start, *between, layout.blue)]
    return sum(_distance(here, there) for here, there in itertools.pairwise(stops))


def _distance(here: Int[np.ndarray, " 2"], there: Int[np.ndarray, " 2"]) -> int:
    """Steps through the doors between two cells."""
    if here[1] // (ROOM + 1) != there[1] // (ROOM + 1):
        rows = abs(here[0] - MIDDLE) + abs(there[0] - MIDDLE)
    else:
        rows = abs(here[0] - there[0])
    return int(rows + abs(here[1] - there[1]))
