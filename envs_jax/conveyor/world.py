"""Conveyor: the same items in two corridors, but for the last one, and belts that let nobody back.

After Jaxolotl's ConveyorWorld and ConveyorWorldSimple. Until its last item a task does not tell the corridors apart:
who sees no farther than the next sub-task chooses the right one half of the time.

Axes: **X** columns, **Y** rows, from below; **S** = X · Y cells.
"""

from __future__ import annotations

import dataclasses
import functools
import string

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32, Key, Shaped

from envs_jax.arrays import Array
from envs_jax.base import Box, Discrete, Drawable, EnvParams, FiniteGraph, StepResult, at_most_one
from envs_jax.scenes import GridScene

RIGHT, DOWN, LEFT, UP = range(4)
"""Actions."""
_MOVES = ((1, 0), (0, -1), (-1, 0), (0, 1))
_AGAINST = {RIGHT: LEFT, DOWN: UP, LEFT: RIGHT, UP: DOWN}
_MOST_ITEMS = 32

Cell = tuple[int, int]


@struct.dataclass
class ConveyorLayout:
    """Where episodes begin; all else is the map's."""

    start: Int32[Array, "*lead 2"]


@struct.dataclass
class ConveyorState:
    """A running episode."""

    position: Int32[Array, "*lead 2"]
    layout: ConveyorLayout
    time: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class Map:
    """What lies where; cells are (x, y).

    Attributes:
        shape: X and Y.
        free: cells that may be entered.
        belts: the action that each belt flows with; the opposite one does nothing there.
        items: the proposition that holds in each cell with one.
        start: where episodes begin.
    """

    shape: tuple[int, int]
    free: frozenset[Cell]
    belts: dict[Cell, int]
    items: dict[Cell, str]
    start: Cell

    def after(self, cell: Cell, action: int) -> Cell:
        """Where an action leads: belts do not move anybody, and whoever bumps into something stays."""
        there = cell[0] + _MOVES[action][0], cell[1] + _MOVES[action][1]
        back = cell in self.belts and action == _AGAINST[self.belts[cell]]
        return there if there in self.free and not back else cell


def names(number: int) -> tuple[str, ...]:
    """``a`` to ``z``, then ``aa``, ``ab``, ..."""
    letters = string.ascii_lowercase
    return tuple([*letters, *(x + y for x in letters for y in letters)][:number])


def simple_map(k: int) -> Map:
    """One corridor upwards and one downwards: the first move decides. k - 1 items, then the last one, in each."""
    *items, below, above = names(k + 1)
    middle = k + 1
    column = [(1, y) for y in range(1, 2 * k + 2)]
    placed = {(1, middle + sign * i): item for i, item in enumerate(items, 1) for sign in (-1, 1)}
    return Map(
        shape=(3, 2 * k + 3),
        free=frozenset(column),
        belts={cell: UP if cell[1] > middle else DOWN for cell in column if cell[1] != middle},
        items={**placed, column[0]: below, column[-1]: above},
        start=(1, middle),
    )


def two_corridors(k: int) -> Map:
    """A room with two ways out, over belts; k - 1 items and the last one behind each. k + 9 steps suffice."""
    *items, below, above = names(k + 1)
    width, height, ends = 7 + k, 9, (1, 7)
    walls = {(x, y) for x in range(5) for y in (0, 8)} | {(x, y) for x in range(4, width) for y in (3, 4, 5)}
    walls |= {(3, y) for y in range(2, 7)} | {(x, y) for x in (3, 4, 5) for y in (2, 6)}
    placed = {(7 + i, y): item for i, item in enumerate(items) for y in ends}
    return Map(
        shape=(width, height),
        free=frozenset((x, y) for x in range(width) for y in range(height) if (x, y) not in walls),
        belts={(x, y): RIGHT for x in (3, 4, 5) for y in ends},
        items={**placed, (6 + k, ends[0]): below, (6 + k, ends[1]): above},
        start=(0, 4),
    )


