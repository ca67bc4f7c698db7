"""The paper's claims, each with what is measured for it and what our records say.

Together, in all their panels and under all recipes, they are one family of tests, fixed before any of them is made.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.paper.panels import PANELS, Curve, in_recipe
from experiments.paper.records import Record
from hrlspec.evaluation.stats import (
    Interval,
    difference_interval,
    holm,
    permutation_test,
    probability_of_improvement,
    stratified_bootstrap,
)
from hrlspec.presets import RECIPES, Recipe

Records = Mapping[Curve, Sequence[Record]]
LEVEL = 0.05
"""Of corrected p-values, below which there is a verdict."""


def final_return(record: Record) -> float:
    """Mean return on unseen tasks at the end."""
    return float(record.final["suite"]["return_mean"])


def mean_return(record: Record) -> float:
    """Mean of the learning curve: the area under it over its width. Who learns faster has more."""
    return float(np.mean(record.curve["eval/return_mean"]))


def no_violations(record: Record) -> float:
    """Minus the share of steps while collecting that violated a task."""
    return -float(np.mean(record.curve["train/violations"]))


def steps_to_most(record: Record, share: float = 0.9) -> float:
    """Environment steps after which the curve has reached a share of its last value for the first time."""
    returns = record.curve["eval/return_mean"]
    first = next(i for i, value in enumerate(returns) if value >= share * returns[-1])
    return float(record.curve["env_steps"][first])


@dataclasses.dataclass(frozen=True)
class Claim:
    """That one method is better than another.

    Attributes:
        text: what the paper says.
        panels: where it is looked at.
        better: method and switches that should win.
        worse: those that should lose.
        score: what is compared; more is better.
    """

    text: str
    panels: tuple[str, ...]
    better: tuple[str, tuple[str, ...]]
    worse: tuple[str, tuple[str, ...]]
    score: Callable[[Record], float]


_OURS: tuple[str, tuple[str, ...]] = ("ours", ())
_FIRST = ("letter-set1", "walk-set1", "zone-set1")
_SECOND = ("letter-set2", "walk-set2", "zone-set2")
_ABLATIONS = ("letter-ablation", "walk-ablation", "zone-ablation")

CLAIMS = (
    Claim("Ours learns faster than LTL2Action", _FIRST + _SECOND, _OURS, ("ltl2action", ()), mean_return),
    Claim("Ours ends with a better return than LTL2Action", _FIRST + _SECOND, _OURS, ("ltl2action", ()), final_return),
    # Under reward set 1 in Walk the paper says the opposite.
    Claim(
        "Ours learns faster than Option",
        ("letter-set1", "zone-set1", *_SECOND),
        _OURS,
        ("option", ()),
        mean_return,
    ),
    Claim("Option learns faster on Walk under reward set 1", ("walk-set1",), ("option", ()), _OURS, mean_return),
    Claim("Ours ends with a better return than Option", _FIRST + _SECOND, _OURS, ("option", ()), final_return),
    Claim("Without future sub-tasks the low level learns less", _ABLATIONS, _OURS, ("myopic-low", ()), mean_return),
    Claim("Without future sub-tasks it ends with a lower return", _ABLATIONS, _OURS, ("myopic-low", ()), final_return),
    Claim("Relabelling helps it to learn", _ABLATIONS, _OURS, ("no-er", ()), mean_return),
    Claim("Without relabelling it learns less still", _ABLATIONS, ("myopic-low", ()), ("no-er", ()), mean_return),
    Claim("The max operator helps", ("letter-techniques",), _OURS, ("ours", ("--no-max-operator",)), mean_return),
    Claim(
        "The shield lowers violations while collecting",
        ("letter-techniques",),
        _OURS,
        ("ours", ("--no-shield",)),
        no_violations,
    ),
)


@dataclasses.dataclass(frozen=True)
class Test:
    """One of the family: a claim in a panel under a recipe."""

    claim: Claim
    panel: str
    recipe: Recipe

    @property
    def sides(self) -> tuple[Curve, Curve]:
        """The better one and the worse one."""
        (better, switches), (worse, others) = self.claim.better, self.claim.worse
        return in_recipe(better, self.recipe, switches), in_recipe(worse, self.recipe, others)


@dataclasses.dataclass(frozen=True)
class Finding:
    """What the records say of a claim.

    Attributes:
        difference: of the means over seeds, with Welch's 95 % interval.
        improvement: probability that a run of the better side scores more, with its bootstrap interval over seeds.
        p_value: of the exact two-sided permutation test of means.
        corrected: the same after Holm's correction for the whole family.
        seeds: runs of each side.
    """

    difference: Interval
    improvement: Interval
    p_value: float
    corrected: float
    seeds: tuple[int, int]

    @property
    def verdict(self) -> str:
        """``holds`` or ``does not hold`` where the corrected p-value is below `LEVEL`, else ``undecided``."""
        if self.corrected >= LEVEL:
            return "undecided"
        return "holds" if self.difference.estimate > 0 else "does not hold"


def family() -> list[Test]:
    """All tests that are to be made, whether or not their runs are there."""
    every = [Test(claim, panel, recipe) for claim in CLAIMS for panel in claim.panels for recipe in RECIPES]
    return [test for test in every if {*test.sides} <= {*PANELS[test.panel].curves}]


def runs_to_decide() -> int:
    """The fewest runs on either side with which a claim can have a verdict.

    The least p-value of the exact test is 2 in the number of ways to divide the runs, and Holm's correction multiplies
    it by the size of the family.
    """
    return next(runs for runs in itertools.count(2) if 2 * len(family()) / math.comb(2 * runs, runs) < LEVEL)


def findings(by_panel: Mapping[str, Records]) -> dict[Test, Finding]:
    """What the records say of each test of the family that has at least two runs on either side.

    Args:
        by_panel: records by the panel's name.
    """
    scores = {}
    for test in (tests := family()):
        sides = [by_panel.get(test.panel, {}).get(side, ()) for side in test.sides]
        if min(map(len, sides)) >= 2:
            scores[test] = [[test.claim.score(record) for record in side] for side in sides]
    p_values = [permutation_test(*sides) for sides in scores.values()]
    corrected = holm(p_values, len(tests))
    return {
        test: Finding(difference_interval(*sides), probability_of_improvement(*sides), p, adjusted, _sizes(sides))
        for (test, sides), p, adjusted in zip(scores.items(), p_values, corrected, strict=True)
    }


def _sizes(sides: Sequence[Sequence[float]]) -> tuple[int, int]:
    better, worse = sides
    return len(better), len(worse)


def over_seeds(score: Callable[[Record], float], records: Sequence[Record]) -> Interval:
    """Interquartile mean over seeds with its bootstrap interval."""
    return stratified_bootstrap([score(record) for record in records])
