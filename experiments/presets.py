"""Tuned configurations, a comment for each deviation from the defaults, and the environments' reward sets."""

from __future__ import annotations

import dataclasses

import envs_jax
from hrlspec.config import Config
from hrlspec.rewards import Bonus, RewardMachine, reward_machine

# Letter's order bonuses (paper, "Reward Function of Subgoals").
_BONUSES = (Bonus("a", "d", 5.0), Bonus("b", "e", 10.0, ("a",)))


def preset(env_name: str, recipe: str, reward_set: int, method: str) -> Config:
    """The configuration of a run unless told otherwise.

    Args:
        env_name: one of ``envs_jax.registered()``.
        recipe: ``paper`` or ``hrlspec``.
        reward_set: 1 or 2.
        method: ``ours``, ``myopic-low`` or ``no-er``.
    """
    del env_name
    config = Config()
    if recipe == "hrlspec":
        config = dataclasses.replace(
            config, unfinished=True, curriculum=dataclasses.replace(config.curriculum, tree_share=0.5)
        )
    if reward_set == 2:
        config = dataclasses.replace(config, value_scale=10.0)  # returns reach 20
    if method == "myopic-low":
        config = dataclasses.replace(config, future_embedding=False)
    if method == "no-er":
        config = dataclasses.replace(config, relabel=dataclasses.replace(config.relabel, share=0.0))
    return config


def rewards_of(env_name: str, reward_set: int) -> RewardMachine:
    """The rewards of a reward set: 1 for completion; in set 2 also for sub-tasks and for orders of letters."""
    propositions = envs_jax.make(env_name).propositions
    if reward_set == 1:
        return reward_machine(propositions)
    return reward_machine(propositions, subtask=1.0, bonuses=_BONUSES)
