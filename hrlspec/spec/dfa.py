"""Automata as dictionaries of the library ``dfa`` (its ``dfa2dict``), on which ``dfax`` builds: in and out.

Such a dictionary is ``{state: (accepts, {letter: next state})}`` and comes with the initial state. A letter says which
propositions hold: ``"a&b"``, ``"a"``, ``""`` for none; or a set or a tuple of names; or, as in ``dfax``, the number of
one proposition. A word is accepted in the library where it ends; the task is satisfied as soon as some word is.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from hrlspec.spec.hoa import until_accepting
from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.ltl.translate import MAX_STATES
from hrlspec.spec.syntax import SpecError, shorten

Label: TypeAlias = frozenset[str]


def to_dict(automaton: Automaton) -> tuple[dict[int, tuple[bool, dict[str, int]]], int]:
    """What ``dict2dfa`` takes; ``json.dumps`` of it is what `from_json` reads.

    Args:
        automaton: of a finite task.

    Raises:
        ValueError: the task goes on for ever: such a dictionary can only say which states accept.
    """
    if automaton.marks is not None:
        raise ValueError("a task that goes on for ever has accepting transitions, for which dictionaries have no place")
    letters = ["&".join(sorted(label)) for label in automaton.labels]
    rows = automaton.successors.tolist()
    return {q: (q == automaton.accepting, dict(zip(letters, row, strict=True))) for q, row in enumerate(rows)}, 0


def from_dict(
    states: Mapping[Any, tuple[bool, Mapping[Any, Any]]],
    start: Hashable,
    propositions: Sequence[str],
    possible_labels: Iterable[Collection[str]],
) -> Automaton:
    """The minimal automaton of the task that is satisfied as soon as what was seen is an accepted word.

    Where nothing holds and no letter says so the automaton stays where it is. Letters that cannot occur are left out.

    Args:
        states: what ``dfa2dict`` gives first.
        start: what it gives second.
        propositions: all that letters may name, in the order in which numbers count them.
        possible_labels: the sets of propositions that can hold together.

    Raises:
        SpecError: a state or letter that is none, labels of states that do not say whether they accept, no letter for
            what can hold, or too many states.
    """
    if start not in states:
        raise SpecError(f"found no state {_shown(start)}, with which it starts")
    if len(states) > MAX_STATES:
        raise SpecError(f"the automaton has {len(states):,} states, at most {MAX_STATES:,} are read")
    labels = tuple(dict.fromkeys(map(frozenset, possible_labels)))
    numbers = {state: number for number, state in enumerate([start, *(state for state in states if state != start)])}
    successors = np.zeros((len(states), len(labels)), np.int32)
    accepts = np.zeros(len(states), bool)
    for state, number in numbers.items():
        label, after = states[state]
        if label not in (True, False):
            found = f"state {_shown(state)} has the label {_shown(label)}"
            raise SpecError(f"{found}, expected true or false: whether it accepts")
        targets = _targets(state, after, numbers, propositions)
        targets.setdefault(frozenset(), number)
        for column, possible in enumerate(labels):
            if possible not in targets:
                shown = ", ".join(sorted(possible))
                raise SpecError(f"state {_shown(state)} has no letter for {{{shown}}}, which can hold")
            successors[number, column] = targets[possible]
        accepts[number] = label
    return until_accepting(Automaton(labels, successors, None, None, accepts[successors]))


def from_json(text: str, propositions: Sequence[str], possible_labels: Iterable[Collection[str]]) -> Automaton:
    """Reads ``json.dumps(dfa2dict(...))``: the dictionary and the initial state, in a list.

    JSON makes text of all keys; so ``0`` and ``"0"`` are one state.

    Args:
        text: the file's.
        propositions: see `from_dict`.
        possible_labels: see `from_dict`.

    Raises:
        SpecError: see `from_dict`; or the text is no JSON, or not of this form.
    """
    try:
        found = json.loads(text, object_pairs_hook=_distinct, parse_int=str)
    except json.JSONDecodeError as error:
        raise SpecError(f"no JSON: {error.msg}", error.lineno, error.colno) from None
    except RecursionError:
        raise SpecError("no automaton: nested too deep") from None
    match found:
        case [dict() as rows, start]:
            states = {state: _state_of(state, row) for state, row in rows.items()}
            return from_dict(states, _name(start), propositions, possible_labels)
    raise SpecError("expected a list of two, the states as an object and the initial state, as dfa2dict gives them")


def _targets(
    state: Hashable, after: Mapping[Any, Any], numbers: Mapping[Hashable, int], propositions: Sequence[str]
) -> dict[Label, int]:
    """Where each label leads."""
    found: dict[Label, int] = {}
    for letter, target in after.items():
        label = _label(letter, propositions)
        if target not in numbers:
            where = f"to which {_shown(letter)} leads from state {_shown(state)}"
            raise SpecError(f"found no state {_shown(target)}, {where}")
        if label in found:
            raise SpecError(f"state {_shown(state)} has two letters for what {_shown(letter)} says")
        found[label] = numbers[target]
    return found


def _label(letter: Any, propositions: Sequence[str]) -> Label:
    """The propositions of a letter."""
    if isinstance(letter, str):
        parts = [part.strip() for part in letter.split("&")] if letter.strip() else []
        # JSON makes text of numbers.
        names = [int(part) if part.isascii() and part.isdigit() and len(part) < 10 else part for part in parts]
    else:
        names = list(letter) if isinstance(letter, Collection) else [letter]
    label: set[str] = set()
    for name in names:
        known = propositions[name] if isinstance(name, int) and 0 <= name < len(propositions) else name
        if not isinstance(known, str) or known not in propositions:
            expected = f"some of {', '.join(propositions)}, or a number below {len(propositions)}"
            raise SpecError(f"letter {_shown(letter)}: {_shown(name)} is no proposition, expected {expected}")
        label.add(known)
    return frozenset(label)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object without the same key twice."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise SpecError(f"{_shown(key)} is there twice")
        found[key] = value
    return found


def _state_of(state: str, row: Any) -> tuple[bool, dict[str, str]]:
    """A state's label and where its letters lead."""
    match row:
        case [label, dict() as after]:
            return label, {letter: _name(target) for letter, target in after.items()}
    raise SpecError(f"state {_shown(state)}: expected a list of two, whether it accepts and where its letters lead")


def _name(state: Any) -> str:
    """The text by which a state is a key; numbers were read as text."""
    if not isinstance(state, str):
        raise SpecError(f"a state is a whole number or a text, found {_shown(state)}")
    return state


def _shown(value: object) -> str:
    return shorten(value) if isinstance(value, str) else shorten(repr(value))[1:-1]
