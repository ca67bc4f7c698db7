"""Pictures of task graphs: sub-tasks on the edges, progress highlighted."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import TYPE_CHECKING

import jax
import numpy as np

from hrlspec.spec.monitor import SATISFIED, VIOLATED, TaskState
from hrlspec.spec.subtasks import subtasks
from hrlspec.spec.tree import TaskTree

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

IDLE, TAKEN, HERE, DONE, FAILED, BLOCKED = "#d9dde3", "#2f6fb2", "#f2b134", "#4f9d5d", "#c8443c", "#b0b0b0"


def draw_task(
    tree: TaskTree, propositions: Sequence[str], state: TaskState | None = None, ax: Axes | None = None
) -> Figure:
    """Draws a task, root at the top, leaves with a double outline.

    Each edge carries its sub-task (eq. 2): what to reach, then what to avoid behind "¬". With a state, the path
    taken so far is blue, the current node yellow (green when satisfied, red when violated), and blocked edges are
    grey and dashed.

    Args:
        tree: one task.
        propositions: names of the P propositions.
        state: progress on the task.
        ax: where to draw; a new figure if left out. Nothing is shown or registered with pyplot.

    Returns:
        The figure.

    Raises:
        ImportError: without networkx and matplotlib, saying how to install them.
        ValueError: if the number of names is not P.
    """
    networkx = networkx_for_drawing()
    tree = jax.tree.map(np.asarray, tree)
    graph = networkx.DiGraph()
    nodes = np.flatnonzero(tree.valid).tolist()
    graph.add_nodes_from(nodes)
    labels: dict[tuple[int, int], str] = {}
    for node in nodes:
        for child, reach, avoid in subtasks(tree, node, propositions):
            graph.add_edge(node, child)
            labels[node, child] = "∧".join(reach) + "".join(f"\n¬{name}" for name in avoid)
    places = _places(tree, nodes)
    if ax is None:
        from matplotlib.figure import Figure

        width = max(4.0, 1.5 * sum(bool(tree.accepting[node]) for node in nodes))
        ax = Figure(figsize=(width, 2.0 + 1.3 * int(tree.depth.max())), layout="constrained").subplots()
    node_colors, edge_colors, styles = _paint(tree, state, nodes, list(graph.edges))
    outlines = ["#222222" if tree.accepting[node] else "none" for node in nodes]
    networkx.draw_networkx_nodes(
        graph, places, nodelist=nodes, node_size=620, node_color="white", edgecolors=outlines, ax=ax
    )
    networkx.draw_networkx_nodes(
        graph, places, nodelist=nodes, node_size=430, node_color=node_colors, edgecolors="#222222", ax=ax
    )
    networkx.draw_networkx_labels(graph, places, {node: str(node) for node in nodes}, font_size=8, ax=ax)
    widths = [2.6 if color == TAKEN else 1.2 for color in edge_colors]
    networkx.draw_networkx_edges(
        graph, places, edge_color=edge_colors, style=styles, width=widths, node_size=620, ax=ax
    )
    networkx.draw_networkx_edge_labels(graph, places, labels, font_size=8, rotate=False, ax=ax)
    ax.margins(0.12)
    ax.set_axis_off()
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def networkx_for_drawing() -> ModuleType:
    """The library of graphs, where all that draws is there.

    Raises:
        ImportError: it is not; the message says what to install.
    """
    try:
        import matplotlib.figure  # noqa: F401
        import networkx
    except ImportError as error:
        raise ImportError("drawing tasks needs networkx and matplotlib: pip install 'hrlspec[plot]'") from error
    return networkx


def _places(tree: TaskTree, nodes: list[int]) -> dict[int, tuple[float, float]]:
    """Leaves side by side in the order of their branches, parents above the middle of their children."""
    children: dict[int, list[int]] = {node: [] for node in nodes}
    for node in nodes:
        if tree.parent[node] >= 0:
            children[int(tree.parent[node])].append(node)
    across: dict[int, float] = {}
    pending = [TaskTree.ROOT]
    next_leaf = 0
    while pending:
        node = pending.pop()
        missing = [child for child in children[node] if child not in across]
        if missing:
            pending += [node, *reversed(missing)]
        elif children[node]:
            across[node] = float(np.mean([across[child] for child in children[node]]))
        else:
            across[node] = float(next_leaf)
            next_leaf += 1
    return {node: (across[node], -float(tree.depth[node])) for node in nodes}


def _paint(
    tree: TaskTree, state: TaskState | None, nodes: list[int], edges: list[tuple[int, int]]
) -> tuple[list[str], list[str], list[str]]:
    """Colours of the nodes and of the edges, and line styles of the edges."""
    if state is None:
        return [IDLE] * len(nodes), ["#444444"] * len(edges), ["solid"] * len(edges)
    current, status = int(state.node), int(state.status)
    blocked = np.asarray(state.blocked)
    path = [current]
    while tree.parent[path[-1]] >= 0:
        path.append(int(tree.parent[path[-1]]))
    here = {SATISFIED: DONE, VIOLATED: FAILED}.get(status, HERE)
    node_colors = [here if node == current else TAKEN if node in path else IDLE for node in nodes]
    shut = [parent == current and (bool(blocked[child]) or status == VIOLATED) for parent, child in edges]
    edge_colors = [
        TAKEN if child in path else BLOCKED if gone else "#444444" for (_, child), gone in zip(edges, shut, strict=True)
    ]
    return node_colors, edge_colors, ["dashed" if gone else "solid" for gone in shut]
