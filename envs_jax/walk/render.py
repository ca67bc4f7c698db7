"""Pictures of worlds seen from above: coloured discs, trajectories, sub-tasks. For Walk, and for any world of discs.

:func:`rgb` is plain numpy and makes the frames of animations; :func:`draw_episode`, made of :func:`draw_scene` and
:func:`draw_path`, draws on matplotlib's axes; matplotlib is imported only then. Axes: **t** steps of a path.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from envs_jax.letter.render import _glyph, letter_color

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from envs_jax.walk.world import Walk, WalkLayout

_COLORS = {
    "aqua": (80, 205, 215),
    "blue": (88, 130, 235),
    "cyan": (80, 205, 215),
    "green": (95, 190, 100),
    "magenta": (222, 92, 200),
    "orange": (245, 160, 70),
    "purple": (150, 100, 205),
    "red": (232, 88, 80),
    "yellow": (240, 215, 75),
}
_BACKGROUND = (250, 250, 248)
_SIDE = (205, 205, 200)
_INK = (30, 30, 34)
PATH_COLORS = ("#1f5fa8", "#c2452d", "#2e8b57", "#8a4fbf", "#b8860b", "#c2408f", "#4d4d4d", "#008b8b")
_SMALLEST = 64


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

    @property
    def color(self) -> tuple[int, int, int]:
        """Red, green and blue: the name's own if it is a colour, else as in the pictures of Letter."""
        return _COLORS.get(self.name) or letter_color(ord(self.name[0].lower()) - ord("a"))


@dataclasses.dataclass(frozen=True)
class Scene:
    """What there is to see besides the agent.

    Attributes:
        regions: the discs; later ones lie on top.
        low: left and lower side of the square.
        high: right and upper side.
    """

    regions: tuple[Region, ...]
    low: float
    high: float

    def index_at(self, position: Any, names: Collection[str]) -> tuple[int, ...]:
        """Which regions of the given names hold a position: the chosen ones where a path reached its goal."""
        x, y = np.asarray(position)[:2]
        return tuple(
            i
            for i, region in enumerate(self.regions)
            if region.name in names and np.hypot(region.x - x, region.y - y) <= region.radius + 1e-4
        )


def walk_scene(env: Walk, layout: WalkLayout) -> Scene:
    """The scene of a layout of :class:`envs_jax.Walk`."""
    discs = np.asarray(layout.discs)
    regions = [
        Region(name, *(float(number) for number in discs[:, i, k]))
        for i, name in enumerate(env.propositions)
        for k in range(discs.shape[2])
        if discs[2, i, k] > 0
    ]
    return Scene(tuple(regions), env.low, env.high)


