"""The recipes: settings before they are fitted to a world. Comments say what differs from the paper, and why."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any, Literal

from hrlspec.config import Config, NetworkConfig, evolve
from hrlspec.methods import ImplicitPlanner

Recipe = Literal["paper", "planner", "hrlspec"]
RECIPES: tuple[Recipe, ...] = typing.get_args(Recipe)
RewardSet = Literal[1, 2]


@dataclasses.dataclass(frozen=True)
class Settings:
    """What a recipe says: the settings that all methods share, and those of the planner."""

    config: Config
    planner: ImplicitPlanner

    def evolve(self, changes: Mapping[str, Any]) -> Settings:
        """A copy with changes, by names such as ``config.low.clip`` and ``planner.transe``."""
        return evolve(self, changes)


def recipe(name: Recipe) -> Settings:
    """The settings of a recipe for a small world of discrete actions: Letter's."""
    return {"paper": _PAPER, "planner": _PLANNER, "hrlspec": _HRLSPEC}[name]


def with_bonuses(settings: Settings, name: Recipe) -> Settings:
    """Reward set 2, where a sub-task after the right others pays ten times as much as alone."""
    config = settings.config
    settings = settings.evolve(
        {
            # A bonus at the end of a long branch must outweigh a short one.
            "config.discount": max(config.discount, 0.97),
            # A letter without a role in the task can earn a bonus, or cost one; without roles this changes nothing.
            "config.network.names": True,
        }
    )
    if name == "paper":
        return settings
    if name == "planner":
        # As sharp as in set 1, per unit of return.
        return settings.evolve({"planner.inverse_temperature": settings.planner.inverse_temperature / 5.0})
    return settings.evolve(
        {
            # By their size alone the advantages of a bonus would drown all others.
            "config.low.advantage_scale": 1.0,
            # As sharp as in set 1, per unit of return.
            "planner.network.advice": settings.planner.network.advice / 5.0,
            # What "d" is worth after "a" is not what it is worth alone.
            "config.network.memory": config.curriculum.levels - 1,
        }
    )


def continuous(settings: Settings, learning_rate: float) -> Settings:
    """What worlds of small steps and Gaussian actions share: long rollouts, few decisions, coloured noise.

    The entropy of a Gaussian may be negative: its weight is small to begin with, and there is no floor.
    """
    return settings.evolve(
        {
            "config.num_steps": 128,
            "config.steps_per_slot": 32,
            "planner.steps_per_sample": 64,
            "config.low.optimiser.learning_rate": learning_rate,
            "config.low.entropy": 0.003,
            "config.low.final_entropy": 0.0,
            "config.low.entropy_floor": 0.0,
            # A density can grow a thousandfold within an update, and so can the gradient where the advantage is
            # negative.
            "config.low.dual_clip": 3.0,
            "config.network.encoder_mlp": (64, 64),
            "config.network.critic": (64, 64),
            # What is found by chance is learned as well, or goals found too rarely are forgotten before they are
            # learned.
            "config.relabel.hindsight": True,
            # Within six steps of a forbidden region, not one and a half; critics of small steps take longer to learn.
            "config.shield.discount": 0.98,
            "config.shield.optimiser.minibatches": 32,
            # At first some goals are found rarely; waiting for the last of them would waste the others.
            "config.curriculum.promotion": 0.85,
            "config.curriculum.window": 256,
        }
    )


# Two blocks, so that two devices share them. A decision is rare; groups are no larger than what is due at a time.
_SHARED = evolve(Config(), {"blocks": 2, "group": 8})
_PAPER = Settings(_SHARED, ImplicitPlanner())
# The planner is asked what each path on is worth, and so needs no policy: sequences, of which the curriculum is made
# and which leave nothing to choose, teach it as well as choices do.
_PLANNER = _PAPER.evolve(
    {
        "planner.values_paths": True,
        # What is left out where a sub-task was not completed are failures: V^h would know of none.
        "planner.learns_unfinished": True,
        # A run makes some 50,000 decisions; without a policy that could run away more can be learned from each.
        "planner.ppo.optimiser.epochs": 8,
    }
)
_HRLSPEC = Settings(
    config=evolve(
        _SHARED,
        {
            "total_steps": 2_500_000,
            # Sharper than 0.94: a detour of two steps costs 19 % of the return.
            "discount": 0.9,
            "low.optimiser.learning_rate": 7e-4,
            "low.entropy": 0.02,
            "low.final_entropy": 0.004,
            # An agent without memory or chance goes in circles for ever, and looks no farther than the nearest goal.
            "low.entropy_floor": 0.12,
            "low.final_entropy_floor": 0.03,
            "network": NetworkConfig(
                # Seen by role the grid needs no convolution: a third of the time, and no worse.
                conv_channels=(),
                encoder_mlp=(256, 256),
                roles=True,
                lookahead=3,
                # Eight directions in one: after 1.5 M steps SPL 0.969, contested choice 0.87; without 0.953 and 0.80.
                symmetric=True,
                task_rounds=0,
                task_scale=1.0,  # seen by role, the goal needs no flag
                critic=(128, 128),
            ),
            "curriculum.promotion": 0.95,
            "curriculum.tree_share": 0.5,
            "curriculum.earlier": 0.4,
            "curriculum.contested": 0.7,
            "relabel.share": 0.25,
            # The policy learns to avoid by itself; shielded steps are lost to it.
            "shield.enabled": False,
        },
    ),
    planner=evolve(
        ImplicitPlanner(),
        {
            # It raises what bad instances lead to up to the planner's average guess, and so hides the difference.
            "max_operator": False,
            "learns_unfinished": True,
            "learns_from_copies": False,
            "ppo.optimiser.learning_rate": 3e-4,
            "ppo.optimiser.epochs": 1,
            "ppo.optimiser.minibatches": 4,
            # One sweep instead of 8 rounds: an eighth of the arithmetic, and no limit to look-ahead.
            "network.rounds": 0,
            # It is asked at every decision about every node; with the low level's advice it need not be large.
            "network.features": 32,
            "network.hidden": 64,
            "network.policy": (64,),
            "network.child_embeddings": True,
            # The learned correction alone misleads: it is trained on relabelled paths, all of which succeeded.
            "network.advice": 400.0,
        },
    ),
)
