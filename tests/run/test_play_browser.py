"""Trying an agent by hand in a browser: a task is typed, things are moved, and what is played is what was recorded.

The documentation's picture is written into the folder ``$SCREENSHOTS``, if that is set.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hrlspec.run.play.requests import Arrangement, Attempt
from hrlspec.run.play.server import Server
from tests.run.browsing import DESKTOP, PHONE, in_the_way, launched, needs_chromium, says
from tests.run.served import SEED, game, serving

pytestmark = needs_chromium

TASK = "achieve d; achieve e ensuring not a"
REFUSED = "Failed to load resource: the server responded with a status of 422 (Unprocessable Entity)"
"""What the browser itself notes of an answer that says no."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as started:
        yield started


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as started:
        yield started


class Visit:
    """The page, open, with what it complained of and asked for."""

    def __init__(self, browser: Any, server: Server, **options: Any) -> None:
        self.trouble: list[str] = []
        self.requests: list[str] = []
        self.refusals = 0
        self.tab = browser.new_page(viewport=options.pop("viewport", DESKTOP), **options)
        self.tab.on("console", lambda message: self.trouble.append(message.text))
        self.tab.on("pageerror", lambda error: self.trouble.append(str(error)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.address = f"http://{server.hosts[0]}/"
        self.tab.goto(self.address)

    def settled(self) -> None:
        """What was asked for is there."""
        self.tab.evaluate("latest")

    def text(self, identity: str) -> str:
        return str(self.tab.locator(f"#{identity}").text_content())

    @property
    def things(self) -> list[list[Any]]:
        """Name and place of each."""
        found: list[list[Any]] = self.tab.evaluate("layout.things")
        return found

    def drag(self, number: int, x: float, y: float) -> None:
        """A thing to a place, by mouse."""
        picture = self.tab.locator("#arrangement svg").bounding_box()
        across = self.tab.evaluate("layout.scene.width")
        name, left, top = self.things[number]
        start, end = (
            (picture["x"] + some[0] / across * picture["width"], picture["y"] + some[1] / across * picture["height"])
            for some in ((left, top), (x, y))
        )
        self.tab.mouse.move(*start)
        self.tab.mouse.down()
        self.tab.mouse.move((start[0] + end[0]) / 2, end[1])
        self.tab.mouse.move(*end)
        self.tab.mouse.up()
        self.settled()
        assert self.things[number][0] == name

    def close(self) -> None:
        assert self.trouble == [REFUSED] * self.refusals
        assert all(url.startswith((self.address, "data:")) for url in self.requests)
        self.tab.close()


@pytest.fixture
def visit(browser: Any, server: Server) -> Iterator[Visit]:
    opened = Visit(browser, server)
    yield opened
    opened.close()


def free_cell(things: list[list[Any]]) -> tuple[float, float]:
    """The last cell without a letter."""
    taken = {(x, y) for _, x, y in things}
    return max({(x + 0.5, y + 0.5) for x in range(7) for y in range(7)} - taken)


def test_a_task_is_typed_a_letter_dragged_and_the_episode_watched(visit: Visit) -> None:
    tab = visit.tab
    place = free_cell(visit.things)
    visit.drag(0, place[0] + 0.3, place[1] - 0.2)
    assert tuple(visit.things[0][1:]) == place
    tab.locator("#task").fill(TASK)
    tab.locator("#task").press("Enter")
    tab.wait_for_selector("#panels .map")
    places = Arrangement.read({"seed": SEED, "places": [place for _, *place in visit.things]})
    wanted = json.loads(json.dumps(game().played(Attempt(places, "spec", TASK, False, SEED))))
    assert tab.evaluate("RECORD") == wanted
    episode = wanted["runs"][0]["episodes"][0]
    tab.locator("#speed").select_option("200")
    if not tab.evaluate("player.playing"):
        tab.locator("#play").click()
    says(tab, "#clock", f"{episode['steps']} / {episode['steps']}")
    tab.wait_for_selector("body:not(.playing)")
    xs, ys = episode["places"]
    assert tab.locator("#panels .agent").get_attribute("transform") == f"translate({xs[-1]:g} {ys[-1]:g})"
    assert f"The episode is over: ✓ {episode['outcome']}" in tab.locator(".now").text_content()
    assert visit.text("formula") == TASK
    # Back to the layout, which is as it was left, and to another.
    tab.get_by_role("button", name="Change the layout").click()
    assert tuple(visit.things[0][1:]) == place
    tab.get_by_role("button", name="As it was drawn").click()
    visit.settled()
    assert tuple(visit.things[0][1:]) != place
    tab.get_by_role("button", name="New layout").click()
    visit.settled()
    assert tab.evaluate("layout.seed") == SEED + 1
    assert visit.things == game().arranged(Arrangement(SEED + 1, None))["things"]


def test_a_letter_dropped_on_another_changes_places_with_it(visit: Visit) -> None:
    before = visit.things
    visit.drag(2, *before[5][1:])
    after = visit.things
    assert (after[2][1:], after[5][1:]) == (before[5][1:], before[2][1:])


def test_what_cannot_be_is_said_and_changes_nothing(visit: Visit) -> None:
    tab, before = visit.tab, visit.things
    visit.drag(0, 0.5, 0.5)
    assert visit.text("problem") == "the start cell (0, 0) bears a letter"
    assert visit.things == before
    tab.locator("#task").fill("achieve 𝓩 or")
    tab.get_by_role("button", name="Go").click()
    visit.settled()
    assert visit.text("problem").startswith("Line 1, column 13: ")
    assert tab.evaluate("document.activeElement.selectionStart") == 13  # a character may be two for the browser
    assert tab.locator("#arrange").is_visible()
    tab.locator("#task").fill("achieve a")
    tab.get_by_role("button", name="Go").click()
    visit.settled()
    assert visit.text("problem") == ""
    assert tab.locator("#panels .map").is_visible()
    visit.refusals = 2


def test_it_is_used_by_keyboard_alone(visit: Visit) -> None:
    tab, press = visit.tab, visit.tab.keyboard.press
    number, (name, x, y) = max(enumerate(visit.things), key=lambda some: (some[1][2], some[1][1]))
    tab.locator("#go").focus()
    for _ in range(len(visit.things)):
        press("Tab")
        if (
            tab.evaluate("document.activeElement.getAttribute('aria-label')")
            == f"{name}, row {y + 0.5:g}, column {x + 0.5:g}"
        ):
            break
    press("ArrowUp")
    press("ArrowUp")
    visit.settled()
    assert visit.things[number] == [name, x, y - 2]
    assert visit.text("spoken") == f"{name}: row {y - 1.5:g}, column {x + 0.5:g}."
    assert str(tab.evaluate("document.activeElement.getAttribute('aria-label')")).startswith(f"{name}, row {y - 1.5:g}")
    tab.locator("#language").select_option("ltl")
    assert tab.locator("#task").input_value() == game().example("ltl")
    tab.locator("#task").focus()
    press("End")
    press("ArrowLeft")
    press(" ")
    press("Enter")
    visit.settled()
    tab.wait_for_selector("#panels .map")
    assert tab.evaluate("RECORD.automaton.satisfied.length") == 1
    assert tab.locator("#task").input_value().endswith(" )")  # keys that are typed do not lead the player
    press("End")
    assert tab.evaluate("player.step === player.length")  # but then they do


def test_a_server_that_is_gone_is_said(browser: Any) -> None:
    with serving() as server:
        visit = Visit(browser, server)
    visit.tab.get_by_role("button", name="Go").click()
    visit.settled()
    assert visit.text("problem") == "Nothing answers. Is the command still running?"
    visit.tab.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("viewport", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_nothing_stands_in_the_way_of_disabled_people(
    browser: Any, server: Server, scheme: str, viewport: dict[str, int]
) -> None:
    visit = Visit(browser, server, viewport=viewport, color_scheme=scheme, reduced_motion="reduce")
    visit.tab.locator("#task").fill("achieve z")
    visit.tab.locator("#go").click()
    visit.settled()
    visit.refusals = 1
    assert not in_the_way(visit.tab)
    visit.tab.locator("#task").fill("achieve a")
    visit.tab.locator("#go").click()
    visit.settled()
    assert not visit.tab.evaluate("player.playing")
    assert not in_the_way(visit.tab)
    visit.close()


def test_picture(browser: Any, server: Server, tmp_path: Path) -> None:
    visit = Visit(browser, server, viewport={"width": 900, "height": 780})
    visit.tab.locator(".thing").nth(3).focus()
    visit.tab.keyboard.press("ArrowDown")
    visit.settled()
    shot = Path(os.environ.get("SCREENSHOTS", tmp_path)) / "play.png"
    visit.tab.screenshot(path=shot)
    assert 10_000 < shot.stat().st_size < 100_000
    visit.close()
