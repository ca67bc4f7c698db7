"""Automata as text for Graphviz (the language DOT)."""

from __future__ import annotations

from hrlspec.spec.guards import JUMP, transitions
from hrlspec.spec.ltl.automaton import Automaton


def to_dot(automaton: Automaton, name: str = "") -> str:
    """Text that ``dot`` and its like draw, with guards in the syntax of LTL (`hrlspec.spec.guards`).

    An arrow from nowhere leads to the initial state; the accepting state has a double outline, the rejecting one a
    dashed outline; accepting transitions are bold, and marked ``{0}`` as in HOA; jumps are dashed.

    Args:
        automaton: of a finite task, or of one that goes on for ever.
        name: to stand below the picture.
    """
    shapes = {automaton.accepting: "shape=doublecircle", automaton.rejecting: "style=dashed"}
    lines = ["digraph {", "  rankdir=LR", *([f"  label={_quoted(name)}"] if name else []), "  node [shape=circle]"]
    lines += ['  start [shape=point, label=""]', "  start -> 0"]
    lines += [f"  {state} [{shapes.get(state, '')}]" for state in range(automaton.num_states)]
    for source, target, accepting, guard in transitions(automaton):
        label = _quoted(guard + " {0}" * accepting)
        style = ", style=bold" * accepting + ", style=dashed" * (guard == JUMP)
        lines.append(f"  {source} -> {target} [label={label}{style}]")
    return "\n".join([*lines, "}", ""])


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
