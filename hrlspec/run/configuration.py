"""Configurations of runs in terms of JSON: their hash, and in what two of them differ."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np


def config_hash(config: Mapping[str, Any]) -> str:
    """SHA-256 of a configuration, the same for every order of its entries."""
    return hashlib.sha256(json.dumps(plain(config), sort_keys=True).encode()).hexdigest()


def differences(there: Any, here: Any) -> dict[str, tuple[Any, Any]]:
    """Settings in which two configurations differ, by dotted names in their order: the value there, the value here."""
    old, new = dotted(plain(there)), dotted(plain(here))
    return {
        name: (old.get(name, "nothing"), new.get(name, "nothing"))
        for name in sorted(old.keys() | new.keys())
        if old.get(name) != new.get(name)
    }


def dotted(config: Any, prefix: str = "") -> dict[str, Any]:
    """Nested entries under dotted names, such as ``config.low.clip``; lists are values."""
    if not isinstance(config, dict) or not config:
        return {prefix: config}
    return {
        name: value
        for key, inner in config.items()
        for name, value in dotted(inner, f"{prefix}.{key}" if prefix else key).items()
    }


def plain(value: Any) -> Any:
    """The value in terms of JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"a {type(value).__name__} has no form in JSON: {value!r}")
