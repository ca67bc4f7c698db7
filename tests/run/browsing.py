"""A browser for tests of pages: Debian's ``chromium``, or another at ``$CHROMIUM``, and the extra ``browser``."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

playwright = pytest.importorskip("playwright.sync_api", reason='no Playwright: pip install "hrlspec[browser]"')
CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium, or set CHROMIUM")
DESKTOP, PHONE = {"width": 1280, "height": 860}, {"width": 390, "height": 844}


@contextlib.contextmanager
def launched() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        # Within a container there is no sandbox to be had; nothing is loaded but pages of our own.
        started = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


def in_the_way(tab: Any) -> list[Any]:
    """What axe-core calls a serious violation of its rules on a page, and whether it is wider than the screen."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe-core")
    found = axe.Axe().run(tab).response["violations"]
    bad = [(some["id"], some["nodes"][0]["html"]) for some in found if some["impact"] in ("serious", "critical")]
    fits = tab.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    return bad if fits else [*bad, "wider than the screen"]


def says(tab: Any, selector: str, text: str) -> None:
    """Waits for the text. Playwright's `wait_for_function` may have to evaluate text, which the page forbids."""
    playwright.expect(tab.locator(selector)).to_have_text(text, timeout=30_000)
