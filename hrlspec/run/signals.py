"""Turns Ctrl-C and SIGTERM into a flag that is polled where stopping is safe.

Inside a jitted chunk nothing can be stopped, and between two writes nothing should be: the loop asks between
iterations, saves, and leaves. A second signal does not wait.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Whether somebody asked the process to stop.

    Attributes:
        signal_name: ``SIGINT`` or ``SIGTERM`` once asked, else ``None``.
    """

    def __init__(self) -> None:
        self.signal_name: str | None = None

    def __bool__(self) -> bool:
        return self.signal_name is not None


@contextlib.contextmanager
def polled_signals() -> Iterator[StopRequest]:
    """While the context lasts the first SIGINT or SIGTERM sets the flag; the second raises ``KeyboardInterrupt``.

    The handlers that were there before come back afterwards. Signals reach the main thread alone, so in any other
    thread nothing is installed and the flag stays unset.

    Example:
        >>> with polled_signals() as stop:
        ...     while not stop:
        ...         break  # one iteration
    """
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, frame: FrameType | None) -> None:
        del frame
        if stop:
            raise KeyboardInterrupt
        stop.signal_name = signal.Signals(number).name

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
