"""Live progress of a run: a bar with steps/s, level, success and time left; plain lines elsewhere."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from typing import Any, Self

from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from hrlspec.run.console import PlainConsole

LINE_SECONDS = 10.0  # between plain lines
_MEMORY = 0.95  # weight of the past in the moving averages


class ProgressDisplay:
    """Shows how a run stands; a context manager, which takes the bar away at the end.

    Args:
        total: environment steps of the whole run.
        name: of the run.
        console: where to show it; standard error by default, so that standard output stays clean.
        begin: environment steps that are done already.
    """

    def __init__(self, total: int, name: str, *, console: PlainConsole | None = None, begin: int = 0) -> None:
        self._console = console or PlainConsole(stderr=True)
        self._total, self._name, self._done = total, name, begin
        self._rate: float | None = None
        self._success: float | None = None
        self._mark: float | None = None  # when the latest iteration ended
        self._last_line = time.monotonic()
        self._bar: Progress | None = None
        if self._console.is_terminal and not self._console.is_dumb_terminal:
            columns: list[ProgressColumn] = [
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=None),
                TextColumn("{task.fields[status]}", markup=False),
                _TimeLeft(),
            ]
            self._bar = Progress(*columns, console=self._console, expand=True, transient=True)
            self._task = self._bar.add_task(name, total=total, completed=begin, status="compiling", left=None)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        else:
            self._console.say(f"{self._name}: compiling")
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def advance(self, env_steps: int, metrics: Mapping[str, float]) -> None:
        """An iteration is done.

        Args:
            env_steps: done so far.
            metrics: of the iteration; ``episodes``, ``successes`` and ``level`` are shown where there are such.
        """
        now = time.monotonic()
        if self._mark is not None and now > self._mark:  # the first iteration's time is that of the compiler
            self._rate = _blend(self._rate, (env_steps - self._done) / (now - self._mark))
        self._mark, self._done = now, env_steps
        if metrics.get("episodes"):
            self._success = _blend(self._success, metrics["successes"] / metrics["episodes"])
        status = self._status(metrics)
        if self._bar is not None:
            self._bar.update(self._task, completed=env_steps, status=status, left=self._seconds_left())
        elif now - self._last_line >= LINE_SECONDS:
            self._last_line = now
            left = self._seconds_left()
            self._console.say(f"{self._name}: {status}" + ("" if left is None else f", {duration(left)} left"))

    def row(self, row: Mapping[str, Any]) -> None:
        """An evaluation is done: its main numbers, as a line that stays."""
        names = {
            "eval/success_rate": "success",
            "eval/return_mean": "return",
            "eval/steps_mean": "steps",
            "eval/spl": "SPL",
        }
        values = [f"{label} {row[name]:.3f}" for name, label in names.items() if isinstance(row.get(name), float)]
        self._console.say(f"{self._name}: {row['env_steps']:,} steps, unseen tasks: {', '.join(values)}")
        self._mark = None  # the evaluation's time is not training's

    def note(self, text: str) -> None:
        """Something worth saying, as a line that stays."""
        self._console.say(f"{self._name}: {text}")

    def _status(self, metrics: Mapping[str, float]) -> str:
        parts = [f"{self._done:,}/{self._total:,} steps"]
        if self._rate is not None:
            parts.append(f"{self._rate:,.0f} steps/s")
        if "level" in metrics:
            parts.append(f"level {metrics['level']:.0f}")
        if self._success is not None:
            parts.append(f"success {self._success:.2f}")
        return ", ".join(parts)

    def _seconds_left(self) -> float | None:
        return None if not self._rate else max(self._total - self._done, 0) / self._rate


class MeanDisplay:
    """Shows runs that go side by side as one: the means of their numbers, steps and their rate included.

    Args:
        display: where.
        number: of runs; each of them tells of an iteration, or of an evaluation, before one tells of the next.
    """

    def __init__(self, display: ProgressDisplay, number: int) -> None:
        self._display, self._number = display, number
        self._metrics: list[Mapping[str, float]] = []
        self._rows: list[Mapping[str, Any]] = []

    def advance(self, env_steps: int, metrics: Mapping[str, float]) -> None:
        """An iteration of one of the runs is done."""
        self._metrics.append(metrics)
        if len(self._metrics) == self._number:
            self._display.advance(env_steps, _mean(self._metrics))
            self._metrics = []

    def row(self, row: Mapping[str, Any]) -> None:
        """An evaluation of one of them is done."""
        self._rows.append(row)
        if len(self._rows) == self._number:
            self._display.row({**_mean(self._rows), "env_steps": row["env_steps"]})
            self._rows = []


def _mean(several: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Means of the numbers that all of them have."""
    values = {name: [one[name] for one in several] for name in several[0]}
    return {name: statistics.fmean(some) for name, some in values.items() if all(isinstance(x, float) for x in some)}


class _TimeLeft(ProgressColumn):
    """What `ProgressDisplay` estimates; rich's own estimate would count the compiler's time."""

    def render(self, task: Task) -> Text:
        """The time left, empty while unknown."""
        left = task.fields["left"]
        return Text("" if left is None else f"{duration(left)} left")


def duration(seconds: float) -> str:
    """Hours, minutes and seconds as ``1:02:03`` or ``2:03``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _blend(average: float | None, value: float) -> float:
    return value if average is None else _MEMORY * average + (1 - _MEMORY) * value
