"""Optional libraries: what is missing is said before anything begins that needs it, and what they raise in one line."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator

from hrlspec.run.errors import UserError, in_words


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """What cannot be drawn becomes one line: a library is missing or refuses its settings, the disk is full.

    Raises:
        UserError: in place of any exception.
    """
    try:
        yield
    except ImportError as error:
        raise UserError(f'no pictures without the extra "plot": pip install "hrlspec[plot]" ({error})') from error
    except Exception as error:  # whatever the drawing library raises
        raise UserError(f"no picture: {in_words(error)}") from error


def check_drawing() -> None:
    """Loads the drawing library.

    Raises:
        UserError: it is missing, or refuses its settings.
    """
    with drawing():
        importlib.import_module("hrlspec.run.plots")
