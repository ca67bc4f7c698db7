"""Results of evaluations and their JSON form.

Intervals have 95 % coverage. From ten tasks on they are over tasks: what would come out on other tasks of the kind,
with the correlation of episodes of one task accounted for. Fewer tasks say too little about others; their intervals are
over episodes: what would come out in other episodes on these tasks. See :mod:`hrlspec.evaluation.stats`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from hrlspec.evaluation.stats import Interval

ESTIMATES = ("success_rate", "violation_rate", "return_mean", "steps_mean", "spl")
"""The estimates of a :class:`Score`; each has ``<name>_interval`` beside it in JSON."""

OVER_TASKS, OVER_EPISODES = "tasks", "episodes"
"""What intervals are over."""

_REFERENCES = ("optimal_steps_mean", "myopic_success_rate", "myopic_spl")


@dataclasses.dataclass(frozen=True)
class Score:
    """Summary of episodes.

    Attributes:
        episodes: how many.
        intervals_over: ``tasks``, or ``episodes`` on these tasks where there are fewer than ten.
        success_rate: task satisfied within the horizon.
        violation_rate: task violated, or episode ended by the environment.
        return_mean: undiscounted sum of rewards.
        steps_mean: steps of the successful episodes, all NaN when there is none.
        spl: success weighted by path length: the mean of success × L*/max(taken, L*), L* the least number of steps
            under the committed semantics. ``None`` where L* is not known.
        optimal_steps_mean: mean L* of the successful episodes, or ``None`` likewise and where there is none.
        myopic_success_rate: success rate, on the same cases, of the agent that always goes to the nearest goal, or
            ``None`` likewise.
        myopic_spl: SPL of that agent, or ``None`` likewise.
    """

    episodes: int
    intervals_over: str
    success_rate: Interval
    violation_rate: Interval
    return_mean: Interval
    steps_mean: Interval
    spl: Interval | None
    optimal_steps_mean: float | None
    myopic_success_rate: float | None
    myopic_spl: float | None

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and lists; what is not known or cannot be estimated is ``None``."""
        result: dict[str, Any] = {"episodes": self.episodes, "intervals_over": self.intervals_over}
        for name in ESTIMATES:
            result |= interval_to_json(name, getattr(self, name))
        return result | {name: getattr(self, name) for name in _REFERENCES}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Score:
        """The inverse of :meth:`to_json`."""
        estimates: dict[str, Any] = {name: interval_from_json(name, data) for name in ESTIMATES}
        if data["spl"] is None:
            estimates["spl"] = None
        return cls(
            episodes=data["episodes"],
            intervals_over=data.get("intervals_over", OVER_TASKS),  # older results do not say
            **{name: data[name] for name in _REFERENCES},
            **estimates,
        )


@dataclasses.dataclass(frozen=True)
class TaskScore:
    """The score on one task.

    Attributes:
        task: its SPECTRL.
        depth: edges on its longest path.
        score: on its episodes.
    """

    task: str
    depth: int
    score: Score


