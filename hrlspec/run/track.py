"""One run of those that a host loop drives: what it is made of, where it stands, and what is kept of it.

Alone or beside others, a run has a folder of its own with its rows and checkpoints, which know nothing of the others.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

from hrlspec import checkpoint
from hrlspec.run.folder import RunFolder

State = Any

PATIENCE = 20  # iterations in a row with skipped updates before the run is given up


class DivergedError(Exception):
    """Training has gone where no update can bring it back from. The message says what was seen and what was saved."""


class UnsavedError(Exception):
    """The run folder cannot be written. The message says why and what was saved before."""


class Display(Protocol):
    """Whoever shows how the run stands; see ``hrlspec/run/progress.py``."""

    def advance(self, env_steps: int, metrics: Mapping[str, float]) -> None:
        """An iteration is done; called once for each, in order."""

    def row(self, row: Mapping[str, Any]) -> None:
        """An evaluation is done."""


@dataclasses.dataclass(frozen=True)
class Job:
    """What a run is made of. All functions depend on their arguments alone, so that a resumed run is the same run.

    Attributes:
        init: makes a fresh state.
        iterate: ``(state, index) -> (state, metrics)``, dispatched without waiting; the old state is donated.
        evaluate: ``(state, env_steps) -> entries of the row``.
        summarise: ``(sums of the metrics, number of iterations) -> entries of the row``.
        healthy: ``state -> bool``, whether its parameters are finite.
        steps_per_iteration: environment steps of one iteration.
        num_iterations: when to end.
        evaluate_every: environment steps between evaluations; there is always one at the end.
    """

    init: Callable[[], State]
    iterate: Callable[[State, int], tuple[State, Mapping[str, Any]]]
    evaluate: Callable[[State, int], Mapping[str, Any]]
    summarise: Callable[[Mapping[str, float], int], Mapping[str, Any]]
    healthy: Callable[[State], bool]
    steps_per_iteration: int
    num_iterations: int
    evaluate_every: int

    def evaluation_due(self, done: int) -> bool:
        """Whether the ``done``-th iteration (from 1) is followed by an evaluation."""
        now, before = (count * self.steps_per_iteration // self.evaluate_every for count in (done, done - 1))
        return now > before or done == self.num_iterations


@dataclasses.dataclass
class Position:
    """Where a run stands on the host's side; kept in the checkpoint's metadata.

    Attributes:
        done: iterations done.
        wall: seconds since the start, in all processes together.
        iterations: iterations since the last row.
        sums: metrics added up over them.
        timed: those of them whose time was taken: all but each process's first, which is the compiler's.
        training: seconds spent on these.
    """

    done: int = 0
    wall: float = 0.0
    iterations: int = 0
    sums: dict[str, float] = dataclasses.field(default_factory=dict)
    timed: int = 0
    training: float = 0.0


class Track:
    """A run on the host's side.

    Args:
        job: the run.
        folder: open, where rows and checkpoints go.
        display: who is told.

    Attributes:
        job: the run.
        folder: its own.
        at: where it stands.
    """

    def __init__(self, job: Job, folder: RunFolder, display: Display) -> None:
        self.job, self.folder, self._display = job, folder, display
        self.at = Position()
        self._skipping = 0

    @property
    def env_steps(self) -> int:
        """Environment steps done."""
        return self.at.done * self.job.steps_per_iteration

    def load(self, state: State, step: int | None = None) -> checkpoint.Restored[State]:
        """A checkpoint of this run, in the form of a state of it: the newest intact one, or that of a step.

        Raises:
            CheckpointError: there is none, or it cannot be used.
        """
        restored = checkpoint.load(self.folder.checkpoints, state, step=step)
        if restored.metadata["config_hash"] not in {self.folder.config_hash, *self.folder.earlier_hashes}:
            raise checkpoint.CheckpointMismatchError(f"checkpoint {restored.path} belongs to another run")
        return restored

    def take(self, metrics: Mapping[str, float], env_steps: int) -> None:
        """Takes in an iteration's metrics.

        Raises:
            DivergedError: updates were skipped for too long.
        """
        at = self.at
        for name, value in metrics.items():
            at.sums[name] = at.sums.get(name, 0.0) + value
        at.iterations += 1
        skipped = any(value > 0 for name, value in metrics.items() if name.endswith("skipped"))
        self._skipping = self._skipping + 1 if skipped else 0
        self._display.advance(env_steps, metrics)
        if self._skipping >= PATIENCE:
            raise DivergedError(
                f"losses or gradients were not finite in {PATIENCE} iterations in a row, up to environment step "
                f"{env_steps}; {self._what_is_left()}; try a smaller learning rate"
            )

    def check(self, state: State) -> None:
        """Raises `DivergedError` unless the parameters are finite."""
        if not self.job.healthy(state):
            raise DivergedError(
                f"parameters are not finite at environment step {self.env_steps}; {self._what_is_left()}; "
                "try a smaller learning rate"
            )

    def add_row(self, state: State) -> None:
        """Evaluates, and adds a row.

        Raises:
            UnsavedError: it cannot be written.
        """
        at, job = self.at, self.job
        row = {
            "env_steps": self.env_steps,
            "wall_s": round(at.wall, 3),
            **job.evaluate(state, self.env_steps),
            **job.summarise(at.sums, at.iterations),
            "train/steps_per_s": round(at.timed * job.steps_per_iteration / at.training, 1) if at.timed else None,
        }
        with self._refusals_told():
            self.folder.append(row)
        self._display.row(row)

    def save(self, state: State) -> None:
        """Writes a checkpoint.

        Raises:
            UnsavedError: it cannot be written.
        """
        metadata = {"config_hash": self.folder.config_hash, "position": dataclasses.asdict(self.at)}
        with self._refusals_told():
            checkpoint.save(self.folder.checkpoints, self.env_steps, state, metadata=metadata)

    @contextlib.contextmanager
    def _refusals_told(self) -> Iterator[None]:
        try:
            yield
        except (OSError, checkpoint.CheckpointDamagedError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise UnsavedError(
                f"cannot write to {self.folder.path} at environment step {self.env_steps}: {reason}; "
                f"{self._what_is_left()}; --resume goes on from there"
            ) from error

    def _what_is_left(self) -> str:
        known = checkpoint.steps(self.folder.checkpoints)
        return f"the last checkpoint, in {self.folder.path}, is of step {known[-1]}" if known else "nothing was saved"
