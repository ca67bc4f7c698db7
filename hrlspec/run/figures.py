"""Figures as files: the same figure gives the same bytes, and no reader ever meets half of one."""

from __future__ import annotations

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
    temporary = file.with_name(f".{file.name}.new")
    kind = file.suffix.removeprefix(".")
    try:
        # Neither the drawing library's version, nor the date, nor names drawn at random.
        with rc_context({"svg.hashsalt": file.stem}):
            figure.savefig(temporary, format=kind, dpi=110, metadata={"Date" if kind == "svg" else "Software": None})
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)
    return file
