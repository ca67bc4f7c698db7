"""Pictures of automata: short guards on the transitions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from hrlspec.spec.draw import DONE, FAILED, IDLE, TAKEN, networkx_for_drawing
from hrlspec.spec.guards import Transition, transitions
from hrlspec.spec.ltl.automaton import Automaton

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_DRAWN = 40
"""Most states of an automaton in a picture."""


def draw_automaton(automaton: Automaton, ax: Axes | None = None) -> Figure:
    """Draws an automaton from left to right, by how many steps its states are from the initial one.

    An arrow from nowhere leads to the initial state; the accepting state is green with a double outline, the rejecting
    one red. Arrows carry their guards (`hrlspec.spec.guards`), "∧" for and, "¬" for not, a disjunction on several
    lines; with "●" in front, and on a blue arrow, those of accepting transitions of a task that goes on for ever.
    A jump has "ε". What leads back to the same state stands above it, behind "↻". Arrows out of states in which the
    task has ended are left out.

    Args:
        automaton: of `MAX_DRAWN` states at most.
        ax: where to draw; a new figure if left out. Nothing is shown or registered with pyplot.

    Returns:
        The figure.

    Raises:
        ImportError: without networkx and matplotlib, saying how to install them.
        ValueError: there are too many states.
    """
    networkx = networkx_for_drawing()
    if automaton.num_states > MAX_DRAWN:
        raise ValueError(f"the automaton has {automaton.num_states} states, a picture shows {MAX_DRAWN} at most")
    ended = (automaton.accepting, automaton.rejecting)
    arrows: dict[tuple[int, int], list[Transition]] = {}
    for move in transitions(automaton):
        if move.source not in ended:
            arrows.setdefault((move.source, move.target), []).append(move)
    labels = {edge: "\n".join(map(_guard, moves)) for edge, moves in arrows.items()}
    graph = networkx.DiGraph([edge for edge in arrows if edge[0] != edge[1]])
    graph.add_nodes_from(range(automaton.num_states))
    layers = networkx.single_source_shortest_path_length(graph, 0)
    networkx.set_node_attributes(graph, layers, "layer")
    places = networkx.multipartite_layout(graph, subset_key="layer")
    if ax is None:
        from matplotlib.figure import Figure

        width, height = 1 + max(layers.values()), np.bincount(list(layers.values())).max()
        ax = Figure(figsize=(1.5 + 2.2 * width, 1.5 + 1.2 * height), layout="constrained").subplots()
    outlines = ["#222222" if state == automaton.accepting else "none" for state in graph]
    colors = [{automaton.accepting: DONE, automaton.rejecting: FAILED}.get(state, IDLE) for state in graph]
    networkx.draw_networkx_nodes(graph, places, node_size=620, node_color="white", edgecolors=outlines, ax=ax)
    networkx.draw_networkx_nodes(graph, places, node_size=430, node_color=colors, edgecolors="#222222", ax=ax)
    networkx.draw_networkx_labels(graph, places, font_size=8, ax=ax)
    marked = [any(move.accepting for move in arrows[edge]) for edge in graph.edges]
    edge_colors = [TAKEN if some else "#444444" for some in marked]
    widths = [2.6 if some else 1.2 for some in marked]
    bent = "arc3,rad=0.2"  # arrows there and back lie beside each other
    networkx.draw_networkx_edges(
        graph, places, edge_color=edge_colors, width=widths, node_size=620, connectionstyle=bent, ax=ax
    )
    between = {edge: labels[edge] for edge in graph.edges}
    networkx.draw_networkx_edge_labels(graph, places, between, font_size=8, rotate=False, connectionstyle=bent, ax=ax)
    for state, place in places.items():
        if loop := labels.get((state, state)):
            box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5}
            above: dict[str, Any] = {"xytext": (0, 15), "textcoords": "offset points", "ha": "center", "va": "bottom"}
            ax.annotate(f"↻ {loop}", place, **above, fontsize=8, bbox=box)
    ax.annotate("", places[0], (-28, 0), textcoords="offset points", arrowprops={"arrowstyle": "-|>", "shrinkB": 13})
    ax.margins(0.12)
    ax.set_axis_off()
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def _guard(move: Transition) -> str:
    """A guard as a picture has it."""
    return "● " * move.accepting + move.guard.replace(" & ", "∧").replace("!", "¬").replace(" | ", " ∨\n")
