"""The page of recorded episodes in a browser: what it shows is what was recorded, by mouse, slider and keyboard.

The documentation's pictures are written into the folder ``$SCREENSHOTS``, if that is set.
"""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hrlspec.run.replay.page import page
from tests.run.browsing import DESKTOP, PHONE, in_the_way, launched, needs_chromium, says
from tests.run.replays import at, played

pytestmark = needs_chromium

DATA = Path(__file__).parents[1] / "data" / "replay"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as started:
        yield started


class Visit:
    """A page that is open, with what it complained of and asked for."""

    def __init__(self, browser: Any, file: Path, data: dict[str, Any], **options: Any) -> None:
        file.write_text(page(data), encoding="utf-8")
        self.data, self.trouble, self.requests = data, [], []
        self.tab = browser.new_page(viewport=options.pop("viewport", DESKTOP), **options)
        self.tab.on("console", lambda message: self.trouble.append(message.text))
        self.tab.on("pageerror", lambda error: self.trouble.append(str(error)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.goto(file.as_uri())

    def scrub(self, step: int) -> None:
        self.tab.locator("#step").evaluate("(x, to) => { x.value = to; x.dispatchEvent(new Event('input')); }", step)

    @property
    def clock(self) -> str:
        return str(self.tab.locator("#clock").text_content())

    @property
    def panels(self) -> list[Any]:
        return list(self.tab.locator(".panel").all())


@pytest.fixture
def visit(browser: Any, tmp_path: Path) -> Iterator[Visit]:
    """Two agents side by side."""
    opened = Visit(browser, tmp_path / "page.html", json.loads(json.dumps(played()[2])))
    yield opened
    assert not opened.trouble
    assert all(url.startswith(("file:", "data:")) for url in opened.requests)
    opened.tab.close()


def check(visit: Visit, episode: int, step: int) -> None:
    """All panels show what was recorded at a step, or at the end of an episode that was shorter."""
    names = visit.data["names"]
    for panel, run in zip(visit.panels, visit.data["runs"], strict=True):
        some = run["episodes"][episode]
        now = min(step, some["steps"])
        x, y = (column[now] for column in some["places"])
        assert panel.locator(".agent").get_attribute("transform") == f"translate({x:g} {y:g})"
        said = str(panel.locator(".now").text_content())
        assert said.startswith(f"Step {now} of {some['steps']}. ")
        (held,) = at(some["labels"], now)
        assert ("Here: " + ", ".join(names[i] for i in held) in said) == bool(held)
        task, node, _ = at(some["standing"], now)
        assert panel.locator(".graph .here").count() == 1
        place = panel.locator(".graph g").nth(node)
        assert "here" in str(place.get_attribute("class"))
        if now == some["steps"]:
            assert "The episode is over" in said
            assert some["outcome"] in said
            continue
        (edge,) = at(some["edges"], now)
        tree = visit.data["tasks"][str(task)]
        reach, avoid = ([names[i] for i in tree[kind][edge]] for kind in ("reach", "avoid"))
        assert f"Reach ◎ {' and '.join(reach)}" in said
        assert (f"avoid ✕ {', '.join(avoid)}" in said) == bool(avoid)
        for kind, wanted in (("reach", reach), ("avoid", avoid)):
            shapes = visit.data["scenes"][episode]["shapes"]
            assert panel.locator(f".map g.{kind}").count() == sum(shape["name"] in wanted for shape in shapes)
        assert "force" in str(panel.locator(".graph g").nth(edge).get_attribute("class"))
        assert panel.locator(".reading").text_content() == f"{some['values'][now]:.2f}"
        decision = [x for x in some["decisions"] if x["step"] <= now][-1]
        assert panel.locator(".branches tbody tr").count() == len(decision["branches"])
        (chosen,) = (probability for branch, probability, _ in decision["branches"] if branch == edge)
        assert f"{100 * chosen:.0f} %" in panel.locator(".branches .chosen").text_content()


def test_it_shows_what_was_recorded(visit: Visit) -> None:
    for episode in (0, 3):
        visit.tab.locator("#episode").select_option(str(episode))
        length = max(run["episodes"][episode]["steps"] for run in visit.data["runs"])
        for step in (0, length // 2, length, 1):
            visit.scrub(step)
            assert visit.clock == f"{step} / {length}"
            check(visit, episode, step)


def test_the_list_of_what_happened_leads_there(visit: Visit) -> None:
    panel, episode = visit.panels[0], visit.data["runs"][0]["episodes"][0]
    panel.locator(".log summary").click()
    entries = panel.locator(".log button").all()
    said = [entry.text_content() for entry in entries]
    assert said[0].startswith("Step 0the planner assigns ")
    assert said[-1] == f"Step {episode['steps']}the episode ends: {episode['outcome']}"
    first = next(i for i, text in enumerate(said) if text.endswith("is reached"))
    assert "the planner assigns" in said[first + 1]  # then the next sub-task
    entries[first].click()
    check(visit, 0, episode["standing"][1][0])


def test_it_plays_to_the_end_and_is_scrubbed_back(visit: Visit) -> None:
    length = max(run["episodes"][0]["steps"] for run in visit.data["runs"])
    visit.tab.locator("#speed").select_option("200")
    visit.tab.locator("#play").click()
    says(visit.tab, "#clock", f"{length} / {length}")
    visit.tab.wait_for_selector("body:not(.playing)")
    check(visit, 0, length)
    visit.scrub(1)
    check(visit, 0, 1)
    took = visit.tab.evaluate(
        """() => {
          const slider = document.getElementById("step");
          return [...Array(100).keys()].map((number) => {
            const begun = performance.now();
            slider.value = (number * 7) % (Number(slider.max) + 1);
            slider.dispatchEvent(new Event("input"));
            document.body.getBoundingClientRect();  // lays everything out
            return performance.now() - begun;
          });
        }"""
    )
    print(f"scrubbing to a step: median {statistics.median(took):.1f} ms, longest {max(took):.1f} ms")


def test_it_is_used_by_keyboard_alone(visit: Visit) -> None:
    length = max(run["episodes"][0]["steps"] for run in visit.data["runs"])
    press = visit.tab.keyboard.press
    for key, step in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1), ("End", length), ("Home", 0)):
        press(key)
        assert visit.clock == f"{step} / {length}", key
    press("Shift+ArrowRight")
    assert visit.clock == f"{min(10, length)} / {length}"
    press("Home")
    press(".")
    happened = {x["step"] for run in visit.data["runs"] for x in run["episodes"][0]["decisions"]} - {0}
    assert visit.clock.split(" / ")[0] == str(min(happened))
    press("n")
    assert visit.tab.locator("#episode").input_value() == "1"
    press("p")
    press("+")
    faster = visit.tab.locator("#speed").input_value()
    press("-")
    assert int(visit.tab.locator("#speed").input_value()) < int(faster)
    press(" ")
    assert visit.tab.locator("#play").get_attribute("aria-label") == "Pause"
    press(" ")
    assert visit.tab.locator("#play").get_attribute("aria-label") == "Play"
    # Everything that can be clicked is reached by Tab, and what was said is there for those who hear the page.
    reached = set()
    for _ in range(40):
        press("Tab")
        reached.add(visit.tab.evaluate("document.activeElement.id"))
    assert {"previous", "episode", "next", "first", "back", "play", "forward", "last", "step", "speed"} <= reached
    press("Home")
    assert visit.tab.locator("#spoken").text_content().startswith("first: Step 0 of ")
    visit.tab.locator(".keys summary").click()
    visit.tab.locator("#keys").uncheck()
    press("n")
    assert visit.tab.locator("#episode").input_value() == "0"


def test_an_automaton_and_its_state(browser: Any, tmp_path: Path) -> None:
    visit = Visit(browser, tmp_path / "page.html", json.loads(json.dumps(played(ltl=True)[2])))
    some = visit.data["runs"][0]["episodes"][0]
    for step, task, *_ in some["standing"]:
        visit.scrub(step)
        here = visit.panels[0].get_by_role("region", name="Automaton").locator(".here > text").first
        assert here.text_content() == ("✓" if task in visit.data["automaton"]["satisfied"] else str(task))
    assert not visit.trouble


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("viewport", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_nothing_stands_in_the_way_of_disabled_people(
    browser: Any, tmp_path: Path, scheme: str, viewport: dict[str, int]
) -> None:
    """No violation of axe-core's rules that is serious; nothing is wider than the screen."""
    data = json.loads(json.dumps(played(ltl=True)[2]))
    visit = Visit(browser, tmp_path / "page.html", data, viewport=viewport, color_scheme=scheme)
    visit.scrub(1)
    for summary in visit.tab.locator("summary").all():
        summary.click()
    assert not in_the_way(visit.tab)
    visit.tab.close()


PICTURES = {
    "replay-light": ("letter", "light", DESKTOP, 2),
    "replay-dark": ("zone", "dark", DESKTOP, 120),
    "replay-phone": ("letter", "dark", PHONE, 2),
}


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_of_trained_agents(name: str, browser: Any, tmp_path: Path) -> None:
    record, scheme, viewport, step = PICTURES[name]
    data = json.loads((DATA / f"{record}.json").read_text())
    visit = Visit(browser, tmp_path / "page.html", data, viewport=viewport, color_scheme=scheme)
    visit.scrub(step)
    shot = Path(os.environ.get("SCREENSHOTS", tmp_path)) / f"{name}.png"
    visit.tab.screenshot(path=shot)
    assert 10_000 < shot.stat().st_size < 150_000
    assert not visit.trouble
    visit.tab.close()
