"""Small tasks for tests, as trees: written down by hand or drawn at random, without the language."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hrlspec.spec.tree import TaskTree


def tree_of(edges: Sequence[tuple[int, str, str]], *, num_propositions: int = 5, num_nodes: int = 0) -> TaskTree:
    """A tree from its edges ``(parent, letters to reach, letters to avoid)``; edge i enters node i + 1."""
    total = max(num_nodes, len(edges) + 1)
    parent = np.full(total, TaskTree.NO_NODE, np.int32)
    reach, avoid = np.zeros((2, total, num_propositions), bool)
    depth = np.zeros(total, np.int32)
    for node, (above, goals, harms) in enumerate(edges, 1):
        parent[node], depth[node] = above, depth[above] + 1
        reach[node, [ord(letter) - ord("a") for letter in goals]] = True
        avoid[node, [ord(letter) - ord("a") for letter in harms]] = True
    valid = np.arange(total) <= len(edges)
    accepting = valid & ~np.isin(np.arange(total), parent)
    return TaskTree(parent=parent, reach=reach, avoid=avoid, accepting=accepting, valid=valid, depth=depth)


def random_tree(
    rng: np.random.Generator, *, num_nodes: int, num_propositions: int, most_together: int = 1, distinct: bool = False
) -> TaskTree:
    """Any shape, several goals together, avoid sets that may hit anything.

    Siblings may reach the same unless ``distinct``.
    """
    letters = [chr(ord("a") + i) for i in range(num_propositions)]
    edges: list[tuple[int, str, str]] = []
    for _ in range(1, int(rng.integers(2, num_nodes + 1))):
        goals = rng.choice(letters, rng.integers(1, most_together + 1), replace=False)
        harms = [x for x in rng.choice(letters, rng.integers(0, 3), replace=False) if x not in goals]
        edge = int(rng.integers(len(edges) + 1)), "".join(sorted(goals)), "".join(harms)
        if not distinct or edge[:2] not in [other[:2] for other in edges]:
            edges.append(edge)
    return tree_of(edges, num_propositions=num_propositions, num_nodes=num_nodes)
