"""The loop around a jitted iteration: metrics, evaluation, checkpoints, signals, and a guard against divergence.

It knows neither agents nor tasks: what it drives is a `Job`. Dispatch runs one iteration ahead of the metrics, so the
host's work between two iterations costs the device nothing.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

import jax

from hrlspec import checkpoint
from hrlspec.run import heartbeat
from hrlspec.run.errors import Interrupted
from hrlspec.run.folder import RunFolder
from hrlspec.run.hosts import ALONE, Hosts
from hrlspec.run.signals import StopRequest, polled_signals

Row = dict[str, Any]
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
    """What the loop drives. All functions depend on their arguments alone, so that a resumed run is the same run.

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


class Loop:
    """One run of a job in an open run folder.

    Args:
        job: what to drive.
        folder: where rows and checkpoints go.
        display: who is told.
        checkpoint_seconds: how much work a kill may cost; there is always a checkpoint at the end.
        hosts: which of the processes this is that drive the job together, each its own loop.
    """

    def __init__(
        self, job: Job, folder: RunFolder, display: Display, *, checkpoint_seconds: float, hosts: Hosts = ALONE
    ) -> None:
        self._job, self._folder, self._display, self._hosts = job, folder, display, hosts
        self._checkpoint_seconds = checkpoint_seconds
        self._at = Position()
        self._skipping = 0
        self._pending: collections.deque[Mapping[str, Any]] = collections.deque()

    @property
    def position(self) -> Position:
        """Where the run stands."""
        return self._at

    def restore(self) -> State:
        """The state of the newest intact checkpoint, or a fresh one where there is none; rows after it are dropped.

        Raises:
            CheckpointError: there are checkpoints but none can be used.
        """
        state = self._job.init()
        if not self._folder.resumed:
            return state
        found: list[checkpoint.Restored[State]] = []

        def newest() -> int | None:
            with contextlib.suppress(checkpoint.CheckpointMissingError):
                found.append(checkpoint.load(self._folder.checkpoints, state))
                if found[0].metadata["config_hash"] not in {self._folder.config_hash, *self._folder.earlier_hashes}:
                    raise checkpoint.CheckpointMismatchError(f"checkpoint {found[0].path} belongs to another run")
            self._folder.rewind(found[0].step if found else -1)
            return found[0].step if found else None

        step = self._hosts.lead(newest)
        if step is None:
            return state
        restored = found[0] if found else checkpoint.load(self._folder.checkpoints, state, step=step)
        self._at = Position(**restored.metadata["position"])
        return restored.state

    def train(self, state: State) -> State:
        """Iterates to the end, from where `restore` left off.

        Raises:
            Interrupted: SIGINT or SIGTERM came after the first iteration; a checkpoint was written.
            DivergedError: updates were skipped for too long, or parameters are not finite.
            UnsavedError: a row or a checkpoint cannot be written.
        """
        with polled_signals(f"--resume continues from what is in {self._folder.path}") as stop:
            stop.patient = False  # while the first iteration compiles, nothing has been done
            return self._train(state, stop)

    def _train(self, state: State, stop: StopRequest) -> State:
        job, at = self._job, self._at
        earlier, started = at.wall, time.monotonic()
        saved = mark = started
        first, stopping = at.done, False

        def asked() -> tuple[bool, bool]:
            """Whether to stop, and whether to save."""
            wished = self._hosts.wished(bool(stop))
            return self._hosts.lead(lambda: (wished, time.monotonic() - saved >= self._checkpoint_seconds))

        while at.done < job.num_iterations:
            state, metrics = job.iterate(state, at.done)
            stop.patient = True
            at.done += 1
            self._pending.append(metrics)
            if at.done == first + 1:
                self._collect(leave=0)
                mark = time.monotonic()
            else:
                at.timed += 1
            evaluating, (stopping, saving) = job.evaluation_due(at.done), asked()
            pause = evaluating or saving or stopping
            self._collect(leave=0 if pause else 1)
            if not pause:
                continue
            heartbeat.note(steady=False)
            at.training += time.monotonic() - mark
            at.wall = earlier + time.monotonic() - started
            if evaluating:
                self._evaluate(state)
                at.wall = earlier + time.monotonic() - started
                stopping = asked()[0]
            if saving or stopping or at.done == job.num_iterations:
                self._save(state)
                saved = time.monotonic()
                stopping = asked()[0]
            if stopping and at.done < job.num_iterations:
                raise Interrupted(
                    f"{stop.signal_name or 'a signal'} after {self._env_steps} of "
                    f"{job.num_iterations * job.steps_per_iteration} "
                    f"environment steps; a checkpoint is in {self._folder.path}, --resume continues from it"
                )
            mark = time.monotonic()
        if stopping:
            raise Interrupted(
                f"{stop.signal_name or 'a signal'} after the last step; "
                f"--resume evaluates what is in {self._folder.path}"
            )
        return state

    @property
    def _env_steps(self) -> int:
        return self._at.done * self._job.steps_per_iteration

    def _collect(self, leave: int) -> None:
        """Takes in the metrics of all iterations but the ``leave`` latest, waiting for them."""
        while len(self._pending) > leave:
            at = self._at
            metrics = {name: float(value) for name, value in jax.device_get(self._pending.popleft()).items()}
            for name, value in metrics.items():
                at.sums[name] = at.sums.get(name, 0.0) + value
            at.iterations += 1
            skipped = any(value > 0 for name, value in metrics.items() if name.endswith("skipped"))
            self._skipping = self._skipping + 1 if skipped else 0
            env_steps = (at.done - len(self._pending)) * self._job.steps_per_iteration
            heartbeat.note(steady=True)
            self._display.advance(env_steps, metrics)
            if self._skipping >= PATIENCE:
                raise DivergedError(
                    f"losses or gradients were not finite in {PATIENCE} iterations in a row, up to environment step "
                    f"{env_steps}; {self._what_is_left()}; try a smaller learning rate"
                )

    def _evaluate(self, state: State) -> None:
        """Adds a row."""
        self._check(state)
        self._hosts.lead(lambda: self._add_row(state))
        at = self._at
        at.iterations, at.sums, at.timed, at.training = 0, {}, 0, 0.0

    def _add_row(self, state: State) -> None:
        at, job = self._at, self._job
        row = {
            "env_steps": self._env_steps,
            "wall_s": round(at.wall, 3),
            **job.evaluate(state, self._env_steps),
            **job.summarise(at.sums, at.iterations),
            "train/steps_per_s": round(at.timed * job.steps_per_iteration / at.training, 1) if at.timed else None,
        }
        with self._refusals_told():
            self._folder.append(row)
        self._display.row(row)

    def _save(self, state: State) -> None:
        self._check(state)  # what is damaged must not replace what is not
        readable = self._hosts.readable(state)
        self._hosts.lead(lambda: self._write(readable))

    def _write(self, state: State) -> None:
        metadata = {"config_hash": self._folder.config_hash, "position": dataclasses.asdict(self._at)}
        with self._refusals_told():
            checkpoint.save(self._folder.checkpoints, self._env_steps, state, metadata=metadata)

    @contextlib.contextmanager
    def _refusals_told(self) -> Iterator[None]:
        try:
            yield
        except (OSError, checkpoint.CheckpointDamagedError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise UnsavedError(
                f"cannot write to {self._folder.path} at environment step {self._env_steps}: {reason}; "
                f"{self._what_is_left()}; --resume goes on from there"
            ) from error

    def _check(self, state: State) -> None:
        if not self._job.healthy(state):
            raise DivergedError(
                f"parameters are not finite at environment step {self._env_steps}; {self._what_is_left()}; "
                "try a smaller learning rate"
            )

    def _what_is_left(self) -> str:
        known = checkpoint.steps(self._folder.checkpoints)
        return f"the last checkpoint, in {self._folder.path}, is of step {known[-1]}" if known else "nothing was saved"
