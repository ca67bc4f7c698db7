"""A task as somebody writes it, and as it is carried out: padded, so that one compiled program takes nearly any."""

from __future__ import annotations

from typing import Literal

from envs_jax import Environment
from hrlspec.evaluation import ltl_suite, suite_from_text
from hrlspec.evaluation.suite import MAX_NODES
from hrlspec.spec import SpecError, TaskTree, bare_lines
from hrlspec.spec.automata import Automata

Language = Literal["spec", "ltl"]
"""SPECTRL, or linear temporal logic."""

USUAL_NODES, USUAL_STATES = 64, 64
"""Of a tree and of an automaton, padding included. Larger ones take programs of their own."""


def read_task(
    source: str, language: Language, text: str, env: Environment, *, forever: bool = False, usual: bool = False
) -> tuple[str, TaskTree | Automata]:
    """Reads one task, which may be written over several lines.

    Args:
        source: what to call the text in errors.
        language: that it is written in.
        text: the task; ``#`` begins a comment.
        env: the world.
        forever: whether a formula in LTL is to be satisfied for ever.
        usual: refuse what is of more than the usual size.

    Returns:
        The task on one line; a tree with a leading axis 1, or one automaton.

    Raises:
        SpecError: it cannot be read, or is too large.
    """
    line = " ".join(bare_lines(text))
    if language == "spec":
        suite = suite_from_text(source, line, env.propositions, max_nodes=USUAL_NODES if usual else MAX_NODES)
        size = USUAL_NODES if suite.trees.num_nodes <= USUAL_NODES else MAX_NODES
        return suite.formulas[0], suite.padded(size).trees
    formulas = ltl_suite(source, line, env, forever=forever)
    states = len(formulas.automata.status)
    if usual and states > USUAL_STATES:
        raise SpecError(f"the automaton has {formulas.num_states[0]} states, {USUAL_STATES} are possible", 1, 1, source)
    return formulas.formulas[0], formulas.automata.padded(max(states, USUAL_STATES))
