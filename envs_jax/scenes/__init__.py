"""What environments look like, for pictures and animations; matplotlib is imported only when one is drawn."""

from __future__ import annotations

from envs_jax.scenes.base import PATH_COLORS, Leg, Scene

__all__ = ["PATH_COLORS", "Leg", "Scene"]
