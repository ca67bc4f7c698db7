"""Pictures of Letter: RGB arrays and text. Plain numpy; meant for people, not for the hot path."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable
from typing import Any

import numpy as np

# One octal digit is a row of three pixels, five rows from the top: enough to tell letters apart without a font library.
_GLYPHS = dict(
    zip(
        "abcdefghijklmnopqrstuvwxyz",
        "25755 65656 34443 65556 74647 74644 34553 55755 72227 11152 55655 44447 57755 "
        "65555 25552 65644 25563 65655 34216 72222 55557 55522 55775 55255 55222 71247".split(),
        strict=True,
    )
)
_BACKGROUND = (250, 250, 248)
_LINE = (205, 205, 200)
_AGENT = (30, 30, 34)
_SMALLEST_CELL = 10


def letter_color(letter: int) -> tuple[int, int, int]:
    """The colour of a letter's cells: hues spread by the golden ratio, so that neighbours in the alphabet differ."""
    red, green, blue = colorsys.hsv_to_rgb((0.02 + letter * 0.618034) % 1.0, 0.45, 0.93)
    return round(red * 255), round(green * 255), round(blue * 255)


def rgb(layout: Any, position: Any, *, trail: Iterable[Any] = (), cell_pixels: int = 32) -> np.ndarray:
    """Draws the grid, the agent as a disc, and dots in the corners of the cells where it has been.

    Args:
        layout: int ``[n, n]``, -1 for no letter.
        position: int ``[2]``, row and column of the agent.
        trail: earlier positions, each int ``[2]``.
        cell_pixels: side of a cell, at least 10.

    Returns:
        uint8 ``[n · cell_pixels, n · cell_pixels, 3]``.

    Raises:
        ValueError: if the layout is not square, the agent is outside, or cells are too small to draw.
    """
    cells, row, column = _checked(layout, position)
    if cell_pixels < _SMALLEST_CELL:
        raise ValueError(f"cell_pixels is {cell_pixels}, expected at least {_SMALLEST_CELL}")
    size = cells.shape[0]
    image = np.empty((size, size, cell_pixels, cell_pixels, 3), np.uint8)
    image[:] = _BACKGROUND
    for i, j in np.argwhere(cells >= 0):
        letter = int(cells[i, j])
        image[i, j] = letter_color(letter)
        glyph = _glyph(letter, cell_pixels)
        image[i, j][glyph] = _AGENT
    offset = (np.arange(cell_pixels) - (cell_pixels - 1) / 2) / cell_pixels
    radius = np.hypot(offset[:, None], offset[None, :])
    corner = np.hypot(offset[:, None] - 0.32, offset[None, :] - 0.32)
    for visited in trail:
        i, j = np.asarray(visited) % size
        image[i, j][corner < 0.09] = _AGENT
    image[row, column][(radius < 0.42) & (radius > 0.30)] = _AGENT
    image[:, :, 0, :] = _LINE
    image[:, :, :, 0] = _LINE
    return image.transpose(0, 2, 1, 3, 4).reshape(size * cell_pixels, size * cell_pixels, 3)


def ansi(layout: Any, position: Any, *, color: bool = False) -> str:
    """Draws the grid as text: a letter or a dot for each cell, the agent's cell in brackets.

    Args:
        layout: int ``[n, n]``, -1 for no letter.
        position: int ``[2]``, row and column of the agent.
        color: whether to colour the letters with ANSI escape sequences.

    Raises:
        ValueError: if the layout is not square or the agent is outside.
    """
    cells, row, column = _checked(layout, position)
    lines = []
    for i, letters in enumerate(cells):
        line = []
        for j, letter in enumerate(letters):
            mark = chr(ord("a") + letter) if letter >= 0 else "."
            mark = f"[{mark}]" if (i, j) == (row, column) else f" {mark} "
            if color and letter >= 0:
                red, green, blue = letter_color(int(letter))
                mark = f"\x1b[30;48;2;{red};{green};{blue}m{mark}\x1b[0m"
            line.append(mark)
        lines.append("".join(line))
    return "\n".join(lines)


def _glyph(letter: int, cell_pixels: int) -> np.ndarray:
    """The letter in the middle of a cell, bool ``[cell_pixels, cell_pixels]``."""
    code = _GLYPHS[chr(ord("a") + letter)]
    small = np.array([[int(digit) >> shift & 1 for shift in (2, 1, 0)] for digit in code], bool)
    scale = max(1, cell_pixels // 12)
    large = np.kron(small, np.ones((scale, scale), bool))
    glyph = np.zeros((cell_pixels, cell_pixels), bool)
    top, left = (cell_pixels - large.shape[0]) // 2, (cell_pixels - large.shape[1]) // 2
    glyph[top : top + large.shape[0], left : left + large.shape[1]] = large
    return glyph


def _checked(layout: Any, position: Any) -> tuple[np.ndarray, int, int]:
    """The layout as numpy and the agent's row and column, or ``ValueError``."""
    cells = np.asarray(layout)
    if cells.ndim != 2 or cells.shape[0] != cells.shape[1]:
        raise ValueError(f"a layout of shape {cells.shape} was found, expected [n, n]")
    where = np.asarray(position)
    if where.shape != (2,) or not ((where >= 0) & (where < cells.shape[0])).all():
        raise ValueError(f"the agent is at {where.tolist()}, expected row and column from 0 to {cells.shape[0] - 1}")
    return cells, int(where[0]), int(where[1])
