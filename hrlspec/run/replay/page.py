"""The page: one HTML file that loads nothing, made of the templates beside this module and of what was recorded."""

from __future__ import annotations

import html
import json
import string
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

SCRIPTS = ("dom.js", "record.js", "words.js", "world.js", "graph.js", "chart.js", "panel.js", "player.js")
"""In the order in which they stand in the page; later ones use earlier ones."""


def page(data: Mapping[str, Any]) -> str:
    """The page of recorded episodes; see `hrlspec.run.replay.data.page_data`.

    Raises:
        ValueError: a number in the data is not finite.
    """
    return player_page("Replay", data["formula"], data)


def player_page(
    kind: str,
    heading: str,
    record: Mapping[str, Any] | None,
    *,
    form: str = "",
    style: str = "",
    scripts: Sequence[str] = (),
    connects: str = "'none'",
) -> str:
    """A page with the player, and perhaps with more.

    Args:
        kind: of page.
        heading: its heading.
        record: the episodes, if there are any yet.
        form: HTML above the player.
        style: CSS after the player's.
        scripts: JavaScript after the player's.
        connects: where the page may send requests, as its content security policy says it.

    Raises:
        ValueError: a number in the record is not finite.
    """
    return string.Template(_template("page.html")).substitute(
        kind=kind,
        title=html.escape(heading),
        connects=connects,
        style=_template("page.css") + style,
        form=form,
        record=script_json(record),
        script="\n".join([*map(_template, SCRIPTS), *scripts]),
    )


def script_json(data: Any) -> str:
    """JSON to stand in a script element, in which nothing ends it, or begins a comment, but what has a ``<``.

    Raises:
        ValueError: a number is not finite.
    """
    return json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")


def _template(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")
