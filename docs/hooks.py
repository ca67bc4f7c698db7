"""What the site needs beyond its pages: figures that lie outside ``docs``, and docstrings in reStructuredText roles.

Hooks of MkDocs, named in ``mkdocs.yml``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
FIGURES = "results/paper"
ROLE = re.compile(r":(?:class|func|meth|mod|attr|data):(<code>)~?")


def on_files(files: Files, config: Any) -> Files:
    """Adds the figures of the page of results, which the records keep beside them."""
    for figure in sorted((ROOT / FIGURES).iterdir()):
        if figure.suffix in (".png", ".svg"):
            files.append(File.generated(config, f"{FIGURES}/{figure.name}", abs_src_path=str(figure)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Points to those figures where the site has them."""
    return markdown.replace(f"](../{FIGURES}/", f"]({FIGURES}/") if page.file.src_uri == "results.md" else markdown


def on_page_content(html: str, **_: Any) -> str:
    """Shows ``:class:`Name``` as ``Name``."""
    return ROLE.sub(r"\1", html)
