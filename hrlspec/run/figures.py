"""Pictures as files: the same figure gives the same bytes, and no reader ever meets half of one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure


def save(figure: Figure, file: Path) -> Path:
    """Writes a figure, replacing an earlier one as a whole.

    Args:
        figure: what to write.
        file: its ending says in which format.

    Raises:
        OSError: it cannot be written; an earlier one stays.
    """
    metadata = {"Date" if file.suffix == ".svg" else "Software": None}
    # Neither the drawing library's version, nor the date, nor names drawn at random.
    with replacing(file) as new, rc_context({"svg.hashsalt": file.stem}):
        figure.savefig(new, dpi=110, metadata=metadata)
    return file


@contextlib.contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """A file with the same ending beside it, which takes its place when the context ends without an exception."""
    new = file.with_name(f".{file.stem}.new{file.suffix}")
    try:
        yield new
        new.replace(file)
    finally:
        new.unlink(missing_ok=True)
