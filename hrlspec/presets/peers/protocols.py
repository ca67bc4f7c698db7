"""How others evaluate: episodes of each formula, and whether actions are sampled."""

from __future__ import annotations

from typing import Literal, NamedTuple

from envs_jax import Environment

Protocol = Literal["jaxolotl", "deepltl"]


class Manner(NamedTuple):
    """How formulas are evaluated.

    Attributes:
        episodes: of each formula and seed.
        greedy: the most likely action and sub-task, instead of sampling.
    """

    episodes: int
    greedy: bool


def manner(protocol: Protocol, env: Environment, forever: bool) -> Manner:
    """What a protocol asks for.

    Args:
        protocol: that of Jaxolotl (and of StructLTL and SemLTL), with 512 episodes, actions sampled; or DeepLTL's, with
            500 episodes, in Zone greedy where formulas are finite. Theirs has a finite formula violated in the step in
            which nothing can satisfy it any more; Jaxolotl's a step later, and not in the last one: here it is always
            the former, which costs a success nowhere.
        env: the world.
        forever: whether the tasks go on for ever.
    """
    if protocol == "jaxolotl":
        return Manner(episodes=512, greedy=False)
    return Manner(episodes=500, greedy=env.name.startswith("zone") and not forever)
