"""Conveyor: as many items as one likes before the last, which alone says where to go at the start."""

from __future__ import annotations

import functools

from envs_jax.conveyor.world import Conveyor
from hrlspec.presets.preset import Preset
from hrlspec.presets.recipes import Recipe, Settings


def conveyor(series: str, k: int) -> Preset:
    """A world of the peers: ``conveyor-simple-8`` is one column with 8 items each way.

    Its tasks are two chains that differ in the last item. They are all that is collected on, beside what relabelling
    makes of them: nothing is held out, and the peers hold out nothing either.

    Args:
        series: ``conveyor`` or ``conveyor-simple``.
        k: items of a corridor.

    Raises:
        ValueError: k is out of range.
    """
    name = f"{series}-{k}"
    make = functools.partial(Conveyor, k=k, simple=series == "conveyor-simple", name=name)
    *items, below, above = make().propositions
    chains = tuple("; ".join(f"achieve {item}" for item in (*items, last)) for last in (below, above))

    def fit(settings: Settings, recipe: Recipe) -> Settings:
        del recipe
        return settings.evolve(
            {
                "config.total_steps": 500_000,
                # The end of the longest chain is 41 steps away.
                "config.discount": 0.97,
                "config.curriculum.levels": 1,
                "config.curriculum.max_avoid": 0,
                "config.curriculum.max_nodes": max(settings.config.curriculum.max_nodes, k + 4),
                # The last item must be seen from the start.
                "config.network.lookahead": k,
                "config.network.task_rounds": 0,
                "config.relabel.share": 0.5,
            }
        )

    return Preset(name, make, fit, texts={"dag": "\n".join(chains)}, collected=chains, compiled_with="least")


SERIES = {series: functools.partial(conveyor, series) for series in ("conveyor", "conveyor-simple")}
"""Worlds that are named by a number."""
