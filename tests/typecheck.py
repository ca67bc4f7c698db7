"""Shapes and types of all functions and structs of the packages, checked while tests run.

``install()`` must come before the packages are imported. A function is checked whenever it is called or traced. A
struct is checked where our own code makes one: JAX makes them too, around whatever stands for a leaf.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from typing import Any

import flax.struct
import jax
import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype
from beartype.door import is_bearable

PACKAGES = ("envs_jax", "hrlspec")
CHECKED = (
    # Adapters take what others wrote and check it themselves, which is tested with what does not fit.
    *(f"envs_jax.{name}" for name in ("base", "layouts", "letter", "rooms", "walk", "zone")),
    *(f"hrlspec.{name}" for name in ("agent", "api", "evaluation", "exact", "learning", "methods", "tasks")),
    # The rest of the language is text and syntax trees, whose own checks are tested with what is no such thing.
    *(f"hrlspec.spec.{name}" for name in ("hashing", "monitor", "tree")),
)
"""Packages and modules that hold arrays."""

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked(function: Any) -> Any:
    """Checks a function; not the making of an environment, which holds no arrays and refuses wrong sizes itself."""
    makes_environment = function.__module__.startswith("envs_jax") and function.__qualname__.endswith("__init__")
    return function if makes_environment else _beartype(function)


def install() -> None:
    """Checks all that is imported of the packages from now on."""
    jaxtyping.install_import_hook(list(CHECKED), f"{__name__}.checked")
    flax.struct.dataclass = _checked_struct(flax.struct.dataclass)


def _checked_struct(decorate: Any) -> Any:
    @functools.wraps(decorate)
    def struct(cls: Any = None, **options: Any) -> Any:
        if cls is None:
            return functools.partial(struct, **options)
        made = decorate(cls, **options)
        if not made.__module__.startswith(PACKAGES):
            return made
        made.__no_type_check__ = True  # by jaxtyping, which would refuse what JAX makes
        init = made.__init__

        @functools.wraps(init)
        def checked_init(self: Any, *args: Any, **kwargs: Any) -> None:
            init(self, *args, **kwargs)
            # What compiled functions return JAX makes in their caller's name; `api` calls those of many seeds.
            maker = sys._getframe(1).f_globals.get("__name__", "")
            if maker.startswith((*PACKAGES, "dataclasses")) and maker != "hrlspec.api":
                check(self)

        made.__init__ = checked_init
        return made

    return struct


def check(struct: Any) -> None:
    """Raises ``TypeError`` unless the fields of a struct that hold arrays have the shapes and types it says."""
    with jaxtyping.jaxtyped("context"):
        for name, hint in _hints(type(struct)).items():
            value = getattr(struct, name)
            if isinstance(value, jax.Array | np.ndarray) and not is_bearable(value, hint):
                found = f"{value.dtype}{list(value.shape)}"
                raise TypeError(f"{type(struct).__name__}.{name} is {found}, expected {hint}")


@functools.cache
def _hints(cls: type) -> dict[str, Any]:
    """Types of the fields; `typing.get_type_hints` gives none of a class that is not to be checked."""
    names = vars(sys.modules[cls.__module__])
    return {field.name: eval(str(field.type), names) for field in dataclasses.fields(cls)}
