"""Learning curves that can be looked at while a run trains."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

from hrlspec.run.errors import UserError
from hrlspec.run.extras import drawing
from hrlspec.run.folder import RunFolder, read_metrics
from hrlspec.run.track import Display

CURVES = "curves.png"
"""Their name among a run's pictures."""
_SHARE = 0.01  # of the time that drawing may take


class LiveCurves:
    """A display that also keeps the picture in the run folder up to date, from the first evaluation on.

    After each time it leaves out evaluations until drawing has cost its share of the time since.

    Args:
        display: who else is told.
        run: whose curves.
        name: of the run.
        number: of runs side by side, which have the share of one.
    """

    def __init__(self, display: Display, run: RunFolder, name: str, number: int = 1) -> None:
        self._display, self._run, self._name, self._number = display, run, name, number
        self._next = -math.inf

    def advance(self, env_steps: int, metrics: Mapping[str, float]) -> None:
        """An iteration is done."""
        self._display.advance(env_steps, metrics)

    def row(self, row: Mapping[str, Any]) -> None:
        """An evaluation is done, and its row written."""
        self._display.row(row)
        if time.monotonic() < self._next:
            return
        try:
            seconds = draw_curves(self._run, self._name)
        except UserError:
            self._next = math.inf  # as it is said at the end, where it is tried again
        else:
            self._next = time.monotonic() + self._number * seconds / _SHARE


def draw_curves(run: RunFolder, name: str) -> float:
    """Draws a run's learning curves as far as it has come, and returns the seconds that took.

    Raises:
        UserError: they cannot be drawn.
    """
    with drawing():
        from hrlspec.run.curves import learning_curves

        began = time.monotonic()  # what is loaded before is needed at the end in any case
        learning_curves({name: [read_metrics(run.path)]}, run.plots / CURVES)
    return time.monotonic() - began
