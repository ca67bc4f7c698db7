"""Conditions of ``achieve`` and ``ensuring`` as reach and avoid sets of the edges of a task graph.

``achieve`` takes a conjunction of propositions, and a disjunction of those becomes parallel edges; ``ensuring``
takes a conjunction of negated propositions. Negations are pushed inwards by De Morgan first. Anything else is
refused with the reason. Sets of propositions are integers, bit p standing for proposition p.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence

from hrlspec.spec.syntax import And, Budget, Condition, Not, Or, Prop, SpecError, check_name, shorten

#: Most alternatives of one ``achieve``.
MAX_ALTERNATIVES = 256


class Vocabulary:
    """The propositions a formula may use, by index.

    Raises:
        SpecError: if a name is no proposition's name or is given twice.
    """

    def __init__(self, propositions: Sequence[str]) -> None:
        if isinstance(propositions, str):
            raise TypeError("propositions are a sequence of names, found a string")
        self.names = tuple(check_name(name) for name in propositions)
        self._index = {name: i for i, name in enumerate(self.names)}
        if len(self._index) < len(self.names):
            raise SpecError(f"propositions must differ, found {', '.join(self.names)}")

    def bit(self, prop: Prop) -> int:
        """The proposition as a set of one."""
        if prop.name in self._index:
            return 1 << self._index[prop.name]
        known = ", ".join(self.names[:30]) + (", …" if len(self.names) > 30 else "")
        close = difflib.get_close_matches(prop.name[:40], self.names, n=1)
        hint = f" (did you mean {close[0]!r}?)" if close else ""
        raise prop.error(f"unknown proposition {shorten(prop.name)}, expected one of {known}{hint}")

    def show(self, members: int) -> str:
        """The set in braces."""
        return "{" + ", ".join(name for i, name in enumerate(self.names) if members >> i & 1) + "}"


def goals(condition: Condition, vocabulary: Vocabulary, budget: Budget, negated: bool = False) -> list[int]:
    """The alternatives of an ``achieve``: sets of propositions, none of them within another.

    Raises:
        SpecError: for a negated proposition, an unknown one, or too many alternatives.
        TooLarge: if the budget does not suffice.
    """
    match condition:
        case Prop(name=name):
            bit = vocabulary.bit(condition)
            if negated:
                raise condition.error(
                    f"found the negation of {shorten(name)} in 'achieve', expected propositions joined by 'and' or "
                    f"'or'; to keep it false all along write 'ensuring not {name}'"
                )
            return [bit]
        case Not(operand=operand):
            return goals(operand, vocabulary, budget, not negated)
        case And(parts=parts) | Or(parts=parts):
            alternatives = [goals(part, vocabulary, budget, negated) for part in parts]
            if isinstance(condition, Or) != negated:
                return _minimal([goal for some in alternatives for goal in some], condition, budget)
            product = [0]
            for some in alternatives:
                budget.spend(len(product) * len(some))
                product = _minimal([a | b for a in product for b in some], condition, budget)
            return product
        case _:
            raise TypeError(type(condition).__name__)


def _minimal(sets: list[int], condition: Condition, budget: Budget) -> list[int]:
    """The minimal sets, each once: a or (a and b) is a."""
    distinct = list(dict.fromkeys(sets))
    kept: list[int] = []
    for members in sorted(distinct, key=int.bit_count):
        budget.spend(1 + len(kept) // 16)
        if not any(other & members == other for other in kept):
            kept.append(members)
            if len(kept) > MAX_ALTERNATIVES:
                raise condition.error(f"more than {MAX_ALTERNATIVES} alternatives in one 'achieve'")
    chosen = set(kept)
    return [members for members in distinct if members in chosen]


def forbidden(condition: Condition, vocabulary: Vocabulary, negated: bool = False) -> int:
    """The set of propositions that an ``ensuring`` forbids.

    Raises:
        SpecError: for a proposition that would have to hold, a disjunction, or an unknown proposition.
    """
    match condition:
        case Prop(name=name):
            bit = vocabulary.bit(condition)
            if not negated:
                raise condition.error(
                    f"found {shorten(name)} in 'ensuring', expected negated propositions, such as 'not {name}': a "
                    "task graph can forbid propositions along the way, not require them"
                )
            return bit
        case Not(operand=operand):
            return forbidden(operand, vocabulary, not negated)
        case And(parts=parts) | Or(parts=parts):
            if isinstance(condition, Or) != negated:
                found = "not (… and …)" if negated else "… or …"
                raise condition.error(
                    f"found the disjunction '{found}' in 'ensuring', expected negated propositions joined by 'and', "
                    "such as 'not a and not b' or 'not (a or b)': a task graph forbids each of them by itself"
                )
            members = 0
            for part in parts:
                members |= forbidden(part, vocabulary, negated)
            return members
        case _:
            raise TypeError(type(condition).__name__)
