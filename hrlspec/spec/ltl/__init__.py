"""Linear temporal logic (LTL) as text, as a syntax tree, and as an automaton."""

from __future__ import annotations

from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.ltl.buchi import to_buchi
from hrlspec.spec.ltl.parser import parse_ltl
from hrlspec.spec.ltl.semantics import satisfies_ltl
from hrlspec.spec.ltl.syntax import Formula, propositions_of
from hrlspec.spec.ltl.text import ltl_text
from hrlspec.spec.ltl.translate import to_automaton

__all__ = [
    "Automaton",
    "Formula",
    "ltl_text",
    "parse_ltl",
    "propositions_of",
    "satisfies_ltl",
    "to_automaton",
    "to_buchi",
]
