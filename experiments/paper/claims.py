"""The paper's claims, each with what is measured for it and what our records say."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.paper.panels import Curve
from experiments.paper.records import Record
from hrlspec.evaluation.stats import Interval, probability_of_improvement, stratified_bootstrap
from hrlspec.presets import Recipe

Records = Mapping[Curve, Sequence[Record]]
FEWEST_SEEDS = 5
"""Below this there is no verdict."""


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
    Claim("Ours ends with a better return than Option (set 1)", _FIRST, _OURS, ("option", ()), final_return),
    Claim("Ours ends with a better return than Option (set 2)", _SECOND, _OURS, ("option", ()), final_return),
    Claim("Option learns faster on Walk under reward set 1", ("walk-set1",), ("option", ()), _OURS, mean_return),
    Claim("Without future sub-tasks the low level learns less", _ABLATIONS, _OURS, ("myopic-low", ()), mean_return),
    Claim("Without future sub-tasks it ends with a lower return", _ABLATIONS, _OURS, ("myopic-low", ()), final_return),
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
class Finding:
    """What a panel's records say of a claim under one recipe.

    Attributes:
        improvement: probability that a run of the better one scores more, with its bootstrap interval over seeds.
        seeds: runs of each.
    """

    improvement: Interval
    seeds: tuple[int, int]

    @property
    def verdict(self) -> str:
        """``holds`` or ``does not hold`` where the interval excludes a half, else ``undecided``."""
        if min(self.seeds) < FEWEST_SEEDS:
            return "too few seeds"
        if self.improvement.low > 0.5:
            return "holds"
        return "does not hold" if self.improvement.high < 0.5 else "undecided"


def finding(claim: Claim, recipe: Recipe, records: Records) -> Finding | None:
    """Looks at one panel's records; ``None`` unless both sides have two."""
    sides = [records.get(Curve(method, recipe, switches), ()) for method, switches in (claim.better, claim.worse)]
    if min(map(len, sides)) < 2:  # a bootstrap over one seed would be sure of itself
        return None
    better, worse = ([claim.score(record) for record in side] for side in sides)
    return Finding(probability_of_improvement(better, worse), (len(better), len(worse)))


def over_seeds(score: Callable[[Record], float], records: Sequence[Record]) -> Interval:
    """Interquartile mean over seeds with its bootstrap interval."""
    return stratified_bootstrap([score(record) for record in records])
