"""What environments look like, for pictures and animations; matplotlib is imported only when one is drawn."""

from __future__ import annotations

from envs_jax.scenes.base import PATH_COLORS, Leg, Outline, Scene, Shape
from envs_jax.scenes.discs import DiscScene, Region
from envs_jax.scenes.grid import GridScene

__all__ = ["PATH_COLORS", "DiscScene", "GridScene", "Leg", "Outline", "Region", "Scene", "Shape"]
