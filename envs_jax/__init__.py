"""Environments with labels, as pure functions. They know nothing of tasks.

``make("letter")`` gives a preset; keyword arguments override its sizes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from envs_jax.base import (
    Box,
    ContestedChoice,
    ContestedLayouts,
    Discrete,
    Drawable,
    Environment,
    EnvParams,
    FiniteGraph,
    GridMap,
    Rearrangeable,
    Reflections,
    Symmetric,
    Symmetries,
    Thing,
)
from envs_jax.layouts import load_layouts, save_layouts
from envs_jax.letter.world import Letter, LetterState
from envs_jax.walk.world import Walk, WalkLayout, WalkState, flatworld

__all__ = [
    "Box",
    "ContestedChoice",
    "ContestedLayouts",
    "Discrete",
    "Drawable",
    "EnvParams",
    "Environment",
    "FiniteGraph",
    "GridMap",
    "Letter",
    "LetterState",
    "Rearrangeable",
    "Reflections",
    "Symmetric",
    "Symmetries",
    "Thing",
    "Walk",
    "WalkLayout",
    "WalkState",
    "load_layouts",
    "make",
    "registered",
    "save_layouts",
]


def _zone(name: str, **overrides: Any) -> Environment:
    """A preset of Zone. Its module is imported when first asked for: the others are quick to start."""
    from envs_jax.zone.world import PRESETS

    return PRESETS[name](**overrides)


def _point_mass(name: str, **overrides: Any) -> Environment:
    from envs_jax.zone.point_mass import PRESETS

    return PRESETS[name](**overrides)


def _conveyor(**sizes: Any) -> Environment:
    from envs_jax.conveyor.world import Conveyor

    return Conveyor(**sizes)


_REGISTRY: dict[str, Callable[..., Environment]] = {
    "letter": functools.partial(Letter, name="letter"),
    "letter12": functools.partial(Letter, name="letter12", num_letters=12, num_cells=24),
    "walk": functools.partial(Walk, name="walk"),
    "flatworld": flatworld,
    "zone": functools.partial(_zone, "zone"),
    "zone-ltl2action": functools.partial(_zone, "zone-ltl2action"),
    "zone-nm": functools.partial(_zone, "zone-nm"),
    "zone-jaxolotl": functools.partial(_point_mass, "zone-jaxolotl"),
    "zone-nm-jaxolotl": functools.partial(_point_mass, "zone-nm-jaxolotl"),
    "conveyor": functools.partial(_conveyor, name="conveyor"),
    "conveyor-simple": functools.partial(_conveyor, name="conveyor-simple", simple=True),
}


def registered() -> tuple[str, ...]:
    """Names that :func:`make` knows."""
    return tuple(_REGISTRY)


def make(name: str, **overrides: Any) -> Environment:
    """The environment of a preset.

    Args:
        name: one of :func:`registered`.
        **overrides: sizes that differ from the preset's, for example ``size=9``.

    Raises:
        ValueError: if the name or a size is unknown, or the sizes do not fit together.
    """
    if name not in _REGISTRY:
        raise ValueError(f"unknown environment {name!r}, expected one of: {', '.join(registered())}")
    try:
        return _REGISTRY[name](**overrides)
    except TypeError as error:
        raise ValueError(f"environment {name!r}: {error}") from error
