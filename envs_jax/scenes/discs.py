"""Discs in a square, which may overlap, and an agent that moves freely. Axes: **t** steps of a path."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from envs_jax.scenes.base import PATH_COLORS, Leg, Outline, Scene, Shape
from envs_jax.scenes.glyphs import BACKGROUND, INK, LINE, color_of, glyph, own_color

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SMALLEST = 64
_DOT_EVERY = 4  # steps between the dots of a trail


@dataclasses.dataclass(frozen=True)
class Region:
    """A disc that stands for a proposition.

    Attributes:
        name: the proposition.
        x: of the centre.
        y: of the centre, upwards.
        radius: in the same units.
    """

    name: str
    x: float
    y: float
    radius: float


@dataclasses.dataclass(frozen=True)
class DiscScene(Scene):
    """A square from above; positions are x, y, and a heading where the agent has one.

    Attributes:
        regions: the discs; later ones lie on top.
        low: left and lower side of the square.
        high: right and upper side.
        pixels: side of a frame, at least 64.

    Raises:
        ValueError: if frames would be too small.
    """

    regions: tuple[Region, ...]
    low: float
    high: float
    pixels: int = 336

    def __post_init__(self) -> None:
        if self.pixels < _SMALLEST:
            raise ValueError(f"pixels is {self.pixels}, expected at least {_SMALLEST}")

    def index_at(self, position: Any, names: Collection[str]) -> tuple[int, ...]:
        """Which regions of the given names hold a position: the chosen ones where a path reached its goal."""
        x, y = np.asarray(position)[:2]
        return tuple(
            i
            for i, region in enumerate(self.regions)
            if region.name in names and np.hypot(region.x - x, region.y - y) <= region.radius + 1e-4
        )

    def draw(self, ax: Axes, positions: np.ndarray, legs: Sequence[Leg]) -> None:
        """See :class:`Scene`: regions that were reached get a thick rim, those that were to be avoided are hatched."""
        path = np.asarray(positions)
        ends = {leg.last + 1: leg.reach for leg in legs if leg.reached}
        chosen = {i for at, wanted in ends.items() for i in self.index_at(path[at], wanted)}
        self._draw_regions(ax, chosen, {name for leg in legs for name in leg.avoid})
        for number, leg in enumerate(legs):
            line = path[leg.first : leg.last + 2, :2].T
            shade = PATH_COLORS[number % len(PATH_COLORS)]
            ax.plot(*line, color=shade, linewidth=2, solid_capstyle="round", label=leg.label, zorder=3)
        ax.plot(*path[0, :2], "o", color="#1e1e22", markersize=6, zorder=4)
        for order, at in enumerate(ends, 1):
            ax.plot(*path[at, :2], "o", color="#1e1e22", markerfacecolor="white", markersize=7, zorder=5)
            where = (path[at, 0], path[at, 1])
            ax.annotate(str(order), where, (5, 5), textcoords="offset points", weight="bold", zorder=5)

    def frame(self, positions: np.ndarray, now: int, leg: Leg | None) -> np.ndarray:
        """See :class:`Scene`: regions that are to be avoided are hatched, where the agent has been is dotted.

        Raises:
            ValueError: if a position is not x and y, or not finite.
        """
        size, avoided = self.pixels, leg.avoid if leg else ()
        unit = (self.high - self.low) / size
        x = self.low + unit * (np.arange(size) + 0.5)
        y = x[::-1, None]
        image = np.empty((size, size, 3), np.uint8)
        image[:] = BACKGROUND
        stripes = (np.arange(size)[:, None] + np.arange(size)) % 9 < 2
        for region in self.regions:
            distance = np.hypot(x - region.x, y - region.y)
            disc = distance <= region.radius
            # A quarter of what lies below shows through, so that places in two regions can be told.
            image[disc] = ((image[disc].astype(int) + 3 * np.array(color_of(region.name))) // 4).astype(np.uint8)
            if region.name in avoided:
                image[disc & stripes] = INK
            image[disc & (distance > region.radius - unit)] = INK
        for region in self.regions:
            self._write(image, region)
        for visited in positions[:now:_DOT_EVERY]:
            _dot(image, x, y, visited, 1.6 * unit)
        here = np.asarray(positions[now])
        _dot(image, x, y, here, 5 * unit)
        if len(here) > 2:
            nose = here[:2] + 9 * unit * np.array([np.cos(here[2]), np.sin(here[2])])
            for share in (0.6, 0.8, 1.0):
                _dot(image, x, y, (1 - share) * here[:2] + share * nose, 2 * unit)
        image[0], image[-1], image[:, 0], image[:, -1] = LINE, LINE, LINE, LINE
        return image

    def outline(self) -> Outline:
        """See :class:`Scene`; a unit is one of the scene's."""
        side = self.high - self.low
        shapes = (
            Shape("disc", x.name, x.x - self.low, self.high - x.y, x.radius, own_color(x.name)) for x in self.regions
        )
        return Outline(side, side, tuple(shapes), None)

    def in_outline(self, positions: np.ndarray) -> np.ndarray:
        """See :class:`Scene`."""
        path = np.array(positions, float)
        path[:, 0] -= self.low
        path[:, 1] = self.high - path[:, 1]
        path[:, 2:] *= -1
        return path

    def from_outline(self, places: np.ndarray) -> np.ndarray:
        """See :class:`Scene`."""
        return np.stack([places[:, 0] + self.low, self.high - places[:, 1]], -1)

    def _draw_regions(self, ax: Axes, chosen: Collection[int], avoided: Collection[str]) -> None:
        """The regions with their names, on axes of equal scale without ticks."""
        from matplotlib.patches import Circle, Rectangle

        side = self.high - self.low
        ax.add_patch(Rectangle((self.low, self.low), side, side, facecolor="#fafaf8", edgecolor="#cdcdc8", zorder=0))
        for i, region in enumerate(self.regions):
            ax.add_patch(
                Circle(
                    (region.x, region.y),
                    region.radius,
                    facecolor=(*(part / 255 for part in color_of(region.name)), 0.65),
                    edgecolor="#1e1e22",
                    linewidth=3 if i in chosen else 0.8,
                    hatch="///" if region.name in avoided else None,
                    zorder=1,
                )
            )
            ax.annotate(region.name, (region.x, region.y), ha="center", va="center", fontsize=10, zorder=2)
        margin = 0.02 * side
        ax.set_xlim(self.low - margin, self.high + margin)
        ax.set_ylim(self.low - margin, self.high + margin)
        ax.set_aspect("equal")
        ax.set_axis_off()

    def _write(self, image: np.ndarray, region: Region) -> None:
        """The name's first letter in the middle of its region, where the picture has room for it."""
        size = len(image)
        scale = size / (self.high - self.low)
        side = max(12, round(scale * region.radius))
        left = round(scale * (region.x - self.low) - side / 2)
        top = round(scale * (self.high - region.y) - side / 2)
        if 0 <= left <= size - side and 0 <= top <= size - side:
            image[top : top + side, left : left + side][glyph(region.name, side)] = INK


def _dot(image: np.ndarray, x: np.ndarray, y: np.ndarray, position: Any, radius: float) -> None:
    """A filled disc in dark ink at a position; x ``[size]`` and y ``[size, 1]`` are where the pixels lie.

    Raises:
        ValueError: if the position is not x and y, or not finite.
    """
    where = np.asarray(position, float)
    if where.ndim != 1 or len(where) < 2 or not np.isfinite(where[:2]).all():
        raise ValueError(f"a position is {where.tolist()}, expected x and y")
    columns = np.abs(x - where[0]) <= radius
    rows = np.abs(y[:, 0] - where[1]) <= radius
    near = np.ix_(rows, columns)
    inside = np.hypot(x[columns] - where[0], y[rows] - where[1]) <= radius
    image[near] = np.where(inside[..., None], np.array(INK, np.uint8), image[near])
