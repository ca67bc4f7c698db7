"""TensorBoard's event files, written row by row: no thread, and nothing that stays open or is written at exit."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from tensorboardX.proto import event_pb2, summary_pb2
from tensorboardX.record_writer import masked_crc32c


class EventFile:
    """A new event file.

    Args:
        folder: where it goes; made if missing.
        purge_step: TensorBoard is to forget what earlier files of the folder say of this step and later ones.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, folder: Path, purge_step: int | None) -> None:
        folder.mkdir(exist_ok=True)
        number = len(list(folder.iterdir()))  # else two within a second share a file
        self._file = folder / f"events.out.tfevents.{time.time():.0f}.{socket.gethostname()}.{number}"
        self._lost = False
        events = [_event(file_version="brain.Event:2")]
        if purge_step is not None:
            start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
            events.append(_event(step=purge_step, session_log=start))
        self._file.write_bytes(b"".join(events))

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Adds numbers under their names. Once that has failed nothing more is added: half a record ends a file."""
        numbers = [summary_pb2.Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        event = _event(step=step, summary=summary_pb2.Summary(value=numbers))
        if not self._lost:
            try:
                with self._file.open("ab") as stream:
                    stream.write(event)
            except OSError:
                self._lost = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        """Nothing is left to do: each record was written when it was added."""


def _event(**parts: Any) -> bytes:
    """An event as a record of its file."""
    content = event_pb2.Event(wall_time=time.time(), **parts).SerializeToString()
    length = struct.pack("<Q", len(content))
    return b"".join([length, _checksum(length), content, _checksum(content)])


def _checksum(content: bytes) -> bytes:
    return struct.pack("<I", masked_crc32c(content))
