"""Zone: Safety Gym's Point robot among coloured zones, and two variants of the peers."""

from __future__ import annotations

import functools

import envs_jax
from hrlspec.presets.preset import Preset
from hrlspec.presets.recipes import Recipe, Settings, continuous
from hrlspec.tasks.rewards import Bonus


def zone(settings: Settings, recipe: Recipe) -> Settings:
    """A robot with inertia: episodes of up to 1,000 steps, zones seen through a lidar."""
    settings = continuous(settings, learning_rate=7e-4).evolve(
        {
            "config.total_steps": 10_000_000,
            "config.discount": 0.998,
            "config.noise_correlation": 0.95,
            "config.network.encoder_mlp": (128, 128),
            "config.network.latent": 128,
            # No task of the curriculum has a fourth sub-task, so what lies three ahead would never be learned.
            "config.network.lookahead": 2,
            "config.curriculum.levels": 3,
            "config.curriculum.max_avoid": 2,
        }
    )
    return _of_paper(settings) if recipe == "paper" else settings


def _of_paper(settings: Settings) -> Settings:
    """Recipe paper, whose encoder does not know which colour is the goal: hard to learn in 4 M steps."""
    return settings.evolve(
        {
            # Each is busy with one task for many updates: among 128 tasks one seed of Option never got beyond single
            # goals, and ours and Myopic-low learned more slowly.
            "config.num_envs": 256,
            # With coloured noise the policy learns to be random, not where to go.
            "config.noise_correlation": 0.0,
            "config.low.entropy": 0.0,
            "config.low.optimiser.minibatches": 32,
            # With 32 it learned more slowly; so many may tell the task of each environment apart from all others.
            "config.network.task_features": 8,
        }
    )


def zone_with_bonuses(settings: Settings, recipe: Recipe) -> Settings:
    """Reward set 2, where orders of colours pay ten and twenty times as much as a sub-task."""
    # Beside the critic's errors what a step gains is small: paid for entropy, the policy came to act at random.
    return settings if recipe == "paper" else settings.evolve({"config.low.entropy": 0.0})


_BONUSES = (Bonus("green", "red", 10.0), Bonus("red", "blue", 20.0, ("yellow",)))
_LEARNING_RATES: dict[tuple[Recipe, str], float] = {
    ("paper", "ours"): 1.4e-3,
    ("paper", "option"): 1.4e-3,
    ("hrlspec", "ours"): 1.4e-3,
    ("hrlspec", "ltl2action"): 1.4e-3,
    ("hrlspec", "option"): 1.4e-3,
}


def _preset(name: str) -> Preset:
    return Preset(
        name,
        functools.partial(envs_jax.make, name),
        zone,
        zone_with_bonuses,
        bonuses=_BONUSES,
        learning_rates=_LEARNING_RATES,
    )


ZONE = _preset("zone")
ZONE_LTL2ACTION = _preset("zone-ltl2action")
ZONE_NM = _preset("zone-nm")