@dataclasses.dataclass(frozen=True)
class SuiteResult:
    """Scores of an agent on a suite.

    Attributes:
        suite: its name.
        greedy: whether actions and sub-tasks were the most likely ones rather than sampled.
        shield: whether the shield was on.
        excluded: pairs of task and layout left out because the task cannot be satisfied within the horizon.
        total: over all episodes.
        per_depth: over the tasks of each depth.
        per_task: for each task of the suite, in its order.
    """

    suite: str
    greedy: bool
    shield: bool
    excluded: int
    total: Score
    per_depth: Mapping[int, Score]
    per_task: tuple[TaskScore, ...]

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``: the total's entries on top, ``per_depth`` by depth, a list ``per_task``."""
        return {
            "suite": self.suite,
            "actions": "greedy" if self.greedy else "sampled",
            "shield": self.shield,
            "excluded": self.excluded,
            **self.total.to_json(),
            "per_depth": {str(depth): score.to_json() for depth, score in self.per_depth.items()},
            "per_task": [{"task": each.task, "depth": each.depth, **each.score.to_json()} for each in self.per_task],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> SuiteResult:
        """The inverse of :meth:`to_json`."""
        return cls(
            suite=data["suite"],
            greedy=data["actions"] == "greedy",
            shield=data["shield"],
            excluded=data["excluded"],
            total=Score.from_json(data),
            per_depth={int(depth): Score.from_json(score) for depth, score in data["per_depth"].items()},
            per_task=tuple(TaskScore(each["task"], each["depth"], Score.from_json(each)) for each in data["per_task"]),
        )

    def metrics(self, prefix: str = "eval/") -> dict[str, float]:
        """The headline numbers for a metrics file; NaN where there is no estimate, nothing for SPL where unknown."""
        names = ("return_mean", "success_rate", "steps_mean") + (("spl",) if self.total.spl is not None else ())
        return {prefix + name: getattr(self.total, name).estimate for name in names}


@dataclasses.dataclass(frozen=True)
class ReturnResult:
    """Return over optimum where the branch matters.

    The ratio is taken case by case, undiscounted return divided by the optimum within the horizon, and then averaged
    over cases, so that tasks with large returns count no more than others.

    Attributes:
        suite: its name.
        greedy: whether actions and sub-tasks were the most likely ones rather than sampled.
        episodes: how many cases.
        excluded: pairs of task and layout left out because their branches' optima differ too little.
        intervals_over: ``tasks``, or ``episodes`` on these tasks where there are fewer than ten.
        ratio: of the agent.
        success_rate: of the agent on the same episodes.
        random_branch: ratio of an agent that draws its first edge uniformly and is optimal from then on.
        longest_branch: ratio of one that takes the longest branch and is optimal from then on.
        per_depth: the agent's ratio by depth of the task, without bounds over tasks where they are fewer than ten.
    """

    suite: str
    greedy: bool
    episodes: int
    excluded: int
    intervals_over: str
    ratio: Interval
    success_rate: Interval
    random_branch: float
    longest_branch: float
    per_depth: Mapping[int, Interval]

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {
            "suite": self.suite,
            "actions": "greedy" if self.greedy else "sampled",
            "episodes": self.episodes,
            "excluded": self.excluded,
            "intervals_over": self.intervals_over,
            **interval_to_json("return_over_optimum", self.ratio),
            **interval_to_json("success_rate", self.success_rate),
            "random_branch": self.random_branch,
            "longest_branch": self.longest_branch,
            "per_depth": {
                str(depth): interval_to_json("return_over_optimum", ratio) for depth, ratio in self.per_depth.items()
            },
        }


@dataclasses.dataclass(frozen=True)
class ChoiceResult:
    """Contested choice: the mean of the two rates of optimal choices.

    Always taking the nearest instance scores 0.5, and so does always taking a farther one.

    Attributes:
        greedy: whether actions and sub-tasks were the most likely ones rather than sampled.
        episodes: how many cases, half of them contested.
        score: the mean of the two rates below.
        contested: rate of optimal choices where the nearest instance is not optimal.
        controls: rate where it is.
        failures: share of episodes whose task was not satisfied; they count as not optimal.
    """

    greedy: bool
    episodes: int
    score: Interval
    contested: Interval
    controls: Interval
    failures: float

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {
            "actions": "greedy" if self.greedy else "sampled",
            "episodes": self.episodes,
            **interval_to_json("contested_choice", self.score),
            **interval_to_json("contested_right", self.contested),
            **interval_to_json("control_right", self.controls),
            "failure_rate": self.failures,
        }


def interval_to_json(name: str, interval: Interval | None) -> dict[str, Any]:
    """``{name: estimate, name_interval: [low, high]}``; ``None`` where there is no estimate or there are no bounds."""
    estimate, *bounds = interval or (math.nan,) * 3
    return {
        name: None if math.isnan(estimate) else float(estimate),
        f"{name}_interval": None if any(map(math.isnan, bounds)) else [float(bound) for bound in bounds],
    }


def interval_from_json(name: str, data: Mapping[str, Any]) -> Interval:
    """The inverse of :func:`interval_to_json` for an interval, unknown numbers as NaN."""
    low, high = data[f"{name}_interval"] or (None, None)
    return Interval(*(math.nan if number is None else number for number in (data[name], low, high)))
