"""How far many runs are: one table on a terminal, plain lines elsewhere. What is shown is read from their folders."""

from __future__ import annotations

import collections
import time
from collections.abc import Sequence
from typing import Literal, Self

from rich.live import Live
from rich.table import Table

from hrlspec.run.console import PlainConsole
from hrlspec.run.folder import holds_run
from hrlspec.run.listing import FoundRun, look_at
from hrlspec.run.planned import PlannedRun
from hrlspec.run.progress import duration
from hrlspec.run.tables import plain_table

TABLE_SECONDS, LINE_SECONDS = 2.0, 60.0
"""Between two looks at the folders."""
_AROUND = 8  # lines of a table that are no runs


class RunTable:
    """Shows how runs stand; a context manager, which takes the table away at the end.

    Args:
        runs: what is shown, in this order.
        console: where.
    """

    def __init__(self, runs: Sequence[PlannedRun], console: PlainConsole) -> None:
        self._runs, self._console = runs, console
        self._ended: dict[str, Literal["finished", "failed"]] = {}
        self._found: dict[str, FoundRun | None] = {}
        self._look()
        self._before, self._began = self._done(), time.monotonic()
        self._looked = self._began
        live = console.is_terminal and not console.is_dumb_terminal
        self._seconds = TABLE_SECONDS if live else LINE_SECONDS
        self._live = Live(console=console, auto_refresh=False, transient=True) if live else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
            self._live.update(self.table(), refresh=True)
        return self

    def __exit__(self, *exception: object) -> None:
        if self._live is not None:
            self._live.stop()

    def ended(self, run: PlannedRun, how: Literal["finished", "failed"]) -> None:
        """A run has ended; one that is finished is told in a line."""
        self._ended[run.name] = how
        found = self._found[run.name] = _look_at(run)
        if how == "finished":
            wall = "" if found is None or found.wall_s is None else f", trained in {duration(found.wall_s)}"
            self._console.say(f"done: {run.name}{wall}")

    def update(self) -> None:
        """Looks again and shows what there is, unless that was done a moment ago."""
        if time.monotonic() - self._looked < self._seconds:
            return
        self._look()
        self._looked = time.monotonic()
        if self._live is not None:
            self._live.update(self.table(), refresh=True)
        else:
            self._console.say(self.line())

    def line(self) -> str:
        """How many runs are in which state, the steps of all together, and the time left at the speed so far."""
        counts = collections.Counter(map(self._state, self._runs))
        states = ", ".join(f"{number} {state}" for state, number in counts.items())
        done, total = self._done(), sum(run.total_steps for run in self._runs)
        rate = (done - self._before) / max(time.monotonic() - self._began, 1e-9)
        left = f", {rate:,.0f} steps/s, {duration((total - done) / rate)} left" if rate > 0 else ""
        return f"{states}; {done:,}/{total:,} steps{left}"

    def table(self) -> Table:
        """A row for each run; where there is not as much room, for those that are running or have failed."""
        table = plain_table("Runs", ["run", "state", "steps", "of", "success", "time"], self.line())
        table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
        room = max(self._console.height - _AROUND, 1)
        shown: Sequence[PlannedRun] = self._runs
        if len(shown) > room:
            shown = [run for run in shown if self._state(run) in ("running", "failed")][:room]
        for run in shown:
            found = self._found[run.name]
            success, wall = (None, None) if found is None else (found.success_rate, found.wall_s)
            table.add_row(
                run.name,
                self._state(run),
                f"{0 if found is None else found.env_steps:,}",
                f"{run.total_steps:,}",
                "-" if success is None else f"{success:.3f}",
                "-" if wall is None else duration(wall),
            )
        return table

    def _state(self, run: PlannedRun) -> str:
        """``waiting`` or ``running``, until it has ended."""
        found = self._found[run.name]
        running = found is not None and found.state == "running"
        return self._ended.get(run.name, "running" if running else "waiting")

    def _done(self) -> int:
        """Environment steps done by all; the last iteration may take a run beyond what was asked for."""
        found = [(run, self._found[run.name]) for run in self._runs]
        return sum(min(some.env_steps, run.total_steps) for run, some in found if some is not None)

    def _look(self) -> None:
        """Looks at the folders of the runs that have not ended."""
        for run in self._runs:
            if run.name not in self._ended:
                self._found[run.name] = _look_at(run)


def _look_at(run: PlannedRun) -> FoundRun | None:
    """What is in a run's folder, ``None`` while there is no run."""
    return look_at(run.folder) if holds_run(run.folder) else None
