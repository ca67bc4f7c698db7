"""Figures as files: the same figure gives the same bytes."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from hrlspec.run.files import replacing


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
