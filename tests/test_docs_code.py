"""The pages of docs/: marked code runs, names and settings exist, links lead somewhere, verdicts are the records'."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import re
from pathlib import Path
from typing import Any

import pytest

from hrlspec.presets.recipes import recipe

DOCS = Path(__file__).parents[1] / "docs"
PAGES = {str(page.relative_to(DOCS)): page.read_text(encoding="utf-8") for page in sorted(DOCS.rglob("*.md"))}
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


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", PAGES[page]):
        if not re.match(r"\w+:", target):
            assert (DOCS / page).parent.joinpath(target).exists(), target


def test_decisions_fit_on_three_pages() -> None:
    assert len(PAGES["decisions.md"].splitlines()) <= 150


CLAIMS = {
    "ours learns faster than LTL2Action": "Ours learns faster than LTL2Action",
    "ours ends above LTL2Action": "Ours ends with a better return than LTL2Action",
    "ours ends above Option": "Ours ends with a better return than Option",
    "Option learns faster in Walk, set 1": "Option learns faster on Walk under reward set 1",
    "Myopic-low learns less than ours": "Without future sub-tasks the low level learns less",
    "Myopic-low ends below ours": "Without future sub-tasks it ends with a lower return",
    "No-ER learns less than Myopic-low": "Without relabelling it learns less still",
}
"""Claims as the paper-to-code page words them, and the page of results."""


def test_verdicts_are_those_of_the_records() -> None:
    recorded = {
        (re.sub(r" \(set \d\)$", "", claim), panel, recipe_name): verdict
        for claim, panel, recipe_name, _, _, verdict in _rows("results.md", 6)
    }
    claim, told = "", {}
    for row in _rows("paper_to_code.md", 7) + _rows("paper_to_code.md", 5):
        claim = row[0] or claim
        panel = row[4] if len(row) == 7 else row[2]
        if claim in CLAIMS:
            for recipe_name, verdict in zip(("paper", "hrlspec"), row[-2:], strict=True):
                told[CLAIMS[claim], panel.strip("`"), recipe_name] = verdict
    assert told == {key: verdict for key, verdict in recorded.items() if key[0] in CLAIMS.values()}


def _rows(page: str, columns: int) -> list[list[str]]:
    """Rows of the tables with so many columns."""
    lines = [line for line in PAGES[page].splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    return [row for row in rows if len(row) == columns]
