"""Grids of cells: named ones, walls, an agent that moves from cell to cell. Axes: **H** rows, **W** columns."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from envs_jax.scenes.base import PATH_COLORS, Leg, Outline, Scene, Shape
from envs_jax.scenes.glyphs import BACKGROUND, INK, LINE, color_of, glyph, own_color

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SMALLEST_CELL = 10
_WALL = (120, 120, 124)


@dataclasses.dataclass(frozen=True)
class GridScene(Scene):
    """A grid from above; positions are rows and columns. A path may leave on one side and come back on the other.

    Attributes:
        cells: what lies in each cell, by row and column: a name, or an empty string.
        walls: row and column of cells that cannot be entered.
        cell_pixels: side of a cell in a frame, at least 10.

    Raises:
        ValueError: if rows differ in length, or cells are too small to draw.
    """

    cells: tuple[tuple[str, ...], ...]
    walls: tuple[tuple[int, int], ...] = ()
    cell_pixels: int = 48

    def __post_init__(self) -> None:
        if self.cell_pixels < _SMALLEST_CELL:
            raise ValueError(f"cell_pixels is {self.cell_pixels}, expected at least {_SMALLEST_CELL}")
        if not self.cells or len({len(row) for row in self.cells}) > 1:
            raise ValueError(f"rows of {[len(row) for row in self.cells]} cells, expected the same number in each")

    @property
    def shape(self) -> tuple[int, int]:
        """H and W."""
        return len(self.cells), len(self.cells[0])

    def draw(self, ax: Axes, positions: np.ndarray, legs: Sequence[Leg]) -> None:
        """See :class:`Scene`."""
        height, width = self.shape
        ax.imshow(self.frame(positions, 0, None), extent=(-0.5, width - 0.5, height - 0.5, -0.5))
        for number, leg in enumerate(legs):
            color, shift = PATH_COLORS[number % len(PATH_COLORS)], 0.06 * ((number + 1) % 5 - 2)
            for t in range(leg.first, leg.last + 1):
                label = leg.label if t == leg.first else None
                _draw_move(ax, positions[t], positions[t + 1], color, label, shift=shift)
            if leg.reached:
                row, column = positions[leg.last + 1]
                ax.plot(
                    column, row, "o", markersize=30, markerfacecolor="none", markeredgecolor=color, markeredgewidth=3
                )
                ax.annotate(str(number + 1), (column + 0.3, row - 0.3), color=color, weight="bold", fontsize=11)
        ax.set_axis_off()

    def frame(self, positions: np.ndarray, now: int, leg: Leg | None) -> np.ndarray:
        """See :class:`Scene`: the agent as a ring, dots in the corners of the cells where it has been.

        Raises:
            ValueError: if the agent is outside.
        """
        del leg
        (height, width), side = self.shape, self.cell_pixels
        image = np.empty((height, width, side, side, 3), np.uint8)
        image[:] = BACKGROUND
        for cell in self.walls:
            image[cell] = _WALL
        for row, names in enumerate(self.cells):
            for column, name in enumerate(names):
                if name:
                    image[row, column] = color_of(name)
                    image[row, column][glyph(name, side)] = INK
        offset = (np.arange(side) - (side - 1) / 2) / side
        radius = np.hypot(offset[:, None], offset[None, :])
        corner = np.hypot(offset[:, None] - 0.32, offset[None, :] - 0.32)
        for visited in positions[:now]:
            image[self._inside(visited)][corner < 0.09] = INK
        image[self._inside(positions[now])][(radius < 0.42) & (radius > 0.30)] = INK
        image[:, :, 0, :] = LINE
        image[:, :, :, 0] = LINE
        return image.transpose(0, 2, 1, 3, 4).reshape(height * side, width * side, 3)

    def outline(self) -> Outline:
        """See :class:`Scene`; a cell is a unit."""
        height, width = self.shape
        named = (
            Shape("cell", name, column + 0.5, row + 0.5, 0.5, own_color(name))
            for row, names in enumerate(self.cells)
            for column, name in enumerate(names)
            if name
        )
        walls = (Shape("wall", "", column + 0.5, row + 0.5, 0.5, None) for row, column in self.walls)
        return Outline(float(width), float(height), (*named, *walls), 1.0)

    def in_outline(self, positions: np.ndarray) -> np.ndarray:
        """See :class:`Scene`."""
        return np.asarray(positions, float)[:, ::-1] + 0.5

    def from_outline(self, places: np.ndarray) -> np.ndarray:
        """See :class:`Scene`: rows and columns."""
        return np.floor(places)[:, ::-1]

    def _inside(self, position: np.ndarray) -> tuple[int, int]:
        """A position as row and column, or ``ValueError``."""
        where = np.asarray(position)
        if where.shape != (2,) or not ((where >= 0) & (where < self.shape)).all():
            height, width = self.shape
            raise ValueError(f"the agent is at {where.tolist()}, expected row and column of a grid of {height}×{width}")
        return int(where[0]), int(where[1])


def _draw_move(ax: Axes, here: np.ndarray, there: np.ndarray, color: str, label: str | None, shift: float) -> None:
    """One move; over the edge of a torus it leaves on one side and comes back on the other."""
    move = there - here
    style: dict[str, Any] = {"color": color, "linewidth": 2.5, "solid_capstyle": "round"}
    if np.abs(move).max() <= 1:
        ax.plot([here[1] + shift, there[1] + shift], [here[0] + shift, there[0] + shift], label=label, **style)
        return
    step = -np.sign(move) * 0.45
    for at, to in ((here, here + step), (there - step, there)):
        ax.plot([at[1] + shift, to[1] + shift], [at[0] + shift, to[0] + shift], label=label, **style)
        label = None
