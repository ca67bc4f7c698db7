"""First choices: how often the first sub-task that is assigned is the best one, where that matters.

What is counted is the decision at an episode's start, not what comes of it: no episode is run. So it measures planning
apart from control.

Axes: **B** cases, **N** tree nodes, **P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Key

from envs_jax import Environment, FiniteGraph, GridMap
from envs_jax.arrays import Array
from envs_jax.base import Layout
from hrlspec.agent.agent import Agent
from hrlspec.agent.interaction import decide, start
from hrlspec.agent.low_level import Params
from hrlspec.evaluation.cases import LAYOUTS_PER_TASK, draw_layouts, task_of
from hrlspec.evaluation.results import interval_to_json
from hrlspec.evaluation.stats import Interval, rate_interval
from hrlspec.evaluation.suite import Suite
from hrlspec.exact import shortest_path, solver
from hrlspec.exact.solver import root_children
from hrlspec.spec import TaskTree
from hrlspec.tasks.rewards import RewardMachine

By = Literal["steps", "return", "return without distances"]
"""What makes a first sub-task the best: the fewest steps to satisfaction; the largest return within the horizon; or, in
worlds without a finite graph, the largest return if every proposition were a step away."""
LEAST_DIFFERENCE: dict[By, float] = {"steps": 0.1, "return": 0.3, "return without distances": 0.3}
"""The choice matters where the worst first sub-task falls short of the best by at least this share of it."""
TIE = 0.02
"""First sub-tasks that fall short of the best by no more than this share of it are as good."""


@dataclasses.dataclass(frozen=True)
class FirstChoices:
    """B cases in which the first choice matters.

    Attributes:
        suite: the tasks.
        task: int ``[B]``, rows of the suite.
        layouts: a layout pytree, numpy leaves with leading axis B.
        best: bool ``[B, N]``, the first edges that are as good as the best.
        margin: float ``[B]``, how much more the best is worth than the best of those that are not as good: steps, or
            return.
        by: what makes them so.
        chance: expected rate of an agent that draws its first edge uniformly.
        excluded: pairs of task and layout that were left out because the choice matters too little.
    """

    suite: Suite
    task: Int[np.ndarray, " B"]
    layouts: Layout
    best: Bool[np.ndarray, "B N"]
    margin: Float32[np.ndarray, " B"]
    by: By
    chance: float
    excluded: int

    def __len__(self) -> int:
        """B."""
        return len(self.task)


@dataclasses.dataclass(frozen=True)
class FirstChoiceResult:
    """How often the first sub-task assigned is the best one.

    Attributes:
        suite: its name.
        greedy: whether it was the most likely one rather than sampled.
        episodes: how many cases.
        excluded: see `FirstChoices`.
        by: see `FirstChoices`.
        rate: of best first choices.
        chance: of an agent that draws its first sub-task uniformly.
    """

    suite: str
    greedy: bool
    episodes: int
    excluded: int
    by: By
    rate: Interval
    chance: float

    def to_json(self) -> dict[str, Any]:
        """A dictionary for ``json.dumps``."""
        return {
            "suite": self.suite,
            "actions": "greedy" if self.greedy else "sampled",
            "episodes": self.episodes,
            "excluded": self.excluded,
            "by": self.by,
            **interval_to_json("first_choice", self.rate),
            "chance": self.chance,
        }


@dataclasses.dataclass(frozen=True)
class FirstChoiceEvaluation:
    """First choices; call it.

    Attributes:
        cases: tasks in layouts where the choice matters.
        greedy: take the most likely sub-task instead of sampling.
    """

    cases: FirstChoices
    greedy: bool = False

    def __call__(self, key: Key[Array, ""], agent: Agent, params: Params, machine: RewardMachine) -> FirstChoiceResult:
        """Scores an agent whose high level assigns sub-tasks. The key is consumed."""
        cases = self.cases
        right = self.right(key, agent, params, machine)
        return FirstChoiceResult(
            suite=cases.suite.name,
            greedy=self.greedy,
            episodes=len(cases),
            excluded=cases.excluded,
            by=cases.by,
            rate=rate_interval(right, tasks=cases.task),
            chance=cases.chance,
        )

    def right(
        self, key: Key[Array, ""], agent: Agent, params: Params, machine: RewardMachine
    ) -> Bool[np.ndarray, " B"]:
        """In which cases the agent assigns a best one, bool ``[B]``. The key is consumed."""
        cases = self.cases
        edge = np.asarray(
            _first_edges(agent, self.greedy, key, params, machine, cases.suite.trees, cases.task, cases.layouts)
        )
        return np.asarray(cases.best[np.arange(len(cases)), edge])


def first_choice_evaluation(
    env: Environment,
    suite: Suite,
    machine: RewardMachine,
    *,
    layouts_per_task: int = LAYOUTS_PER_TASK,
    seed: int = 1,
    greedy: bool = False,
) -> FirstChoiceEvaluation:
    """First choices on the tasks and layouts of a suite in which they matter.

    Args:
        env: the environment.
        suite: M tasks.
        machine: the rewards; where they pay for completion alone, fewest steps are best.
        layouts_per_task: layouts drawn for each task.
        seed: of the layouts.
        greedy: take the most likely sub-task instead of sampling.

    Raises:
        ValueError: the choice matters nowhere, or steps count and the environment is neither a
            :class:`envs_jax.FiniteGraph` nor a :class:`envs_jax.GridMap`.
    """
    layouts = draw_layouts(env, suite, layouts_per_task, seed=seed)
    worth, by = _branch_values(env, layouts, machine)
    task, kept, best, margin, chances, excluded = [], [], [], [], [], 0
    for row in range(len(suite)):
        rows = np.arange(row * layouts_per_task, (row + 1) * layouts_per_task)
        tree = task_of(suite, row)
        children, values = root_children(tree), worth(rows, tree)
        size = np.abs(values.max(1, keepdims=True))
        good = values >= values.max(1, keepdims=True) - TIE * size
        matters = np.isfinite(size[:, 0]) & (size[:, 0] > 0)
        matters &= values.min(1) <= values.max(1) - LEAST_DIFFERENCE[by] * size[:, 0]
        excluded += int((~matters).sum())
        task += [row] * int(matters.sum())
        kept += rows[matters].tolist()
        chances += good[matters].mean(1).tolist()
        margin.append((values.max(1) - np.where(good, -np.inf, values).max(1))[matters])
        of_nodes = np.zeros((len(rows), tree.num_nodes), bool)
        of_nodes[:, children] = good
        best.append(of_nodes[matters])
    if not task:
        raise ValueError(f"{suite.name}: the first choice matters in none of {len(suite) * layouts_per_task} cases")
    cases = FirstChoices(
        suite=suite,
        task=np.array(task),
        layouts=jax.tree.map(lambda x: x[np.array(kept)], layouts),
        best=np.concatenate(best),
        margin=np.concatenate(margin).astype(np.float32),
        by=by,
        chance=float(np.mean(chances)),
        excluded=excluded,
    )
    return FirstChoiceEvaluation(cases, greedy)


def _branch_values(env: Environment, layouts: Layout, machine: RewardMachine) -> Any:
    """A function of rows of the layouts and a task, what each first edge is worth there ``[L, C]``, and by what."""
    if not machine.num_rules and not float(machine.subtask):
        if isinstance(env, FiniteGraph):
            graph = solver.tabulate(env, layouts)
            return lambda rows, tree: -solver.branch_steps(graph[rows], tree), "steps"
        if isinstance(env, GridMap):
            return lambda rows, tree: -_grid_steps(env, jax.tree.map(lambda x: x[rows], layouts), tree), "steps"
        raise ValueError(f"{env.name} has no graph and no grid, so the fewest steps are not known")
    if isinstance(env, FiniteGraph):
        graph = solver.tabulate(env, layouts)
        return lambda rows, tree: solver.branch_returns(graph[rows], tree, machine, env.horizon), "return"
    anywhere = _all_a_step_away(env.num_propositions)

    def returns(rows: Int[np.ndarray, " L"], tree: TaskTree) -> Float32[np.ndarray, "L C"]:
        return np.repeat(solver.branch_returns(anywhere, tree, machine, env.horizon), len(rows), 0)

    return returns, "return without distances"


def _grid_steps(env: GridMap, layouts: Layout, tree: TaskTree) -> Float32[np.ndarray, "L C"]:
    """Steps of each branch; equal layouts are solved once."""
    kept, which = shortest_path.distinct(layouts)
    return shortest_path.branch_steps(shortest_path.grid_of(env, kept), tree)[which]


def _all_a_step_away(num_propositions: int) -> solver.Graph:
    """A world with one place for each proposition and one for none, where it starts; all are a step from each other."""
    places = num_propositions + 1
    return solver.Graph(
        successors=np.broadcast_to(np.arange(places), (1, places, places)),
        labels=np.eye(places, num_propositions, dtype=bool)[None],
        start=np.array([num_propositions]),
    )


@functools.partial(jax.jit, static_argnums=(0, 1))
def _first_edges(
    agent: Agent,
    greedy: bool,
    key: Key[Array, ""],
    params: Params,
    machine: RewardMachine,
    trees: TaskTree,
    task: Int32[Array, " B"],
    layouts: Layout,
) -> Int32[Array, " B"]:
    """The first edge assigned in each case, int32 ``[B]``."""
    reset_key, choice_key = jax.random.split(key)
    book = agent.low.prepare(params, trees)
    worker = start(jax.random.split(reset_key, len(task)), agent.env, machine, book, layouts, task)
    shape = (len(task), trees.parent.shape[1])
    noise = jnp.zeros(shape, jnp.float32) if greedy else jax.random.gumbel(choice_key, shape, jnp.float32)
    return decide(agent, params, book, worker, worker.awaiting, noise).edge
