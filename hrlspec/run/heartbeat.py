"""A process under a supervisor: it shows that it lives, and is told of signals.

The two are connected by a socket, whose number the supervisor leaves in the environment. The process says twice a
second how far it is; the supervisor says the name of a signal. When the supervisor is gone, however it ended, so is the
process.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import socket
import sys
import threading

from hrlspec.run import signals

SOCKET = "HRLSPEC_SUPERVISOR"
BEAT_SECONDS = 0.5
_PR_SET_PDEATHSIG = 1


class _Connection:
    """With the supervisor, if there is one: how often `note` was called, and whether another call is expected soon."""

    socket: socket.socket | None = None
    count = 0
    steady = False

    @classmethod
    def tell(cls, text: str) -> None:
        """Says a line, or drops it where the supervisor is gone or has been stopped and reads nothing."""
        if cls.socket is not None:
            with contextlib.suppress(OSError):
                cls.socket.sendall(f"{text}\n".encode())

    @classmethod
    def beat(cls) -> None:
        """Says how far this process is."""
        cls.tell(f"{cls.count} {cls.steady:d}")


def supervised() -> bool:
    """Whether this process has a supervisor, who says what happens to it."""
    return _Connection.socket is not None


def note(*, steady: bool) -> None:
    """Something was done.

    Args:
        steady: whether the next thing will take about as long as this one did. It does not where a program is compiled
            next, or agents are evaluated.
    """
    _Connection.count, _Connection.steady = _Connection.count + 1, steady
    if not steady:
        _Connection.beat()  # what comes next may keep the other thread from it


def answer_supervisor() -> None:
    """Connects this process to its supervisor, if it has one.

    From here on its signals are told to the supervisor, who tells all processes at once: each would otherwise hear
    twice of what somebody sends to all of them, and a second signal ends a process.
    """
    number = os.environ.pop(SOCKET, None)  # it is not for the processes that this one starts
    if number is None:
        return
    _Connection.socket = supervisor = socket.socket(fileno=int(number))
    if sys.platform == "linux":  # a process that is stopped would not notice, and hear of no signal but this one
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    supervisor.settimeout(BEAT_SECONDS)
    signals.redirect(_Connection.tell)
    threading.Thread(target=_answer, args=(supervisor,), name="heartbeat", daemon=True).start()


def _answer(supervisor: socket.socket) -> None:
    while True:
        _Connection.beat()
        try:
            said = supervisor.recv(64).decode()
        except TimeoutError:
            continue
        except OSError:
            break
        if not said:
            break
        for name in said.split():
            signals.deliver(name)
    os._exit(signals.INTERRUPTED)
