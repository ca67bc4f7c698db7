"""Processes of one machine that train a run together: started, watched, and begun again when one dies or hangs.

A process that lives says so twice a second, from a thread of its own, while it compiles as well; one that is stopped
does not. A process that lives may still hang, as in a collective that never ends: then its iterations take ten times as
long as the longest did. What else takes long, compiling and evaluating, is not known beforehand, and so has a generous
limit. See `hrlspec.run.heartbeat` for the other side.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hrlspec.run.errors import BAD_INPUT, FAILED, OK
from hrlspec.run.heartbeat import BEAT_SECONDS, SOCKET
from hrlspec.run.hosts import LOST
from hrlspec.run.platform import cores
from hrlspec.run.signals import INTERRUPTED, StopRequest, polled_signals

# Until a process counts as stopped. Where it does not go from iteration to iteration it may load libraries, which keep
# it from any sign meanwhile, on a busy machine for seconds.
SILENCE_SECONDS, LOADING_SECONDS = 5.0, 15.0
STEADY_SECONDS, STEADY_TIMES = 10.0, 10.0  # how long an iteration may take at least, and in terms of the longest
_PARTING_SECONDS = 2.0  # for the others to end by themselves, and say why,
_ORDERLY_SECONDS = 30.0  # and to bring to an end what they do if the first one ended in order
_FINAL = (BAD_INPUT, FAILED, INTERRUPTED)  # statuses of processes that need not be tried again
_LONGEST_DELAY = 60.0  # seconds before another try


class Watch:
    """What a process has shown of itself.

    Args:
        now: when it was started, in seconds.
        patience: seconds in which it has to do something that may take long.
    """

    def __init__(self, now: float, patience: float) -> None:
        self._patience = patience
        self._beat: float | None = None
        self._changed, self._count, self._steady, self._longest = now, 0, False, 0.0

    def hear(self, now: float, count: int, steady: bool) -> None:
        """It lives, and has done so many things; the next one may or may not take as long as those before."""
        self._beat = now
        if count != self._count:
            if self._steady:
                self._longest = max(self._longest, now - self._changed)
            self._changed, self._count, self._steady = now, count, steady

    def complaint(self, now: float, stopped: bool = False) -> str | None:
        """What is wrong with it, if anything; the system may know that it has been stopped."""
        silence = SILENCE_SECONDS if stopped or self._steady else LOADING_SECONDS
        if self._beat is not None and now - self._beat > silence:
            return f"has not answered for {now - self._beat:.0f} s"
        limit = self._patience
        if self._steady and self._longest:
            limit = min(limit, max(STEADY_SECONDS, STEADY_TIMES * self._longest))
        return f"has done nothing for {now - self._changed:.0f} s" if now - self._changed > limit else None


class _Worker:
    """One of the processes."""

    def __init__(self, command: Sequence[str], on: Sequence[int], patience: float) -> None:
        self.socket, theirs = socket.socketpair()
        with theirs, _on_cores(on):
            self._process = subprocess.Popen(
                command,
                env=os.environ | {SOCKET: str(theirs.fileno())},
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the supervisor
            )
        self.watch = Watch(time.monotonic(), patience)
        self._unread = b""
        self._killed = False

    @property
    def status(self) -> int | None:
        """The exit status, negative for a signal; ``None`` while it runs, and if it was ended from here."""
        return None if self._killed else self._process.poll()

    @property
    def stopped(self) -> bool:
        """Whether somebody has stopped it, as far as the system says so."""
        with contextlib.suppress(OSError):
            return Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
        return False

    def read(self) -> list[str] | None:
        """The names of signals that it got; ``None`` if it hears no more."""
        try:
            said = self.socket.recv(1 << 16)
        except OSError:
            said = b""
        *lines, self._unread = (self._unread + said).split(b"\n")
        names = []
        for words in (line.decode().split() for line in lines):
            if len(words) == 1:
                names += words
            else:
                self.watch.hear(time.monotonic(), int(words[0]), words[1] == "1")
        return names if said else None

    def tell(self, name: str) -> None:
        """Passes a signal on."""
        with contextlib.suppress(OSError):
            self.socket.sendall(f"{name}\n".encode())

    def end(self) -> None:
        """Ends it and what it has started, if it still runs."""
        if self._process.poll() is None:
            self._killed = True
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self.socket.close()


def supervise(
    commands: Callable[[bool], Sequence[Sequence[str]]],
    *,
    reached: Callable[[], Any],
    restarts: int,
    patience: float,
    say: Callable[[str], None],
) -> int:
    """Runs processes together until they are done, and returns the exit status.

    What the user can mend, and what would only fail again, is not tried again. SIGINT and SIGTERM, to whomever, are
    passed on to all; a second one ends them at once. However this process ends, the others do.

    Args:
        commands: what to start, one command a process; called for each try, with whether there was one before.
        reached: how far they have come; where that changes between two failures, restarts are counted anew.
        restarts: how often in a row to begin again.
        patience: seconds that compiling, evaluating or saving may take.
        say: prints a line.
    """
    failures, again = 0, False
    with polled_signals("--resume goes on from the last checkpoint") as stop:
        while True:
            before = reached()
            status, trouble = _attempt(commands(again), patience, stop)
            again = True
            if trouble is None:
                return status
            if stop:
                say(f"interrupted: {trouble}; --resume goes on from the last checkpoint")
                return INTERRUPTED
            failures = failures + 1 if reached() == before else 1
            if failures > restarts:
                say(f"error: {trouble}; given up after {restarts} restarts; --resume goes on from the last checkpoint")
                return FAILED
            delay = min(2.0 ** (failures - 1), _LONGEST_DELAY)
            say(f"{trouble}; all begin again from the last checkpoint in {delay:.0f} s ({failures} of {restarts})")
            stop.wait(delay)
            if stop:
                return INTERRUPTED


def _attempt(commands: Sequence[Sequence[str]], patience: float, stop: StopRequest) -> tuple[int, str | None]:
    """The exit status, and what went wrong if another try may help."""
    with contextlib.ExitStack() as stack:
        workers = []
        for command, on in zip(commands, _shares(cores(), len(commands)), strict=True):
            workers.append(_Worker(command, on, patience))
            stack.callback(workers[-1].end)
        selector = stack.enter_context(selectors.DefaultSelector())
        for worker in workers:
            selector.register(worker.socket, selectors.EVENT_READ, worker)
        trouble = _watch(workers, selector, stop)
        orderly = any(worker.status in _FINAL for worker in workers)
        end = time.monotonic() + (_ORDERLY_SECONDS if orderly else _PARTING_SECONDS)
        while any(worker.status is None for worker in workers) and time.monotonic() < end and trouble is None:
            time.sleep(0.05)
    statuses = [worker.status for worker in workers]
    for status in _FINAL:
        if status in statuses:
            return status, None
    ended = [(index, status) for index, status in enumerate(statuses) if status not in (None, OK)]
    if trouble is None and ended:
        # One that lost the others is not the one to blame.
        index, status = min(ended, key=lambda one: one[1] == LOST)
        trouble = f"process {index} {_in_words(status or OK)}"
    return OK, trouble


def _watch(workers: Sequence[_Worker], selector: selectors.BaseSelector, stop: StopRequest) -> str | None:
    """Returns when all are done or one has failed; with what is wrong with one that still runs, if that is it."""
    told = False
    while True:
        for key, _ in selector.select(BEAT_SECONDS):
            names = key.data.read()
            if names is None:
                selector.unregister(key.fileobj)
            elif names and not stop:
                stop.ask(names[0])
        if stop.signal_name is not None and not told:
            told = True
            for worker in workers:
                worker.tell(stop.signal_name)
        statuses = [worker.status for worker in workers]
        if all(status == OK for status in statuses) or any(status not in (None, OK) for status in statuses):
            return None
        now = time.monotonic()
        for index, worker in enumerate(workers):
            complaint = worker.watch.complaint(now, worker.stopped)
            if complaint and statuses[index] is None:
                return f"process {index} {complaint}"


def _in_words(status: int) -> str:
    """How a process ended."""
    if status == LOST:
        return "lost the others"
    return f"ended by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"


def _shares(whole: Sequence[int], number: int) -> list[Sequence[int]]:
    """Cores divided among so many processes, the same number for each; all for each where there are too few."""
    each = len(whole) // number
    return [whole[each * i : each * (i + 1)] if each else whole for i in range(number)]


@contextlib.contextmanager
def _on_cores(chosen: Sequence[int]) -> Iterator[None]:
    """What is started meanwhile has these cores, where the system can say so."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, chosen)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
