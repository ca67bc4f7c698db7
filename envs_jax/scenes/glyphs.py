"""Letters and colours of pictures: enough to tell propositions apart without a font library."""

from __future__ import annotations

import colorsys

import numpy as np

INK = (30, 30, 34)
BACKGROUND = (250, 250, 248)
LINE = (205, 205, 200)

# One octal digit is a row of three pixels, five rows from the top.
_GLYPHS = dict(
    zip(
        "abcdefghijklmnopqrstuvwxyz",
        "25755 65656 34443 65556 74647 74644 34553 55755 72227 11152 55655 44447 57755 "
        "65555 25552 65644 25563 65655 34216 72222 55557 55522 55775 55255 55222 71247".split(),
        strict=True,
    )
)
_COLORS = {
    "aqua": (80, 205, 215),
    "blue": (88, 130, 235),
    "cyan": (80, 205, 215),
    "green": (95, 190, 100),
    "magenta": (222, 92, 200),
    "orange": (245, 160, 70),
    "purple": (150, 100, 205),
    "red": (232, 88, 80),
    "yellow": (240, 215, 75),
}


def own_color(name: str) -> tuple[int, int, int] | None:
    """Red, green and blue of a name that is a colour's."""
    return _COLORS.get(name)


def color_of(name: str) -> tuple[int, int, int]:
    """Red, green and blue of a proposition: the name's own if it is a colour, else one for its first letter.

    Hues are spread by the golden ratio, so that neighbours in the alphabet differ.
    """
    if (own := own_color(name)) is not None:
        return own
    letter = ord(name[0].lower()) - ord("a")
    red, green, blue = colorsys.hsv_to_rgb((0.02 + letter * 0.618034) % 1.0, 0.45, 0.93)
    return round(red * 255), round(green * 255), round(blue * 255)


def glyph(name: str, pixels: int) -> np.ndarray:
    """A name's first letter in the middle of a square, bool ``[pixels, pixels]``; empty if it is not from a to z."""
    image = np.zeros((pixels, pixels), bool)
    code = _GLYPHS.get(name[0].lower())
    if code is None:
        return image
    small = np.array([[int(digit) >> shift & 1 for shift in (2, 1, 0)] for digit in code], bool)
    scale = max(1, pixels // 12)
    large = np.kron(small, np.ones((scale, scale), bool))
    top, left = (pixels - large.shape[0]) // 2, (pixels - large.shape[1]) // 2
    image[top : top + large.shape[0], left : left + large.shape[1]] = large
    return image
