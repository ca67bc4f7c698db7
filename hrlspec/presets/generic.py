"""A preset for an environment that nobody tuned: settings by its spaces."""

from __future__ import annotations

import jax

from envs_jax import Box, Environment
from hrlspec.presets.preset import Preset
from hrlspec.presets.recipes import Recipe, Settings, continuous

WIDE = 64
"""Numbers in a view from which on the latent has twice as many as Letter's."""


def preset_for(env: Environment) -> Preset:
    """Letter's settings for discrete actions, those of small steps for continuous ones, fitted to the environment.

    Of its horizon H: the discount, 1 - 3 / H, within 0.9 and 0.998. Of its P propositions: no levels above the first
    where there is one alone, and at most P - 2 propositions to avoid. Of its view: the latent's width.
    """

    def fit(settings: Settings, recipe: Recipe) -> Settings:
        del recipe
        box = isinstance(env.action_space, Box)
        if box:
            settings = continuous(settings, learning_rate=1e-3)
        config = settings.config
        view = jax.eval_shape(env.proposition_view, jax.ShapeDtypeStruct(env.observation_shape, "float32"))
        numbers = sum(part.size for part in view)
        return settings.evolve(
            {
                "config.discount": min(max(1 - 3 / env.horizon, 0.9), 0.998),
                "config.noise_correlation": 0.95 if box else 0.0,
                "config.network.latent": config.network.latent * (2 if box and numbers > WIDE else 1),
                "config.curriculum.levels": config.curriculum.levels if env.num_propositions > 1 else 1,
                "config.curriculum.max_avoid": max(0, min(config.curriculum.max_avoid, env.num_propositions - 2)),
            }
        )

    return Preset(env.name, lambda: env, fit, quick_compile=True)