@dataclasses.dataclass(frozen=True)
class Conveyor(FiniteGraph, Drawable):
    """A world of belts.

    Layout: :class:`ConveyorLayout`, always the same one. Observation: float32 ``[2]``, x and y. Actions: 0 right, 1
    down, 2 left, 3 up. Labels: the item in the agent's cell, if any. Reward: 0; never terminated.

    Attributes:
        k: items of a corridor, 1 to 32; there are k + 1 propositions, of which the last two end a corridor each.
        simple: one column (`simple_map`) or a room with two ways out (`two_corridors`).
        horizon: steps in an episode; 0 for 50, or in one column 4 k if that is more.
        name: the preset's name.

    Raises:
        ValueError: k is out of range.
    """

    k: int = 8
    simple: bool = False
    horizon: int = 0
    name: str = "conveyor"
    action_space = Discrete(n=4)
    observation_shape = (2,)

    def __post_init__(self) -> None:
        if not 1 <= self.k <= _MOST_ITEMS:
            raise ValueError(f"k is {self.k}, expected 1 to {_MOST_ITEMS}")
        if not self.horizon:
            object.__setattr__(self, "horizon", max(50, 4 * self.k * self.simple))

    @functools.cached_property
    def map(self) -> Map:
        """What lies where."""
        return (simple_map if self.simple else two_corridors)(self.k)

    @functools.cached_property
    def propositions(self) -> tuple[str, ...]:
        """As many letters as there are items, k + 1."""
        return names(self.k + 1)

    @property
    def possible_labels(self) -> tuple[frozenset[str], ...]:
        """A cell holds one item at most."""
        return at_most_one(self.propositions)

    @property
    def observation_space(self) -> Box:
        """Coordinates of cells."""
        return Box(low=0.0, high=float(max(self.map.shape) - 1), shape=(2,))

    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> ConveyorLayout:
        """The one there is."""
        del key, params
        return ConveyorLayout(jnp.array(self.map.start, jnp.int32))

    def resample_layout(
        self, key: Key[Array, ""], layout: ConveyorLayout, needed: Bool[Array, ""], params: EnvParams
    ) -> ConveyorLayout:
        """There is no other."""
        del key, needed, params
        return layout

    def check_layout(self, layout: ConveyorLayout) -> None:
        """Raises ``ValueError`` unless the start may be entered."""
        start = tuple(np.asarray(layout.start).tolist())
        if start not in self.map.free:
            raise ValueError(f"start {start} is a wall or outside")

    def reset_to(
        self, layout: ConveyorLayout, key: Key[Array, ""], params: EnvParams
    ) -> tuple[Float32[Array, "..."], ConveyorState]:
        """Starts where the layout says."""
        del key
        layout = jax.tree.map(jnp.asarray, layout)
        state = ConveyorState(layout.start, layout, jnp.int32(0))
        return self.observation(state, params), state

    def step_env(
        self, key: Key[Array, ""], state: ConveyorState, action: Int[Array, ""], params: EnvParams
    ) -> StepResult:
        """One move, or none."""
        del key
        there = jnp.asarray(self._tables[0])[self.graph_state(state), action]
        position = jnp.stack([there // self.map.shape[1], there % self.map.shape[1]])
        state = ConveyorState(position, state.layout, state.time + 1)
        over = state.time >= params.horizon
        return self.observation(state, params), state, jnp.float32(0), jnp.bool_(False), over, {}

    def labels(self, state: ConveyorState, params: EnvParams) -> Bool[Array, " P"]:
        """The item in the agent's cell."""
        del params
        return jnp.asarray(self._tables[1])[self.graph_state(state)]

    def observation(self, state: ConveyorState, params: EnvParams) -> Float32[Array, "..."]:
        """Coordinates x and y."""
        del params
        return state.position.astype(jnp.float32)

    def proposition_view(
        self, observation: Float32[Array, "..."]
    ) -> tuple[Float32[Array, "P ..."], Float32[Array, " F0"]]:
        """Nothing is seen of any proposition (float32 ``[P, 0]``); shared is the position, scaled to [-1, 1]."""
        most = np.array(self.map.shape, np.float32) - 1
        return jnp.zeros((self.num_propositions, 0), jnp.float32), 2 * observation / most - 1

    def transition_table(
        self, layout: ConveyorLayout, params: EnvParams
    ) -> tuple[Int32[Array, "S A"], Bool[Array, "S P"], Int32[Array, ""]]:
        """See :class:`FiniteGraph`; cell (x, y) is state ``x * Y + y``."""
        del params
        successors, labels = map(jnp.asarray, self._tables)
        start = jnp.asarray(layout.start)
        return successors, labels, start[0] * self.map.shape[1] + start[1]

    def graph_state(self, state: ConveyorState) -> Int32[Array, ""]:
        """The agent's cell as a state of :meth:`transition_table`, int32 ``[]``."""
        return state.position[0] * self.map.shape[1] + state.position[1]

    def scene(self, layout: ConveyorLayout) -> GridScene:
        """Items and walls; belts are not drawn."""
        del layout
        (width, height), plan = self.map.shape, self.map
        cells = tuple(tuple(plan.items.get((x, y), "") for x in range(width)) for y in reversed(range(height)))
        walls = ((height - 1 - y, x) for x in range(width) for y in range(height) if (x, y) not in plan.free)
        return GridScene(cells, tuple(walls))

    def position(self, state: ConveyorState) -> Shaped[Array, " _"]:
        """Row, from above, and column, int32 ``[2]``."""
        return jnp.stack([self.map.shape[1] - 1 - state.position[1], state.position[0]])

    @functools.cached_property
    def _tables(self) -> tuple[Int32[np.ndarray, "S A"], Bool[np.ndarray, "S P"]]:
        """The cell that each action leads to from each cell, and the items in them."""
        width, height = self.map.shape
        cells = [(x, y) for x in range(width) for y in range(height)]
        after = [[self.map.after(cell, action) for action in range(len(_MOVES))] for cell in cells]
        successors = np.array([[x * height + y for x, y in row] for row in after], np.int32)
        labels = [[self.map.items.get(cell) == name for name in self.propositions] for cell in cells]
        return successors, np.array(labels)
