"""The page: one HTML file that loads nothing, made of the templates beside this module and of what was recorded."""

from __future__ import annotations

import html
import json
import string
from collections.abc import Mapping
from importlib import resources
from typing import Any

SCRIPTS = ("dom.js", "record.js", "words.js", "world.js", "graph.js", "chart.js", "panel.js", "player.js")
"""In the order in which they stand in the page; later ones use earlier ones."""


def page(data: Mapping[str, Any]) -> str:
    """The page of recorded episodes; see `hrlspec.run.replay.data.page_data`.

    Raises:
        ValueError: a number in the data is not finite.
    """
    # Within a script element nothing ends it, or begins a comment, but what has a "<".
    record = json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False).replace("<", "\\u003c")
    return string.Template(_template("page.html")).substitute(
        title=html.escape(str(data["formula"])),
        style=_template("page.css"),
        record=record,
        script="\n".join(map(_template, SCRIPTS)),
    )


def _template(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")
