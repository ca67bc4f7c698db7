"""Evaluating an agent on tasks that it carries out as automata: formulas in linear temporal logic, and others.

Axes: **M** formulas, **B** episodes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Int, Key

from envs_jax import Environment
from envs_jax.arrays import Array
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.evaluation.episodes import Episodes, run_episodes
from hrlspec.evaluation.results import interval_to_json
from hrlspec.evaluation.stats import Interval, mean_interval, rate_interval
from hrlspec.spec import SpecError, bare_lines, parse
from hrlspec.spec.automata import MAX_PROPOSITIONS, Automata, automata_of
from hrlspec.spec.ltl import Automaton, parse_ltl, to_automaton, to_buchi
from hrlspec.spec.readings import exact_automaton
from hrlspec.tasks.rewards import RewardMachine

MAX_NODES = 64
"""Default for the trees that the states of automata show: of larger ones the longest paths are left out."""
_LEAST_ROWS = 32
_LAYOUT_STREAM = 2**31 - 1  # far from the keys that training with the same seed begins with
EPISODES = 512
"""Of each formula, as the peers have it."""


@dataclasses.dataclass(frozen=True)
class LtlSuite:
    """M formulas to evaluate on.

    Attributes:
        name: under which results are reported.
        forever: whether the tasks go on for ever.
        formulas: their text.
        automata: the tasks for acting.
        sources: the same, one by one.
        cut: bool ``[M]``, some state has more paths to acceptance than its tree shows.
        silent: bool ``[M]``, some way on begins where nothing holds, which no sub-task can ask for.
    """

    name: str
    forever: bool
    formulas: tuple[str, ...]
    automata: Automata
    sources: tuple[Automaton, ...]
    cut: Bool[np.ndarray, " M"]
    silent: Bool[np.ndarray, " M"]

    def __len__(self) -> int:
        """M."""
        return len(self.formulas)

    @property
    def num_states(self) -> Int[np.ndarray, " M"]:
        """Of each automaton."""
        return np.array([automaton.num_states for automaton in self.sources])


@dataclasses.dataclass(frozen=True)
class FormulaScore:
    """How an agent did on one formula.

    Attributes:
        formula: its text.
        num_states: of its automaton.
        cut: see `LtlSuite`.
        silent: see `LtlSuite`.
        success_rate: of its episodes.
        violation_rate: nothing that could follow would have satisfied it, or the environment ended the episode.
        ended_rate: the latter alone.
        steps_mean: of the successful episodes.
        rounds_mean: accepting transitions within the horizon; of tasks that go on for ever, which are never satisfied.
        no_round_rate: none of them.
    """

    formula: str
    num_states: int
    cut: bool
    silent: bool
    success_rate: Interval
    violation_rate: Interval
    ended_rate: Interval
    steps_mean: Interval
    rounds_mean: Interval
    no_round_rate: Interval

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {
            "formula": self.formula,
            "automaton_states": self.num_states,
            "cut": self.cut,
            "silent": self.silent,
            **interval_to_json("success_rate", self.success_rate),
            **interval_to_json("violation_rate", self.violation_rate),
            **interval_to_json("ended_rate", self.ended_rate),
            **interval_to_json("steps_mean", self.steps_mean),
            **interval_to_json("rounds_mean", self.rounds_mean),
            **interval_to_json("no_round_rate", self.no_round_rate),
        }


@dataclasses.dataclass(frozen=True)
class LtlResult:
    """How an agent did on a suite.

    Attributes:
        suite: its name.
        forever: whether the tasks go on for ever.
        greedy: whether actions and sub-tasks were the most likely ones rather than sampled.
        episodes: of each formula.
        per_formula: the scores.
    """

    suite: str
    forever: bool
    greedy: bool
    episodes: int
    per_formula: tuple[FormulaScore, ...]

    @property
    def success_rate(self) -> float:
        """Mean over formulas."""
        return float(np.mean([score.success_rate.estimate for score in self.per_formula]))

    @property
    def steps_mean(self) -> float:
        """Mean over the formulas with a success; NaN without any."""
        steps = [score.steps_mean.estimate for score in self.per_formula if score.success_rate.estimate > 0]
        return float(np.mean(steps)) if steps else float("nan")

    @property
    def rounds_mean(self) -> float:
        """Mean over formulas."""
        return float(np.mean([score.rounds_mean.estimate for score in self.per_formula]))

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {
            "suite": self.suite,
            "forever": self.forever,
            "rounds_mean": self.rounds_mean if self.forever else None,
            "actions": "greedy" if self.greedy else "sampled",
            "episodes_per_formula": self.episodes,
            "success_rate": None if self.forever else self.success_rate,
            "steps_mean": None if np.isnan(self.steps_mean) else self.steps_mean,
            "per_formula": [score.to_json() for score in self.per_formula],
        }


def ltl_suite(name: str, text: str, env: Environment, *, forever: bool = False, max_nodes: int = MAX_NODES) -> LtlSuite:
    """Reads formulas, one a line; ``#`` begins a comment, blank lines are skipped.

    Args:
        name: of the suite, and of the text in errors.
        text: the lines.
        env: whose propositions they are about, and whose labels their automata read.
        forever: whether they are to be satisfied for ever, instead of by the end of an episode; see
            `hrlspec.spec.ltl.to_buchi`.
        max_nodes: N, padded size of the trees that the states show.

    Raises:
        SpecError: with the line and column of the first mistake, if an automaton is too large, or without a formula.
    """
    translate = to_buchi if forever else to_automaton

    def read(line: str) -> Automaton:
        return translate(parse_ltl(line), env.propositions, env.possible_labels)

    return _suite(name, text, env, read, max_nodes)


def exact_suite(name: str, text: str, env: Environment, *, max_nodes: int = MAX_NODES) -> LtlSuite:
    """Reads tasks in SPECTRL, to be carried out in their exact reading; see `ltl_suite`.

    What a tree cannot say is read, too, such as ``achieve a ensuring b``.

    Args:
        name: of the suite, and of the text in errors.
        text: one task a line; ``#`` begins a comment, blank lines are skipped.
        env: whose propositions they are about, and whose labels their automata read.
        max_nodes: N, padded size of the trees that the states show.

    Raises:
        SpecError: with the line and column of the first mistake, if an automaton is too large, or without a task.
    """

    def read(line: str) -> Automaton:
        return exact_automaton(parse(line), env.propositions, env.possible_labels)

    return _suite(name, text, env, read, max_nodes)


def _suite(name: str, text: str, env: Environment, read: Callable[[str], Automaton], max_nodes: int) -> LtlSuite:
    """A suite of one task a line."""
    check_propositions(name, env)
    formulas, automata = [], []
    for number, line in enumerate(bare_lines(text), 1):
        if not line.strip():
            continue
        try:
            automata.append(read(line))
        except SpecError as error:
            raise SpecError(error.message, number, error.column or 1, name) from None
        formulas.append(" ".join(line.split()))
    if not formulas:
        raise SpecError("found no formula, expected one on each line", source=name)
    return suite_of_automata(name, formulas, automata, env, max_nodes=max_nodes)


def check_propositions(name: str, env: Environment) -> None:
    """Whether an environment's tasks can be automata.

    Raises:
        SpecError: in the name of a suite; it has more than `MAX_PROPOSITIONS`.
    """
    if env.num_propositions > MAX_PROPOSITIONS:
        found = f"{env.name} has {env.num_propositions} propositions"
        raise SpecError(f"{found}, tasks as automata take {MAX_PROPOSITIONS} at most", source=name)


def suite_of_automata(
    name: str, formulas: Sequence[str], automata: Sequence[Automaton], env: Environment, *, max_nodes: int = MAX_NODES
) -> LtlSuite:
    """A suite of tasks that are automata already.

    Args:
        name: of the suite.
        formulas: what to call the M tasks.
        automata: of the tasks, over the environment's `possible_labels`; all finite, or none.
        env: the environment.
        max_nodes: N, padded size of the trees that the states show.
    """
    together, cut, silent = automata_of(automata, env.propositions, max_nodes)
    # One compiled program for all suites of up to so many states, and others for twice and four times as many.
    num_states = sum(automaton.num_states for automaton in automata)
    together = together.padded(max(_LEAST_ROWS, 1 << (num_states - 1).bit_length()))
    return LtlSuite(name, automata[0].marks is not None, tuple(formulas), together, tuple(automata), cut, silent)


def evaluate_ltl(
    key: Key[Array, ""],
    agent: Agent,
    params: Params,
    machine: RewardMachine,
    suite: LtlSuite,
    *,
    episodes: int = EPISODES,
    seed: int = 0,
    greedy: bool = False,
    shield: bool = False,
    chunk: int = EPISODES,
) -> LtlResult:
    """Success, violations and steps on each formula, in layouts that depend on ``seed`` alone.

    Args:
        key: of the agent's and the environment's randomness; consumed.
        agent: the networks.
        params: their parameters.
        machine: the rewards.
        suite: M formulas.
        episodes: of each formula, each in a layout of its own.
        seed: of the layouts.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.
        chunk: episodes run in parallel; bounds memory.
    """
    which = np.repeat(np.arange(len(suite)), episodes)
    layout_keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), _LAYOUT_STREAM), len(which))
    layouts = jax.vmap(agent.env.sample_layout, in_axes=(0, None))(layout_keys, agent.env.default_params)
    found = jax.device_get(
        run_episodes(
            key,
            agent,
            params,
            machine,
            suite.automata,
            layouts,
            which=which,
            greedy=greedy,
            shield=shield,
            chunk=chunk,
        )
    )
    return LtlResult(suite.name, suite.forever, greedy, episodes, _scores(suite, which, found))


def _scores(suite: LtlSuite, which: Int[np.ndarray, " B"], episodes: Episodes) -> tuple[FormulaScore, ...]:
    """The scores of each formula."""
    success, violated, ended, steps, rounds = map(
        np.asarray, (episodes.success, episodes.violated, episodes.ended, episodes.steps, episodes.rounds)
    )
    rows: Sequence[Bool[np.ndarray, " B"]] = [which == number for number in range(len(suite))]
    return tuple(
        FormulaScore(
            formula=formula,
            num_states=suite.sources[number].num_states,
            cut=bool(suite.cut[number]),
            silent=bool(suite.silent[number]),
            success_rate=rate_interval(success[mine]),
            violation_rate=rate_interval(violated[mine]),
            ended_rate=rate_interval(ended[mine]),
            steps_mean=mean_interval(steps[mine & success]),
            rounds_mean=mean_interval(rounds[mine]),
            no_round_rate=rate_interval(rounds[mine] == 0),
        )
        for number, (formula, mine) in enumerate(zip(suite.formulas, rows, strict=True))
    )
