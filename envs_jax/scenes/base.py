"""What every scene can do. Axes: **t** steps of an episode, **D** coordinates of a position."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PATH_COLORS = ("#1f5fa8", "#c2452d", "#2e8b57", "#8a4fbf", "#b8860b", "#c2408f", "#4d4d4d", "#008b8b")
"""Colours of the legs of a path, in turn."""


@dataclasses.dataclass(frozen=True)
class Leg:
    """Consecutive steps of an episode during which the agent was after the same goal.

    Attributes:
        first: the first step.
        last: the last step, this one included.
        label: what a legend calls it, such as ``2. a, avoiding c d``.
        reach: names of the propositions that were to be reached.
        avoid: names of the propositions that were to be avoided.
        reached: whether the leg ended because a goal was reached.
    """

    first: int
    last: int
    label: str
    reach: tuple[str, ...]
    avoid: tuple[str, ...]
    reached: bool


@dataclasses.dataclass(frozen=True)
class Shape:
    """Something to see from above, in a picture whose y points down.

    Attributes:
        kind: a disc, the square of a cell, or one that cannot be entered.
        name: the proposition that it stands for, or what else it is; a wall has none.
        x: of the middle.
        y: of the middle, downwards.
        radius: of the disc, or half a square's side.
        color: red, green and blue, 0 to 255, if the name is that of a colour.
    """

    kind: Literal["disc", "cell", "wall"]
    name: str
    x: float
    y: float
    radius: float
    color: tuple[int, int, int] | None


@dataclasses.dataclass(frozen=True)
class Outline:
    """A layout as shapes, for whoever draws it with means of their own.

    Attributes:
        width: of the picture.
        height: of the picture, in the same units.
        shapes: what there is to see; later ones lie on top.
        cell: side of a cell, or ``None`` where the agent moves freely. A move that is longer leads over the edge.
    """

    width: float
    height: float
    shapes: tuple[Shape, ...]
    cell: float | None


class Scene(abc.ABC):
    """A layout as something to look at: a small value that draws itself, and an agent's path in it."""

    @abc.abstractmethod
    def draw(self, ax: Axes, positions: np.ndarray, legs: Sequence[Leg]) -> None:
        """Draws a whole episode on matplotlib's axes.

        Args:
            ax: where to draw; its legend is left to the caller.
            positions: ``[t + 1, D]``, where the agent was, the end included.
            legs: cover the t steps in order; each is a line of its own colour, goals are marked where reached.
        """

    @abc.abstractmethod
    def frame(self, positions: np.ndarray, now: int, leg: Leg | None) -> np.ndarray:
        """Draws one moment of an episode.

        Args:
            positions: ``[t + 1, D]``, where the agent is throughout the episode.
            now: which of them is shown, 0 to t.
            leg: the one in force, ``None`` at the end.

        Returns:
            uint8 ``[H, W, 3]``, first row on top, the same size for every moment.
        """

    def outline(self) -> Outline | None:
        """The layout as shapes; ``None`` where there is nothing to see from above."""
        return None

    def in_outline(self, positions: np.ndarray) -> np.ndarray:
        """Positions ``[t + 1, D]`` as they lie in the outline.

        Returns:
            float ``[t + 1, 2]``, x and y, or ``[t + 1, 3]`` with a heading in radians, clockwise from the right.
        """
        return np.asarray(positions, float)

    def from_outline(self, places: np.ndarray) -> np.ndarray:
        """Places ``[_, 2]``, x and y in the outline, as positions, float ``[_, 2]``."""
        return np.asarray(places, float)
