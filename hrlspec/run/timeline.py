"""Episodes of environments that do not say what they look like: what held, and what was asked for, over time.

Axes: **t** steps of an episode, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from PIL import Image, ImageDraw

from envs_jax.scenes import PATH_COLORS, Leg, Scene

_ROW, _NAMES, _STEPS = 22, 110, 420  # pixels of a frame: a row's height, the names' width, the steps'
_HELD, _REACH, _AVOID, _FREE = "#1e1e22", "#cfe8cf", "#f3cdc6", "#f4f4f1"


@dataclasses.dataclass(frozen=True)
class Timeline(Scene):
    """A row for each proposition along the steps of an episode; a "position" is the labels that hold, bool ``[P]``.

    Attributes:
        propositions: names of the P propositions.
    """

    propositions: tuple[str, ...]

    def draw(self, ax: Axes, positions: np.ndarray, legs: Sequence[Leg]) -> None:
        """Draws a whole episode.

        Dark where a proposition holds; tinted in a leg's colour where it was to be reached, hatched where it was to be
        avoided. The last row is the sub-task in force; a numbered line marks where an edge was taken.
        """
        for step, row in np.argwhere(positions):
            ax.barh(row, 1, left=step - 0.5, height=0.5, color=_HELD, zorder=3)
        last_row = len(self.propositions)
        for number, leg in enumerate(legs):
            color, steps = PATH_COLORS[number % len(PATH_COLORS)], leg.last + 1 - leg.first
            for name in leg.reach:
                ax.barh(self._row(name), steps, left=leg.first, height=0.9, color=color, alpha=0.3, zorder=1)
            for name in leg.avoid:
                hatched: dict[str, Any] = {"facecolor": "none", "edgecolor": color, "hatch": "///", "linewidth": 0}
                ax.barh(self._row(name), steps, left=leg.first, height=0.9, alpha=0.5, zorder=1, **hatched)
            ax.barh(last_row, steps, left=leg.first, height=0.5, color=color, label=leg.label, zorder=2)
            if leg.reached:
                ax.axvline(leg.last + 1, color=color, linewidth=1.5, zorder=2)
                ax.annotate(str(number + 1), (leg.last + 1, -0.6), color=color, weight="bold", ha="center")
        ax.set_yticks(range(last_row + 1), [*self.propositions, "sub-task"])
        ax.set_xlim(-0.5, len(positions) - 0.5)
        ax.set_ylim(last_row + 0.6, -1.0)  # the first proposition on top
        ax.set_xlabel("step")

    def frame(self, positions: np.ndarray, now: int, leg: Leg | None) -> np.ndarray:
        """Draws the labels up to now; green is to be reached, red is to be avoided."""
        reach, avoid = (leg.reach, leg.avoid) if leg else ((), ())
        image = Image.new("RGB", (_NAMES + _STEPS, _ROW * len(self.propositions)), "white")
        pen = ImageDraw.Draw(image)
        width = _STEPS / len(positions)
        for row, name in enumerate(self.propositions):
            top = _ROW * row
            shade = _REACH if name in reach else _AVOID if name in avoid else _FREE
            pen.rectangle((_NAMES, top + 1, _NAMES + _STEPS - 1, top + _ROW - 2), fill=shade)
            pen.text((6, top + 4), name[:14], fill="black", font_size=12)
            for step in np.flatnonzero(positions[: now + 1, row]):
                left = _NAMES + int(width * step)
                right = max(left + 1, _NAMES + int(width * (step + 1)) - 1)
                pen.rectangle((left, top + 5, right, top + _ROW - 6), fill=_HELD)
        here = _NAMES + int(width * (now + 0.5))
        pen.line((here, 0, here, image.height), fill=PATH_COLORS[1], width=2)
        return np.asarray(image)

    def _row(self, name: str) -> int:
        return self.propositions.index(name)
