"""The pages of docs/ and the README: marked code runs, names and settings exist, links lead somewhere."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest

from hrlspec.presets.recipes import recipe

DOCS = Path(__file__).parents[1] / "docs"
NOTEBOOK = "quickstart.ipynb"
"""Runs in tests/test_quickstart.py."""


def _prose(notebook: str) -> str:
    """What stands between its code."""
    cells = json.loads(notebook)["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


PAGES = {str(page.relative_to(DOCS)): page.read_text(encoding="utf-8") for page in sorted(DOCS.rglob("*.md"))}
PAGES[NOTEBOOK] = _prose((DOCS / NOTEBOOK).read_text(encoding="utf-8"))
MARK = re.compile(r"^<!-- test: runs(?:, with (?P<changes>[^>]*?))? -->$", re.MULTILINE)
"""What a page says of its code: all of its Python runs, in order, with some numbers made smaller."""


@pytest.mark.slow  # the README's code, which is much of it, runs by default
@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if MARK.search(text)])
def test_marked_code_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text, mark = PAGES[page], MARK.search(PAGES[page])
    assert mark is not None
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    code = "\n".join(blocks)
    assert code
    for change in filter(None, (mark["changes"] or "").split(", ")):
        name = change.partition("=")[0]
        code, count = re.subn(rf"\b{re.escape(name)}=[\w.]+", change, code)
        assert count == 1, f"{page} promises {change}, {count} places have {name}="
    exec(compile(code, str(DOCS / page), "exec", dont_inherit=True), {"__name__": Path(page).stem})


def _codes(text: str) -> list[str]:
    """What stands between single backquotes, outside of blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))


def _find(name: str) -> Any:
    """The module, class, function, attribute or field of a dotted name.

    Raises:
        AttributeError: there is none.
    """
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for part in parts[length:]:
            fields = {field.name for field in dataclasses.fields(found)} if dataclasses.is_dataclass(found) else set()
            found = part if part in fields else getattr(found, part)
        return found
    raise AttributeError(f"no module {parts[0]}")


CURRENT = {name: text for name, text in PAGES.items() if not name.startswith(("experiments/", "api/"))}
"""Pages that speak of the code as it is. Those of experiments speak of the code as it was."""
NAMES = sorted(
    {code for text in CURRENT.values() for code in _codes(text) if re.match(r"(hrlspec|envs_jax)\.[\w.]+$", code)}
)


@pytest.mark.parametrize("name", NAMES)
def test_names_exist(name: str) -> None:
    _find(name)


SETTINGS = sorted(
    {
        code
        for text in CURRENT.values()
        for code in _codes(text)
        if re.match(r"(config|planner)\.(?!json$)[a-z_.]+$", code)
    }
)


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_exist(name: str) -> None:
    functools.reduce(getattr, name.split("."), recipe("hrlspec"))


LINKED = {**PAGES, "../README.md": (DOCS.parent / "README.md").read_text(encoding="utf-8")}


def _anchors(text: str) -> set[str]:
    """Those of its headings, as GitHub and the site make them."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w-]", "", heading.strip().lower().replace(" ", "-")) for heading in headings}


@pytest.mark.parametrize("page", LINKED)
def test_links_lead_somewhere(page: str) -> None:
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", LINKED[page]):
        if not re.match(r"\w+:", target):
            found = (DOCS / page).parent.joinpath(target).resolve() if target else (DOCS / page).resolve()
            assert found.exists(), target
            name = os.path.relpath(found, DOCS)
            assert not anchor or anchor in _anchors(LINKED[name]), f"{target}#{anchor}"


def test_decisions_fit_on_three_pages() -> None:
    assert len(PAGES["decisions.md"].splitlines()) <= 150