def rgb(
    scene: Scene,
    position: Any,
    *,
    heading: float | None = None,
    trail: Iterable[Any] = (),
    chosen: Collection[int] = (),
    avoided: Collection[str] = (),
    size: int = 336,
) -> np.ndarray:
    """Draws the regions with their first letters, where the agent has been as a line of dots, and the agent.

    Args:
        scene: the regions and the square.
        position: float ``[2]``, the agent.
        heading: where the agent looks, in radians from the x axis; ``None`` for an agent that looks nowhere.
        trail: earlier positions, each float ``[2]``.
        chosen: regions, by index, that get a dark rim.
        avoided: names whose regions are hatched.
        size: side of the picture in pixels, at least 64.

    Returns:
        uint8 ``[size, size, 3]``; the first row is the upper side.

    Raises:
        ValueError: if the picture is too small, or a position is not x and y.
    """
    if size < _SMALLEST:
        raise ValueError(f"size is {size}, expected at least {_SMALLEST}")
    unit = (scene.high - scene.low) / size
    x = scene.low + unit * (np.arange(size) + 0.5)
    y = x[::-1, None]
    image = np.empty((size, size, 3), np.uint8)
    image[:] = _BACKGROUND
    stripes = (np.arange(size)[:, None] + np.arange(size)) % 9 < 2
    for i, region in enumerate(scene.regions):
        distance = np.hypot(x - region.x, y - region.y)
        disc = distance <= region.radius
        # A quarter of what lies below shows through, so that places in two regions can be told.
        image[disc] = ((image[disc].astype(int) + 3 * np.array(region.color)) // 4).astype(np.uint8)
        if region.name in avoided:
            image[disc & stripes] = _INK
        rim = 3 if i in chosen else 1
        image[disc & (distance > region.radius - rim * unit)] = _INK
    for region in scene.regions:
        _write(image, region, scene)
    for visited in trail:
        _dot(image, x, y, visited, 1.6 * unit)
    _dot(image, x, y, position, 5 * unit)
    if heading is not None:
        nose = np.asarray(position)[:2] + 9 * unit * np.array([np.cos(heading), np.sin(heading)])
        for share in (0.6, 0.8, 1.0):
            _dot(image, x, y, (1 - share) * np.asarray(position)[:2] + share * nose, 2 * unit)
    image[0], image[-1], image[:, 0], image[:, -1] = _SIDE, _SIDE, _SIDE, _SIDE
    return image


def draw_scene(ax: Axes, scene: Scene, *, chosen: Collection[int] = (), avoided: Collection[str] = ()) -> None:
    """Draws the regions with their names, on axes of equal scale without ticks.

    Args:
        ax: matplotlib's.
        scene: the regions and the square.
        chosen: regions, by index, that get a thick rim.
        avoided: names whose regions are hatched.
    """
    from matplotlib.patches import Circle, Rectangle

    side = scene.high - scene.low
    ax.add_patch(Rectangle((scene.low, scene.low), side, side, facecolor="#fafaf8", edgecolor="#cdcdc8", zorder=0))
    for i, region in enumerate(scene.regions):
        ax.add_patch(
            Circle(
                (region.x, region.y),
                region.radius,
                facecolor=(*(part / 255 for part in region.color), 0.65),
                edgecolor="#1e1e22",
                linewidth=3 if i in chosen else 0.8,
                hatch="///" if region.name in avoided else None,
                zorder=1,
            )
        )
        ax.annotate(region.name, (region.x, region.y), ha="center", va="center", fontsize=10, zorder=2)
    margin = 0.02 * side
    ax.set_xlim(scene.low - margin, scene.high + margin)
    ax.set_ylim(scene.low - margin, scene.high + margin)
    ax.set_aspect("equal")
    ax.set_axis_off()


def draw_path(
    ax: Axes,
    positions: Any,
    *,
    legs: Sequence[int] | np.ndarray | None = None,
    names: Mapping[int, str] | Sequence[str] = (),
    color: str | None = None,
) -> None:
    """Draws a trajectory: a dot where it starts, a line that changes its colour with the sub-task in force.

    Call it again for more trajectories; give each a ``color`` of its own if legs do not matter.

    Args:
        ax: matplotlib's.
        positions: float ``[t + 1, 2 or more]``; x and y come first.
        legs: int ``[t]``, which sub-task was in force at each step, as consecutive numbers from 0; one if not given.
        names: what the legend calls the legs.
        color: of the whole line; colours in turn for the legs if not given.

    Raises:
        ValueError: if the legs are not as many as the steps.
    """
    path = np.asarray(positions)[:, :2]
    leg = np.zeros(len(path) - 1, int) if legs is None else np.asarray(legs)
    if leg.shape != (len(path) - 1,):
        raise ValueError(f"legs for {leg.shape} steps, expected {len(path) - 1}")
    labels = dict(names) if isinstance(names, Mapping) else dict(enumerate(names))
    starts = np.flatnonzero(np.diff(leg, prepend=-1))
    for first, last in zip(starts, [*starts[1:], len(leg)], strict=True):
        number = int(leg[first])
        shade = color or PATH_COLORS[number % len(PATH_COLORS)]
        label = labels.pop(number, None)  # Each is told once.
        ax.plot(*path[first : last + 1].T, color=shade, linewidth=2, solid_capstyle="round", label=label, zorder=3)
    ax.plot(*path[0], "o", color=color or "#1e1e22", markersize=6, zorder=4)


def draw_episode(
    ax: Axes,
    scene: Scene,
    positions: Any,
    *,
    legs: Sequence[int] | np.ndarray | None = None,
    names: Mapping[int, str] | Sequence[str] = (),
    reached: Mapping[int, Collection[str]] | None = None,
    avoided: Collection[str] = (),
) -> None:
    """Draws an episode: the scene, the path by sub-tasks, and the regions chosen to reach them, numbered in order.

    Args:
        ax: matplotlib's.
        scene: the regions and the square.
        positions: float ``[t + 1, 2 or more]``.
        legs: int ``[t]``, see :func:`draw_path`.
        names: what the legend calls the legs.
        reached: for each position at which a sub-task was completed, by its number in ``positions``, the
            propositions that were to be reached; the regions of these that hold it get a thick rim.
        avoided: names whose regions are hatched.
    """
    path = np.asarray(positions)
    ends = dict(sorted((reached or {}).items()))
    chosen = {i for at, wanted in ends.items() for i in scene.index_at(path[at], wanted)}
    draw_scene(ax, scene, chosen=chosen, avoided=avoided)
    draw_path(ax, path, legs=legs, names=names)
    for order, at in enumerate(ends, 1):
        ax.plot(*path[at, :2], "o", color="#1e1e22", markerfacecolor="white", markersize=7, zorder=5)
        ax.annotate(str(order), (path[at, 0], path[at, 1]), (5, 5), textcoords="offset points", weight="bold", zorder=5)


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
    image[near] = np.where(inside[..., None], np.array(_INK, np.uint8), image[near])


def _write(image: np.ndarray, region: Region, scene: Scene) -> None:
    """The name's first letter in the middle of its region, where the picture has room for it."""
    size = len(image)
    letter = ord(region.name[0].lower()) - ord("a")
    scale = size / (scene.high - scene.low)
    side = max(12, round(scale * region.radius))
    left = round(scale * (region.x - scene.low) - side / 2)
    top = round(scale * (scene.high - region.y) - side / 2)
    if 0 <= letter < 26 and 0 <= left <= size - side and 0 <= top <= size - side:
        image[top : top + side, left : left + side][_glyph(letter, side)] = _INK
