"""Presets, one file a world: everything that it needs to be trained, evaluated and drawn."""

from __future__ import annotations

from hrlspec.presets.conveyor import SERIES
from hrlspec.presets.generic import preset_for
from hrlspec.presets.letter import LETTER, LETTER12
from hrlspec.presets.preset import Preset, Split
from hrlspec.presets.recipes import RECIPES, Recipe, RewardSet
from hrlspec.presets.walk import FLATWORLD, WALK
from hrlspec.presets.zone import ZONE, ZONE_JAXOLOTL, ZONE_LTL2ACTION, ZONE_NM, ZONE_NM_JAXOLOTL

__all__ = [
    "KNOWN",
    "PRESETS",
    "RECIPES",
    "Preset",
    "Recipe",
    "RewardSet",
    "Split",
    "find_preset",
    "preset",
    "preset_for",
]

PRESETS: dict[str, Preset] = {
    some.name: some
    for some in (
        LETTER,
        LETTER12,
        WALK,
        FLATWORLD,
        ZONE,
        ZONE_LTL2ACTION,
        ZONE_NM,
        ZONE_JAXOLOTL,
        ZONE_NM_JAXOLOTL,
    )
}
"""The presets by name."""


KNOWN = ", ".join([*PRESETS, *(f"{series}-K (K items)" for series in SERIES)])
"""What `preset` knows, in words."""


def find_preset(name: str) -> Preset | None:
    """A preset by its name, ``None`` if there is none.

    Raises:
        ValueError: its number is out of range.
    """
    series, _, number = name.rpartition("-")
    if series not in SERIES or not number.isdecimal():
        return PRESETS.get(name)
    try:
        return SERIES[series](int(number))
    except ValueError as error:
        raise ValueError(f"environment {name!r}: {error}") from None


def preset(name: str) -> Preset:
    """A preset by its name.

    Raises:
        ValueError: there is none, and the message lists those there are; or its number is out of range.
    """
    found = find_preset(name)
    if found is None:
        raise ValueError(f"unknown environment {name!r}, expected one of: {KNOWN}")
    return found
