"""The worlds of the paper's two motivating examples, small enough to be learned in a minute."""

from __future__ import annotations

import functools

from envs_jax import Walk
from envs_jax.rooms.world import Rooms
from hrlspec.presets.letter import LETTER
from hrlspec.presets.preset import Preset
from hrlspec.presets.recipes import Recipe, Settings
from hrlspec.presets.walk import WALK, walk, walk_with_bonuses


def _rooms(settings: Settings, recipe: Recipe) -> Settings:
    del recipe
    return _small(settings).evolve(
        {
            "config.curriculum.levels": 2,  # two colours make no longer tasks
            "config.network.symmetric": False,  # turning the rooms would move their doors
            "config.discount": 0.95,
        }
    )


def _dilemma(settings: Settings, recipe: Recipe) -> Settings:
    settings = _small(walk(settings, recipe))
    settings = settings.evolve({"config.curriculum.levels": 3, "config.network.symmetric": False})
    if recipe != "hrlspec":
        return settings
    return settings.evolve(
        {
            # a lies in front of b, and is walked into by agents that mean to go to b: around it leads a way that has to
            # be learned from the position alone, and that noise must not find for the policy.
            "config.network.chart": (64, 64, 16),
            "config.final_noise_correlation": 0.0,
        }
    )


def _small(settings: Settings) -> Settings:
    """Small worlds, and small runs: many updates, and noise that does not end at the walls."""
    return settings.evolve(
        {
            "config.num_envs": 128,
            "config.noise_correlation": 0.95,
            "config.final_noise_correlation": 0.95,
            "config.low.optimiser.minibatches": 16,
            # The ball behind the locked door is found by chance, and rarely: what is found teaches in hindsight, and
            # tasks that are mastered wait for no other.
            "config.relabel.hindsight": True,
            "config.curriculum.promotion": 0.7,
            "config.curriculum.contested": 0.0,
            "config.curriculum.tasks_per_level": 64,
        }
    )


ROOMS = Preset("rooms", Rooms, _rooms, learning_rates=LETTER.learning_rates, compiled_with="least")
DILEMMA = Preset(
    "dilemma",
    # The way to b leads past a, and reaching a ends the task before c, which pays most, can be reached.
    functools.partial(
        Walk,
        discs=(("a", 2.2, 1.0, 0.7), ("b", 4.6, 2.2, 0.7), ("c", 7.6, 2.4, 0.7), ("d", 6.2, 0.9, 0.7)),
        low=-1.0,
        high=9.0,
        step_size=0.2,
        horizon=200,
        name="dilemma",
    ),
    _dilemma,
    walk_with_bonuses,
    learning_rates=WALK.learning_rates,
    compiled_with="least",
)
