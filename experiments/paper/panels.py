"""The panels of the paper's figures, their curves, and the runs behind each curve."""

from __future__ import annotations

import dataclasses

from hrlspec.presets import RECIPES, Recipe, RewardSet, Split

ENVIRONMENTS = ("letter", "walk", "zone")
BUDGETS = {"letter": 1_500_000, "walk": 2_000_000, "zone": 4_000_000}
"""Environment steps of a run."""
NUM_SEEDS = 10
FIRST_DEVELOPMENT_SEED = 1000
"""Seeds from here on are for development."""
FIRST_TRIAL_SEED = 1100
"""Those from here on choose settings."""
POINTS = 20
"""Evaluations along a curve."""
BASELINES = ("ltl2action", "option")
_ABLATED = ("ours", "myopic-low", "no-er")
_OPTIMISER = "config.low.optimiser."


@dataclasses.dataclass(frozen=True)
class Curve:
    """One line of a figure.

    Attributes:
        method: who is trained.
        recipe: with which settings.
        switches: further flags of ``experiments.run``: ``--no-`` and a technique, or a setting of the low level's
            optimiser.
    """

    method: str
    recipe: Recipe
    switches: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Such as ``ours (paper)``, ``ours without shield (paper)``, ``ours learning rate 0.001 (paper)``."""
        words = (switch.replace("--no-", "without ").removeprefix(f"--{_OPTIMISER}") for switch in self.switches)
        parts = [self.method, *(word.replace("-", " ").replace("=", " ") for word in words)]
        return f"{' '.join(parts)} ({self.recipe})"


@dataclasses.dataclass(frozen=True)
class Run:
    """One curve's run in one environment with one seed."""

    env: str
    reward_set: RewardSet
    curve: Curve
    seed: int
    total_steps: int

    @property
    def name(self) -> str:
        """Of its folder and record."""
        flags = (switch.removeprefix("--").removeprefix(_OPTIMISER) for switch in self.curve.switches)
        switches = "".join(f"-{flag.replace('=', '-')}" for flag in flags)
        return f"{self.env}-{self.curve.method}-{self.curve.recipe}-set{self.reward_set}{switches}-seed{self.seed}"

    @property
    def split(self) -> Split:
        """Whose results are reported is tested; whose are only looked at to choose something is validated."""
        return "test" if self.seed < FIRST_DEVELOPMENT_SEED else "validation"

    @property
    def flags(self) -> list[str]:
        """The flags of ``experiments.run`` that make it, without those that say where."""
        curve = self.curve
        flags = {
            "env": self.env,
            "method": curve.method,
            "recipe": curve.recipe,
            "reward-set": self.reward_set,
            "seed": self.seed,
            "total-steps": self.total_steps,
            "evaluation.every": max(1, self.total_steps // POINTS),
            "evaluation.final": self.split,
        }
        return [part for name, value in flags.items() for part in (f"--{name}", str(value))] + list(curve.switches)


@dataclasses.dataclass(frozen=True)
class Panel:
    """One diagram of the paper.

    Attributes:
        name: what ``reproduce --only`` calls it.
        title: above the diagram.
        env: the environment.
        reward_set: the rewards.
        curves: the lines.
        first_seed: of its runs.
    """

    name: str
    title: str
    env: str
    reward_set: RewardSet
    curves: tuple[Curve, ...]
    first_seed: int = 0

    def runs(self, num_seeds: int, total_steps: int | None) -> list[Run]:
        """Its runs, seed by seed, so that all lines grow alike."""
        steps = total_steps or BUDGETS[self.env]
        seeds = range(self.first_seed, self.first_seed + num_seeds)
        return [Run(self.env, self.reward_set, curve, seed, steps) for seed in seeds for curve in self.curves]


def in_recipe(method: str, recipe: Recipe, switches: tuple[str, ...] = ()) -> Curve:
    """A method's curve under a recipe. Recipe ``planner`` is ``paper`` to all that do without the planner."""
    return Curve(method, "paper" if recipe == "planner" and method in BASELINES else recipe, switches)


def _curves(methods: tuple[str, ...], recipes: tuple[Recipe, ...]) -> tuple[Curve, ...]:
    return tuple(dict.fromkeys(in_recipe(method, recipe) for recipe in recipes for method in methods))


def _comparison(env: str, reward_set: RewardSet) -> Panel:
    title = f"{env.capitalize()}, reward set {reward_set}"
    return Panel(f"{env}-set{reward_set}", title, env, reward_set, _curves(("ours", *BASELINES), RECIPES))


PANELS = {
    panel.name: panel
    for panel in (
        *(_comparison(env, 1) for env in ENVIRONMENTS),
        *(_comparison(env, 2) for env in ENVIRONMENTS),
        *(
            Panel(f"{env}-ablation", f"{env.capitalize()}, ablations", env, 2, _curves(_ABLATED, ("paper", "hrlspec")))
            for env in ENVIRONMENTS
        ),
        # Beyond the paper's figures, for two of its claims.
        Panel(
            "letter-techniques",
            "Letter, single techniques",
            "letter",
            2,
            (
                Curve("ours", "paper"),
                Curve("ours", "paper", ("--no-max-operator",)),
                Curve("ours", "paper", ("--no-shield",)),
            ),
        ),
    )
}


def _around(*rates: float, **beyond: tuple[float, ...]) -> dict[str, tuple[float, ...]]:
    """For ours, LTL2Action and Option, each: half of a rate, the rate, and twice of it; and, where asked for, more."""
    around = zip(("ours", *BASELINES), rates, strict=True)
    return {method: (rate / 2, rate, 2 * rate, *beyond.get(method, ())) for method, rate in around}


TRIED: dict[tuple[str, Recipe], dict[str, tuple[float, ...]]] = {
    ("letter", "paper"): _around(2e-3, 2e-3, 2e-3, ltl2action=(8e-3,), option=(8e-3,)),
    ("letter", "hrlspec"): _around(7e-4, 3.5e-4, 1.4e-3, ours=(2.8e-3,), ltl2action=(1.4e-3, 2.8e-3)),
    ("walk", "paper"): _around(1e-3, 2e-3, 2e-3),
    ("walk", "hrlspec"): _around(1e-3, 1e-3, 2e-3),
    ("zone", "paper"): _around(1.4e-3, 7e-4, 1.4e-3),
    ("zone", "hrlspec"): _around(1.4e-3, 1.4e-3, 1.4e-3),
}
"""Learning rates of the low level to try for each method, until the best is none of the outer ones."""
TRIAL_SEEDS = 3


def _trials(env: str) -> tuple[Curve, ...]:
    return tuple(
        Curve(method, recipe, (f"--{_OPTIMISER}learning-rate={rate:g}",))
        for (of, recipe), tried in TRIED.items()
        if of == env
        for method, rates in tried.items()
        for rate in rates
    )


TUNING = {
    f"{env}-tuning": Panel(
        f"{env}-tuning", f"{env.capitalize()}, tuning", env, 2, _trials(env), first_seed=FIRST_TRIAL_SEED
    )
    for env in ENVIRONMENTS
}
"""What learning rates are to be chosen by, with seeds and tasks that no panel uses."""

TRAJECTORIES = "walk-trajectories"
"""The figure of trained agents' ways in Walk, which needs a run's checkpoint and not only its record."""
TRAJECTORY_TASKS = (
    "achieve a; achieve b",
    "achieve e; (achieve d ensuring not a)",
    "(achieve a or achieve e); (achieve c ensuring not b)",
    "achieve d ensuring not e; (achieve b ensuring not a)",
    "achieve e; (achieve d; achieve a or achieve a; achieve c)",
    "achieve b ensuring not a; (achieve c; (achieve a ensuring not b))",
)


def trajectory_run(total_steps: int | None) -> Run:
    """Whose checkpoint is drawn."""
    return Run("walk", 1, Curve("ours", "hrlspec"), 0, total_steps or BUDGETS["walk"])
