"""Commands that work on the project's own records and pages, and so need a checkout of it."""

from __future__ import annotations

from pathlib import Path

from hrlspec.run.errors import UserError

_PARTS = ("experiments/reproduce.py", "results/paper", "docs")


def check_checkout(command: str, folder: Path | None = None) -> None:
    """Refuses to go on anywhere but in the root folder of a checkout.

    Args:
        command: what the user called, such as ``reproduce``.
        folder: the current one if not given.

    Raises:
        UserError: the folder is not a checkout; an installed package is none.
    """
    root = (folder or Path()).resolve()
    missing = [part for part in _PARTS if not (root / part).exists()]
    if missing:
        raise UserError(
            f"{command} works on the records and pages of a checkout of hrlspec, and {root} has no {missing[0]}: "
            f"clone the repository and run {command} in its root folder"
        )
