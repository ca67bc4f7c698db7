"""Standard output and standard error that neither a reader who left, nor a full disk, nor an encoding can break.

What is shown must not stop what is computed and saved. So what cannot be written is dropped, and what cannot be encoded
is written as an escape.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO


class LastingStream:
    """A text stream that drops what cannot be written; other attributes are those of the stream behind it.

    Attributes:
        lost: why something was dropped, if so.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.lost: OSError | None = None
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Writes, or drops, all of the text."""
        with self._dropping():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Passes on what is buffered, or drops it."""
        with self._dropping():
            self._stream.flush()

    @contextlib.contextmanager
    def _dropping(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.lost = self.lost or error
            # What is still buffered must not fail again at exit.
            with contextlib.suppress(OSError):
                _to_nowhere(self._stream.fileno())


@contextlib.contextmanager
def lasting_streams() -> Iterator[LastingStream]:
    """While the context lasts both streams are there and last; yields standard output."""
    _open_closed()
    before = sys.stdout, sys.stderr
    out = LastingStream(sys.stdout)
    sys.stdout, sys.stderr = out, LastingStream(sys.stderr)
    try:
        yield out
    finally:
        sys.stdout, sys.stderr = before


def _open_closed() -> None:
    """Opens what the process was started without: the next file would take its number, and what is meant for it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            _to_nowhere(number)
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


def _to_nowhere(number: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)
