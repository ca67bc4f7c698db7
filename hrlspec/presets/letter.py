"""Letter: the paper's grid of letters, and the larger one of the published baselines."""

from __future__ import annotations

import functools

import envs_jax
from hrlspec.presets.preset import Preset
from hrlspec.presets.recipes import Recipe, Settings
from hrlspec.tasks.rewards import Bonus

# The paper gives none for twelve letters; these serve there too.
_BONUSES = (Bonus("a", "d", 5.0), Bonus("b", "e", 10.0, ("a",)))
_LEARNING_RATES: dict[tuple[Recipe, str], float] = {
    ("paper", "ours"): 2e-3,
    ("paper", "ltl2action"): 2e-3,
    ("paper", "option"): 2e-3,
    ("hrlspec", "ltl2action"): 3.5e-4,
    ("hrlspec", "option"): 1.4e-3,
}


def _twelve(settings: Settings, recipe: Recipe) -> Settings:
    """Twelve letters: more to tell apart, and no longer tasks. Longer ones are for the evaluation."""
    del recipe
    return settings.evolve({"config.total_steps": 6_000_000})


LETTER = Preset(
    "letter",
    functools.partial(envs_jax.make, "letter"),
    bonuses=_BONUSES,
    learning_rates=_LEARNING_RATES,
    quick_compile=True,
)
LETTER12 = Preset(
    "letter12", functools.partial(envs_jax.make, "letter12"), _twelve, bonuses=_BONUSES, quick_compile=True
)
