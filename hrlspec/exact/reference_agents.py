"""Reference agents on finite labelled graphs: nearest goal first, and uninformed choices of the first edge.

Axes: **L** layouts, **S** graph states, **A** actions, **N** tree nodes, **C** children of the root.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int

from hrlspec.exact.automaton import Automaton
from hrlspec.exact.solver import Graph, Product, branch_returns, product, root_children
from hrlspec.spec.tree import TaskTree, subtask_avoid
from hrlspec.tasks.rewards import RewardMachine


def myopic_steps(graph: Graph, tree: TaskTree) -> Float32[np.ndarray, " L"]:
    """Steps of an agent that always goes to the nearest goal among the open sub-tasks, by a shortest path.

    Paths keep clear of what the sub-task avoids (eq. 2). Ties go to the sub-task of the lowest node, then to the
    action of the lowest number. The agent fails where it can reach no goal.

    Args:
        graph: L layouts.
        tree: one task (unbatched).

    Returns:
        float32 ``[L]``, inf where the task is not satisfied.
    """
    run = product(graph, tree)
    machine = run.automaton
    entering = _entering_distances(graph, run, tree)
    layouts = np.arange(graph.num_layouts)
    place, state = graph.start.copy(), np.full(graph.num_layouts, machine.initial[0])
    steps = np.zeros(graph.num_layouts, np.float32)
    while True:
        # Each iteration is one step nearer to a goal, and a path down the tree has finitely many goals.
        following = graph.successors[layouts, place]  # int [L, A]
        ahead = entering[layouts[:, None], :, following]  # float [L, A, N]
        ahead = np.where(machine.open_edges[state][:, None, :], ahead, np.inf)
        pursued = ahead.min(1).argmin(-1)
        action = ahead[layouts, :, pursued].argmin(-1)
        moving = np.isfinite(ahead[layouts, action, pursued])
        if not moving.any():
            return np.where(state == Automaton.SATISFIED, steps, np.inf).astype(np.float32)
        place = np.where(moving, following[layouts, action], place)
        symbol = run.symbol[layouts, place]
        choice = (machine.edge[symbol, state] == pursued[:, None]).argmax(-1)
        state = np.where(moving, machine.successor[symbol, state, choice], state)
        steps += moving


def _entering_distances(graph: Graph, run: Product, tree: TaskTree) -> Float32[np.ndarray, "L N S"]:
    """Further steps to each sub-task's nearest goal after entering a state, float32 ``[L, N, S]``.

    0 at goals, inf where the sub-task avoids what holds. Round k finds the states at distance k.
    """
    symbols = run.automaton.symbols
    reach, avoid = np.asarray(tree.reach), np.asarray(subtask_avoid(tree))
    harmed = (avoid[:, None] & symbols).any(-1)  # bool [N, K]
    goal = (~reach[:, None] | symbols).all(-1) & ~harmed
    harmed_at = harmed[:, run.symbol].transpose(1, 0, 2)  # bool [L, N, S]
    distance = np.where(goal[:, run.symbol].transpose(1, 0, 2), 0, np.inf).astype(np.float32)
    layouts, nodes = np.arange(graph.num_layouts)[:, None, None], np.arange(tree.num_nodes)[None, :, None]
    while True:
        onward = distance
        for action in range(graph.successors.shape[-1]):
            onward = np.minimum(onward, 1 + distance[layouts, nodes, graph.successors[:, None, :, action]])
        onward = np.where(harmed_at, np.inf, onward).astype(np.float32)
        if np.array_equal(onward, distance):
            return distance
        distance = onward


class BranchScores(NamedTuple):
    """Undiscounted returns on one task under a reward set, each float32 ``[L]``.

    Attributes:
        optimal: of the optimal agent.
        random: expected, of an agent that draws its first edge uniformly and is optimal from then on.
        longest: of one that takes the first edge with the longest path below it (the mean over ties) and is optimal
            from then on.
        matters: bool ``[L]``, whether the branches' optima differ by 30 % of the largest or more.
    """

    optimal: Float32[np.ndarray, " L"]
    random: Float32[np.ndarray, " L"]
    longest: Float32[np.ndarray, " L"]
    matters: Bool[np.ndarray, " L"]


def branch_scores(
    graph: Graph, tree: TaskTree, rewards: RewardMachine | None, horizon: int, *, least_difference: float = 0.3
) -> BranchScores:
    """Optimal return, and the returns of uninformed choices of the first edge.

    A branch that cannot be entered within the horizon counts 0.

    Args:
        graph: L layouts.
        tree: one task (unbatched).
        rewards: of the task; 1 for completing it if ``None``.
        horizon: steps in an episode.
        least_difference: the branch matters where the branches' optima differ by at least this share of the largest.
    """
    branches = branch_returns(graph, tree, rewards, horizon)
    best = branches.max(-1)
    height = _heights(tree)[root_children(tree)]
    return BranchScores(
        optimal=best,
        random=branches.mean(-1),
        longest=branches[:, height == height.max()].mean(-1),
        matters=(best > 0) & (best - branches.min(-1) >= least_difference * best),
    )


def _heights(tree: TaskTree) -> Int[np.ndarray, " N"]:
    """Edges on the longest path down from each node, int ``[N]``."""
    parent, valid = np.asarray(tree.parent), np.asarray(tree.valid)
    height = np.zeros(tree.num_nodes, int)
    for node in range(tree.num_nodes - 1, 0, -1):  # Children come after their parents.
        if valid[node]:
            height[parent[node]] = max(height[parent[node]], height[node] + 1)
    return height
