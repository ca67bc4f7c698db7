"""The loop around a jitted iteration: metrics, evaluation, checkpoints, signals, and a guard against divergence.

It knows neither agents nor tasks: what it drives is a `Job`, or several of the same kind that are iterated as one
program. Dispatch runs one iteration ahead of the metrics, so the host's work between two iterations costs the device
nothing.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from hrlspec import checkpoint
from hrlspec.run import heartbeat
from hrlspec.run.errors import Interrupted
from hrlspec.run.hosts import ALONE, Hosts
from hrlspec.run.signals import StopRequest, polled_signals
from hrlspec.run.track import Position, State, Track


@dataclasses.dataclass(frozen=True)
class Together:
    """How several jobs are iterated as one program.

    Attributes:
        join: makes one state of theirs.
        split: makes states of theirs of it again.
        iterate: as a job's; metrics have a leading axis.
    """

    join: Callable[[Sequence[State]], State]
    split: Callable[[State], Sequence[State]]
    iterate: Callable[[State, int], tuple[State, Mapping[str, Any]]]


class Loop:
    """Runs in their open folders, from their beginning or from where they were left, side by side to the end.

    Args:
        tracks: the runs, which differ in nothing but their seeds; each stands where the first one does.
        together: how they are iterated, where there are several.
        checkpoint_seconds: how much work a kill may cost; there is always a checkpoint at the end.
        hosts: which of the processes this is that drive a single run together, each its own loop.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        together: Together | None = None,
        *,
        checkpoint_seconds: float,
        hosts: Hosts = ALONE,
    ) -> None:
        self._tracks, self._together, self._hosts = tracks, together, hosts
        self._job = tracks[0].job
        self._iterate = self._job.iterate if together is None else together.iterate
        self._checkpoint_seconds = checkpoint_seconds
        self._pending: collections.deque[Mapping[str, Any]] = collections.deque()

    @property
    def position(self) -> Position:
        """Where the runs stand: the first one's."""
        return self._tracks[0].at

    @property
    def where(self) -> str:
        """The folder, or folders, in words."""
        first, last = (self._tracks[i].folder.path for i in (0, -1))
        return str(first) if len(self._tracks) == 1 else f"each of {first} to {last}"

    def restore(self, step: int | None = None) -> State:
        """The state to go on from; rows after it are dropped.

        Args:
            step: of the checkpoint to take; else the newest intact one of each run, or a fresh state where there is
                none.

        Raises:
            CheckpointError: there are checkpoints but none can be used.
        """
        states = [self._restored(track, step) for track in self._tracks]
        return states[0] if self._together is None else self._together.join(states)

    def parts(self, state: State) -> Sequence[State]:
        """The state of each run."""
        return [state] if self._together is None else self._together.split(state)

    def _restored(self, track: Track, step: int | None) -> State:
        state = track.job.init()
        if not track.folder.resumed:
            return state
        found: list[checkpoint.Restored[State]] = []

        def newest() -> int | None:
            with contextlib.suppress(checkpoint.CheckpointMissingError):
                found.append(track.load(state, step))
            track.folder.rewind(found[0].step if found else -1)
            return found[0].step if found else None

        there = self._hosts.lead(newest)
        if there is None:
            return state
        restored = found[0] if found else track.load(state, there)
        track.at = Position(**restored.metadata["position"])
        return restored.state

    def train(self, state: State) -> State:
        """Iterates to the end, from where `restore` left off.

        Raises:
            Interrupted: SIGINT or SIGTERM came after the first iteration; a checkpoint was written.
            DivergedError: updates were skipped for too long, or parameters are not finite.
            UnsavedError: a row or a checkpoint cannot be written.
        """
        with polled_signals(f"--resume continues from what is in {self.where}") as stop:
            stop.patient = False  # while the first iteration compiles, nothing has been done
            return self._train(state, stop)

    def _train(self, state: State, stop: StopRequest) -> State:
        job, at = self._job, self.position
        saved = lap = mark = time.monotonic()
        first, stopping = at.done, False

        def asked() -> tuple[bool, bool]:
            """Whether to stop, and whether to save."""
            wished = self._hosts.wished(bool(stop))
            return self._hosts.lead(lambda: (wished, time.monotonic() - saved >= self._checkpoint_seconds))

        def passed() -> None:
            """Takes the time."""
            nonlocal lap
            before, lap = lap, time.monotonic()
            for track in self._tracks:
                track.at.wall += lap - before

        while at.done < job.num_iterations:
            state, metrics = self._iterate(state, at.done)
            stop.patient = True
            self._pending.append(metrics)
            for track in self._tracks:
                track.at.done += 1
                track.at.timed += at.done > first + 1
            if at.done == first + 1:
                self._collect(leave=0)
                mark = time.monotonic()
            evaluating, (stopping, saving) = job.evaluation_due(at.done), asked()
            pause = evaluating or saving or stopping
            self._collect(leave=0 if pause else 1)
            if not pause:
                continue
            heartbeat.note(steady=False)
            passed()
            for track in self._tracks:
                track.at.training += lap - mark
            if evaluating:
                self._evaluate(state)
                passed()
                stopping = asked()[0]
            if saving or stopping or at.done == job.num_iterations:
                self._save(state)
                saved = time.monotonic()
                stopping = asked()[0]
            if stopping and at.done < job.num_iterations:
                raise Interrupted(
                    f"{stop.signal_name or 'a signal'} after {self._tracks[0].env_steps} of "
                    f"{job.num_iterations * job.steps_per_iteration} "
                    f"environment steps; a checkpoint is in {self.where}, --resume continues from it"
                )
            mark = time.monotonic()
        if stopping:
            raise Interrupted(
                f"{stop.signal_name or 'a signal'} after the last step; --resume evaluates what is in {self.where}"
            )
        return state

    def _collect(self, leave: int) -> None:
        """Takes in the metrics of all iterations but the ``leave`` latest, waiting for them."""
        while len(self._pending) > leave:
            metrics = {name: np.atleast_1d(x) for name, x in jax.device_get(self._pending.popleft()).items()}
            env_steps = (self.position.done - len(self._pending)) * self._job.steps_per_iteration
            heartbeat.note(steady=True)
            for which, track in enumerate(self._tracks):
                track.take({name: float(x[which]) for name, x in metrics.items()}, env_steps)

    def _evaluate(self, state: State) -> None:
        """Adds a row to each run."""
        for track, part in zip(self._tracks, self.parts(state), strict=True):
            track.check(part)
            self._hosts.lead(functools.partial(track.add_row, part))
            at = track.at
            at.iterations, at.sums, at.timed, at.training = 0, {}, 0, 0.0

    def _save(self, state: State) -> None:
        for track, part in zip(self._tracks, self.parts(state), strict=True):
            track.check(part)  # what is damaged must not replace what is not
            readable = self._hosts.readable(part)
            self._hosts.lead(functools.partial(track.save, readable))
