"""What the site needs beyond its pages: the notebook, figures that lie outside ``docs``, docstrings in reST roles.

Hooks of MkDocs, named in ``mkdocs.yml``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from jinja2 import DictLoader
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
FIGURES = "results/paper"
NOTEBOOK, PAGE = "quickstart.ipynb", "quickstart.md"
# Pictures with the words that their cells have for them.
TEMPLATE = """{% extends 'markdown/index.md.j2' %}
{% block data_png %}![{{ cell.metadata.alt }}]({{ output.metadata.filenames['image/png'] }}){% endblock %}"""
ROLE = re.compile(r":(?:class|func|meth|mod|attr|data):(<code>)~?")


def on_files(files: Files, config: Any) -> Files:
    """Makes the notebook a page like others, and adds the figures of the page of results, which the records keep.

    Plugins for notebooks render pages by themselves: links in them are neither checked nor lead to other pages.
    """
    notebook = files.get_file_from_path(NOTEBOOK)
    files.remove(notebook)
    exporter = MarkdownExporter(extra_loaders=[DictLoader({"page.md.j2": TEMPLATE})], template_file="page.md.j2")
    text, resources = exporter.from_filename(notebook.abs_src_path, {"output_files_dir": "quickstart"})
    for name, content in {PAGE: text, **resources["outputs"]}.items():
        files.append(File.generated(config, name, content=content))
    for figure in sorted((ROOT / FIGURES).iterdir()):
        if figure.suffix in (".png", ".svg"):
            files.append(File.generated(config, f"{FIGURES}/{figure.name}", abs_src_path=str(figure)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Points to both where the site has them."""
    markdown = markdown.replace(f"]({NOTEBOOK}", f"]({PAGE}")
    return markdown.replace(f"](../{FIGURES}/", f"]({FIGURES}/") if page.file.src_uri == "results.md" else markdown


def on_page_content(html: str, **_: Any) -> str:
    """Shows ``:class:`Name``` as ``Name``."""
    return ROLE.sub(r"\1", html)
