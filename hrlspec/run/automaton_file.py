"""An automaton as a file; its ending says in which form."""

from __future__ import annotations

import json
from pathlib import Path

from hrlspec.run.errors import UserError
from hrlspec.run.extras import PICTURES, check_drawing, drawing
from hrlspec.run.folder import check_file
from hrlspec.spec.dfa import to_dict
from hrlspec.spec.dot import to_dot
from hrlspec.spec.draw_automaton import MAX_DRAWN
from hrlspec.spec.hoa import to_hoa
from hrlspec.spec.ltl import Automaton

_ENDINGS = (".dot", ".hoa", ".json", *PICTURES)


def check_automaton_file(flag: str, file: Path) -> None:
    """What can be known before there is an automaton.

    Raises:
        UserError: the form is unknown, nothing can be written there, or there is no drawing library for a picture.
    """
    check_file(flag, file, _ENDINGS)
    if file.suffix in PICTURES:
        check_drawing()


def check_automaton(flag: str, file: Path, automaton: Automaton) -> None:
    """Whether an automaton can have the form that a file's ending asks for.

    Raises:
        UserError: it is too large for a picture, or its task goes on for ever, for which dictionaries have no place.
    """
    if file.suffix in PICTURES and automaton.num_states > MAX_DRAWN:
        found = f"the automaton has {automaton.num_states} states, a picture shows {MAX_DRAWN} at most"
        raise UserError(f"{flag} {file}: {found}; .dot and .hoa hold any number")
    if file.suffix == ".json" and automaton.marks is not None:
        raise UserError(f"{flag} {file}: a dictionary holds no task that goes on for ever; .hoa and .dot do")


def write_automaton(automaton: Automaton, task: str, file: Path) -> None:
    """Writes what the two checks let pass.

    Raises:
        UserError: it cannot be drawn.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix in PICTURES:
        with drawing():
            from hrlspec.run import plots

            plots.automaton_graph(automaton, task, file)
        return
    match file.suffix:
        case ".dot":
            text = to_dot(automaton, task)
        case ".hoa":
            text = to_hoa(automaton, task)
        case _:
            text = json.dumps(to_dict(automaton)) + "\n"
    file.write_text(text, encoding="utf-8")
