"""Methods, one a file: what each is, its settings, how its high level learns.

A method is a value of a subclass of :class:`hrlspec.agent.method.Method`; those here are known by name, others are used
in the same way without being registered.
"""

from __future__ import annotations

from hrlspec.agent.method import Method
from hrlspec.methods.ltl2action import LTL2ACTION, LTL2Action
from hrlspec.methods.myopic_low import MYOPIC_LOW, MyopicLow
from hrlspec.methods.no_er import NO_ER, NoER
from hrlspec.methods.option import OPTION, Option
from hrlspec.methods.ours import OURS, ImplicitPlanner, Ours

__all__ = [
    "LTL2ACTION",
    "METHODS",
    "MYOPIC_LOW",
    "NO_ER",
    "OPTION",
    "OURS",
    "ImplicitPlanner",
    "LTL2Action",
    "Method",
    "MyopicLow",
    "NoER",
    "Option",
    "Ours",
]

METHODS: dict[str, Method] = {method.name: method for method in (OURS, LTL2ACTION, OPTION, MYOPIC_LOW, NO_ER)}
"""The paper's method, its baselines and its ablations, by name."""
