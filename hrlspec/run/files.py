"""Files that are replaced as a whole, so that no reader and no kill ever meets half of one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """A new file with the same ending beside a file, whose place it takes when the context ends in order."""
    new = file.with_name(f".{file.stem}.new{file.suffix}")
    try:
        yield new
        new.replace(file)
    finally:
        new.unlink(missing_ok=True)


def write_atomically(file: Path, text: str) -> None:
    """Replaces a file by a text, which is on the disk when this returns.

    Raises:
        OSError: it cannot be written; what was there before stays.
    """
    with replacing(file) as new, new.open("w", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
