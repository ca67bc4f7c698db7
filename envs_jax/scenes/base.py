"""What every scene can do. Axes: **t** steps of an episode, **D** coordinates of a position."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

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
