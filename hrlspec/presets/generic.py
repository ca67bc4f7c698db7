"""A preset for an environment that nobody tuned: settings by its spaces, and test tasks drawn from a seed."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from envs_jax import Box, Environment
from hrlspec.evaluation import Suite, suite_from_trees
from hrlspec.evaluation.cases import LAYOUTS_PER_TASK, draw_layouts, task_of
from hrlspec.exact.steps import step_solver
from hrlspec.presets.preset import Preset
from hrlspec.presets.recipes import Recipe, Settings, continuous
from hrlspec.presets.suite_rules import DAG, draw_suite, seed_of_suite, with_validation
from hrlspec.presets.suites import commented

WIDE = 64
"""Numbers in a view from which on the latent has twice as many as Letter's."""

_FAR_GOALS = {
    # Walk as if nobody had tuned it, one seed, success on unseen tasks after 1 M steps: 0.41 with noise that begins at
    # 0.95 and fades to white, 0.96 with this, 0.98 with the three settings below besides; these alone 0.88.
    "config.noise_correlation": 0.98,
    "config.final_noise_correlation": 0.98,
    "config.low.gae_lambda": 0.98,
    "config.relabel.share": 0.5,
    "config.curriculum.promotion": 0.6,
}
"""What worlds need whose goals are many small steps away."""


def preset_for(env: Environment) -> Preset:
    """Letter's settings for discrete actions, those of small steps for continuous ones, fitted to the environment.

    Of its horizon H: the discount, 1 - 3 / H, within 0.9 and 0.998. Of its P propositions: no levels above the first
    where there is one alone, and at most P - 2 propositions to avoid. Of its view: the latent's width.
    """

    def fit(settings: Settings, recipe: Recipe) -> Settings:
        del recipe
        box = isinstance(env.action_space, Box)
        if box:
            settings = continuous(settings, learning_rate=1e-3).evolve(_FAR_GOALS)
        config = settings.config
        view = jax.eval_shape(env.proposition_view, jax.ShapeDtypeStruct(env.observation_shape, "float32"))
        numbers = sum(part.size for part in view)
        return settings.evolve(
            {
                "config.discount": min(max(1 - 3 / env.horizon, 0.9), 0.998),
                "config.network.latent": config.network.latent * (2 if box and numbers > WIDE else 1),
                "config.curriculum.levels": config.curriculum.levels if env.num_propositions > 1 else 1,
                "config.curriculum.max_avoid": max(0, min(config.curriculum.max_avoid, env.num_propositions - 2)),
            }
        )

    return Preset(env.name, lambda: env, fit, compiled_with="least")


def unseen_tasks(env: Environment, seed: int) -> dict[str, str]:
    """Texts of a test suite and a validation suite by name: random trees like those of the other worlds' ``dag``.

    200 tasks of depth 2, 3 and 4; fewer where P is so small that there are few, of each depth at most a quarter of
    those there are. Tasks of one sub-task are never among them. With one proposition there is only one task, which
    cannot be kept from training: both suites are that task. Where there is an exact solver, tasks that can rarely be
    satisfied within the horizon are left out.

    Raises:
        ValueError: no task is left.
    """
    (first, *others), rule = env.propositions, dataclasses.replace(DAG, scarce=True)
    texts, taken = {}, np.zeros(0, np.uint32)
    for name in with_validation({"dag": rule}):
        where = f"{env.name}/{name}"
        if not others:
            texts[name] = commented([f"{where}: the only task there is, and so not unseen"], [f"achieve {first}"])
            continue
        rng = np.random.default_rng([seed, seed_of_suite(env.name, name)])
        trees = draw_suite(rng, rule, env.num_propositions, taken, where)
        suite = _possible(env, suite_from_trees(name, trees, env.propositions))
        about = f"{rule.about}; fewer of a depth where there are few"
        comments = [f"{where}: {len(suite)} unseen tasks, drawn with seed {seed}", about]
        texts[name] = commented(comments, suite.formulas)
        taken = suite.hashes
    return texts


def _possible(env: Environment, suite: Suite) -> Suite:
    """The tasks that can be satisfied within the horizon in a third of all layouts, as far as that is known."""
    solve = step_solver(env, draw_layouts(env, suite, LAYOUTS_PER_TASK))
    if solve is None:
        return suite
    starts = np.arange(len(suite)) * LAYOUTS_PER_TASK
    steps = [solve(slice(at, at + LAYOUTS_PER_TASK), task_of(suite, row)).optimum for row, at in enumerate(starts)]
    possible = (np.array(steps) <= env.horizon).mean(-1) >= 1 / 3
    if not possible.any():
        raise ValueError(f"{env.name}: none of {len(suite)} random tasks can be satisfied within {env.horizon} steps")
    return suite.take(np.flatnonzero(possible))
