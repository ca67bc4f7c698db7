"""Ctrl-C and SIGTERM: the end at once, or a flag that is polled where stopping is safe.

Python runs a handler in the main thread, between two of its instructions: while a compiler works it would wait for it,
and what it raises comes up anywhere, in the midst of an import or of a library's callback. So a thread of its own hears
of signals. It sets the flag, or ends the process without unwinding anything; files are written so that they are whole
however a process ends.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130
SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PATIENCE = 1.0  # seconds

Hear = Callable[[str], None]
_hearers: list[Hear] = []  # of the contexts that last, the innermost last
_elsewhere: Hear | None = None


class StopRequest:
    """Whether somebody asked the process to stop.

    Attributes:
        signal_name: ``SIGINT`` or ``SIGTERM`` once asked, else ``None``.
        patient: whether the first signal waits to be polled; while there is nothing to save, it need not.
    """

    def __init__(self) -> None:
        self.signal_name: str | None = None
        self.patient = True
        self._asked = threading.Event()

    def __bool__(self) -> bool:
        return self.signal_name is not None

    def ask(self, signal_name: str) -> None:
        """Asks the process to stop."""
        self.signal_name = signal_name
        self._asked.set()

    def wait(self, seconds: float) -> None:
        """Sleeps until asked, at most so long."""
        self._asked.wait(seconds)


@contextlib.contextmanager
def ended_by_signals(how_to_go_on: str = "") -> Iterator[None]:
    """While the context lasts SIGINT and SIGTERM end the process, with one line and status 130.

    Args:
        how_to_go_on: said in the line.
    """
    with _heard(lambda name: _end(how_to_go_on)):
        yield


@contextlib.contextmanager
def polled_signals(how_to_go_on: str = "") -> Iterator[StopRequest]:
    """While the context lasts the first SIGINT or SIGTERM sets the flag; the second ends the process.

    The handlers that were there before come back afterwards. Signals reach the main thread alone, so in any other
    thread nothing is installed and the flag stays unset.

    Args:
        how_to_go_on: said in the line with which the process ends.

    Example:
        >>> with polled_signals() as stop:
        ...     while not stop:
        ...         break  # one iteration
    """
    stop = StopRequest()

    def hear(name: str) -> None:
        if stop or not stop.patient:
            _end(how_to_go_on)
        stop.ask(name)

    with _heard(hear):
        yield stop


def redirect(to: Hear) -> None:
    """From now on a function is told of this process's signals instead; what it decides comes by `deliver`."""
    global _elsewhere  # noqa: PLW0603
    _elsewhere = to


def deliver(name: str) -> None:
    """As if this process had got a signal, in any thread."""
    for hear in _hearers[-1:]:
        hear(name)


@contextlib.contextmanager
def _heard(hear: Hear) -> Iterator[None]:
    """Calls a function with the name of each signal, in a thread; the main thread goes on when it has returned."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)  # as the interpreter wants it, which writes the number of each signal at once
    heard = threading.Semaphore(0)

    def listen() -> None:
        while number := ours.recv(1):
            if number[0] in SIGNALS:
                (_elsewhere or hear)(signal.Signals(number[0]).name)
                heard.release()

    def wait(number: int, frame: FrameType | None) -> None:
        del number, frame
        heard.acquire(timeout=_PATIENCE)

    listener = threading.Thread(target=listen, name="signals", daemon=True)
    with ours, theirs:
        listener.start()
        woken = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
        before = {number: signal.signal(number, wait) for number in SIGNALS}
        _hearers.append(hear)
        try:
            yield
        finally:
            _hearers.remove(hear)
            for number, handler in before.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(woken)
            theirs.shutdown(socket.SHUT_WR)
            listener.join()


def leave(status: int) -> NoReturn:
    """Ends the process in order; Ctrl-C kills it meanwhile, since what it would raise then nobody catches."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(status)


def _end(how_to_go_on: str) -> None:
    """Ends the process: one line, past the streams, which the main thread may hold."""
    line = f"interrupted: {how_to_go_on}" if how_to_go_on else "interrupted"
    with contextlib.suppress(OSError):
        os.write(2, f"{line}\n".encode(errors="replace"))
    os._exit(INTERRUPTED)
