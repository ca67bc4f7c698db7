"""Optional libraries: what is missing is said before anything begins that needs it, and what they raise in one line."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from hrlspec.run.errors import UserError, in_words
from hrlspec.run.folder import check_file

PICTURES = (".png", ".svg")
"""Endings of the files in which a picture can be."""


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


def check_picture(flag: str, file: Path, endings: Sequence[str]) -> None:
    """Refuses a picture that could not be written or drawn.

    Args:
        flag: what asks for it.
        file: the picture.
        endings: of files, each another format.

    Raises:
        UserError: it ends in none of them, or is a folder, or cannot be made, or a library is missing.
    """
    check_file(flag, file, endings)
    check_drawing()
    if file.suffix == ".mp4":
        _check_video()


def _check_video() -> None:
    """Looks for the encoder of videos."""
    try:
        importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()
    except ImportError as error:
        raise UserError('videos (.mp4) need the extra "video": pip install "hrlspec[video]"') from error
    except RuntimeError as error:
        raise UserError(f"no encoder of videos (.mp4): {in_words(error)}") from error


def check_wandb() -> None:
    """Loads the library of Weights & Biases.

    Raises:
        UserError: it is missing, or cannot be used.
    """
    try:
        # A folder that W&B has left here, named wandb, is to Python a module without anything in it.
        if importlib.import_module("wandb").__file__ is None:
            raise ImportError("a folder, not the library")
    except ImportError as error:
        raise UserError('--wandb needs the extra "wandb": pip install "hrlspec[wandb]"') from error
    except Exception as error:  # as where a library that it needs is too old
        raise UserError(f"--wandb: the library cannot be used: {in_words(error)}") from error


def check_ray() -> None:
    """Loads the library Ray.

    Raises:
        UserError: it is missing, or cannot be used.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # it tells nobody that it is used
    try:
        importlib.import_module("ray")
    except ImportError as error:
        raise UserError('--ray needs the extra "ray": pip install "hrlspec[ray]"') from error
    except Exception as error:  # as where a library that it needs is too old
        raise UserError(f"--ray: the library cannot be used: {in_words(error)}") from error
