"""Abstract graphs (paper, "Task Specification Language") in which equal nodes are shared.

A node represents the remaining task: whether it accepts, and its outgoing edges. Nodes are interned, so equal
remaining tasks are one node, and operations are memoised. That keeps the graph of a formula small where its tree is
exponentially large; the tree's size is counted on the graph before anything is unfolded.

Sets of propositions are integers, bit p standing for proposition p.
"""

from __future__ import annotations

from collections.abc import Iterable

from hrlspec.spec.syntax import Budget, TooLarge

#: Longest chain of sub-tasks.
MAX_STEPS = 128

Edge = tuple[int, int]
"""The reach set and the avoid set of an edge."""


class Graphs:
    """Nodes of abstract graphs as indices into tables, children before parents.

    ``DEAD`` can never accept and ``DONE`` accepts at once. Operations recurse once per sub-task in a row, of which
    there are at most ``MAX_STEPS``, and raise ``TooLarge`` beyond that or when the budget is spent.
    """

    DEAD = 0
    DONE = 1

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._index: dict[tuple[bool, tuple[tuple[Edge, int], ...]], int] = {}
        self._unions: dict[tuple[int, ...], int] = {}
        self._appended: dict[tuple[int, int], int] = {}
        self._ensured: dict[tuple[int, int], int] = {}
        self._pruned: dict[int, int] = {}
        self.accepting: list[bool] = []
        self.edges: list[dict[Edge, int]] = []
        self.height: list[int] = []
        self.node(False, {})  # DEAD
        self.node(True, {})  # DONE

    def node(self, accepting: bool, edges: dict[Edge, int]) -> int:
        """The node with these edges, in their order; edges to nodes that can never accept are left out."""
        self._budget.spend(1 + len(edges))
        alive = tuple((edge, to) for edge, to in edges.items() if to != self.DEAD)
        key = (accepting, alive)
        if key not in self._index:
            height = max((1 + self.height[to] for _, to in alive), default=0)
            if height > MAX_STEPS:
                raise TooLarge(f"more than {MAX_STEPS} sub-tasks in a row")
            self._index[key] = len(self.edges)
            self.accepting.append(accepting)
            self.edges.append(dict(alive))
            self.height.append(height)
        return self._index[key]

    def union(self, nodes: Iterable[int]) -> int:
        """Choice between nodes. Edges with the same reach and avoid sets are merged (left factoring)."""
        distinct = tuple(dict.fromkeys(node for node in nodes if node != self.DEAD))
        if len(distinct) < 2:
            return distinct[0] if distinct else self.DEAD
        if distinct not in self._unions:
            targets: dict[Edge, list[int]] = {}
            for node in distinct:
                self._budget.spend(1 + len(self.edges[node]))
                for edge, to in self.edges[node].items():
                    targets.setdefault(edge, []).append(to)
            edges = {}
            for edge, some in targets.items():  # a loop, as a comprehension is a stack frame more per level
                edges[edge] = self.union(some)
            self._unions[distinct] = self.node(any(self.accepting[node] for node in distinct), edges)
        return self._unions[distinct]

    def append(self, first: int, then: int) -> int:
        """Sequential composition: ``then`` starts at every accepting node of ``first``, also at those with edges."""
        if first == self.DONE:
            return then
        if (first, then) not in self._appended:
            edges = {}
            for edge, to in self.edges[first].items():
                edges[edge] = self.append(to, then)
            longer = self.node(False, edges)
            self._appended[first, then] = self.union((then, longer)) if self.accepting[first] else longer
        return self._appended[first, then]

    def ensure(self, node: int, avoid: int) -> int:
        """Adds ``avoid`` to every edge; an edge that reaches what it avoids is unsatisfiable and removed."""
        if (node, avoid) not in self._ensured:
            targets: dict[Edge, list[int]] = {}
            for (reach, own), to in self.edges[node].items():
                if not reach & avoid:
                    targets.setdefault((reach, own | avoid), []).append(self.ensure(to, avoid))
            edges = {}
            for edge, some in targets.items():
                edges[edge] = self.union(some)
            self._ensured[node, avoid] = self.node(self.accepting[node], edges)
        return self._ensured[node, avoid]

    def prune(self, node: int) -> int:
        """Removes what follows an accepting node: the task is satisfied on arrival there."""
        if self.accepting[node]:
            return self.DONE
        if node not in self._pruned:
            edges = {}
            for edge, to in self.edges[node].items():
                edges[edge] = self.prune(to)
            self._pruned[node] = self.node(False, edges)
        return self._pruned[node]

    def reachable(self, root: int) -> list[int]:
        """All nodes reachable from a node, itself included, each once."""
        order = {root: None}
        pending = [root]
        while pending:
            for to in self.edges[pending.pop()].values():
                if to not in order:
                    order[to] = None
                    pending.append(to)
        return list(order)

    def tree_size(self, root: int) -> int:
        """Number of nodes of the tree that unfolds from a node, the node included."""
        sizes: dict[int, int] = {}
        for node in sorted(self.reachable(root)):  # children before parents
            sizes[node] = 1 + sum(sizes[to] for to in self.edges[node].values())
        return sizes[root]
