"""What a run says while it runs, with and without a terminal."""

from __future__ import annotations

import io

import pytest

from hrlspec.run import progress
from hrlspec.run.console import PlainConsole
from hrlspec.run.progress import MeanDisplay, ProgressDisplay, duration


class Clock:
    """Time that passes when told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now)


def test_plain_lines_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream = Clock(monkeypatch), io.StringIO()
    with ProgressDisplay(10_000, "run", console=PlainConsole(file=stream, width=20)) as display:
        clock.now += 60  # compilation
        display.advance(1000, {"episodes": 10.0, "successes": 5.0, "level": 1.0})
        clock.now += 10
        display.advance(2000, {"episodes": 0.0, "successes": 0.0, "level": 2.0})
        clock.now += 1
        display.advance(2100, {})  # too soon for another line
        display.row({"env_steps": 2100, "eval/success_rate": 0.5, "eval/spl": None, "eval/steps_mean": float("nan")})
    assert stream.getvalue().splitlines() == [
        "run: compiling",
        "run: 1,000/10,000 steps, level 1, success 0.50",
        "run: 2,000/10,000 steps, 100 steps/s, level 2, success 0.50, 1:20 left",
        "run: 2,100 steps, unseen tasks: success 0.500, steps nan",
    ]


def test_evaluations_do_not_slow_the_rate_down(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream = Clock(monkeypatch), io.StringIO()
    with ProgressDisplay(10_000, "run", console=PlainConsole(file=stream, width=200), begin=5000) as display:
        display.advance(5100, {})
        display.row({"env_steps": 5100})
        clock.now += 1000  # the evaluation
        display.advance(5200, {})
        clock.now += 10
        display.advance(6200, {})
    assert stream.getvalue().splitlines()[-1] == "run: 6,200/10,000 steps, 100 steps/s, 0:38 left"


def test_a_bar_in_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream = Clock(monkeypatch), io.StringIO()
    console = PlainConsole(file=stream, width=120, force_terminal=True, color_system=None)
    with ProgressDisplay(1000, "run", console=console) as display:
        display.advance(100, {"episodes": 4.0, "successes": 3.0, "level": 3.0})
        clock.now += 1
        display.advance(200, {"episodes": 4.0, "successes": 3.0, "level": 3.0})
    assert "200/1,000 steps, 100 steps/s, level 3, success 0.75" in stream.getvalue()
    assert "0:08 left" in stream.getvalue()


def test_runs_side_by_side_are_shown_as_their_mean(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream = Clock(monkeypatch), io.StringIO()
    with ProgressDisplay(1000, "runs", console=PlainConsole(file=stream, width=200)) as display:
        mean = MeanDisplay(display, 2)
        clock.now += 60
        for successes, level in ((1.0, 1.0), (3.0, 3.0)):
            mean.advance(100, {"episodes": 4.0, "successes": successes, "level": level})
        for success, spl in ((0.25, None), (0.5, 0.5)):
            mean.row({"env_steps": 100, "eval/success_rate": success, "eval/spl": spl})
    assert stream.getvalue().splitlines() == [
        "runs: compiling",
        "runs: 100/1,000 steps, level 2, success 0.50",
        "runs: 100 steps, unseen tasks: success 0.375",
    ]


@pytest.mark.parametrize("terminal", ["xterm", "dumb"])
def test_names_are_shown_as_they_are(terminal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream, name = Clock(monkeypatch), io.StringIO(), "exp[test] [bold red]x :smile:"
    environ = {"TERM": terminal}
    console = PlainConsole(file=stream, width=120, force_terminal=True, color_system=None, _environ=environ)
    with ProgressDisplay(1000, name, console=console) as display:
        clock.now += 60
        display.advance(100, {})
        display.note("[/] closed")
    assert f"{name}: [/] closed" in stream.getvalue()
    assert f"{name}: 100/1,000 steps" in stream.getvalue() or terminal == "xterm"
    assert ("\x1b" in stream.getvalue()) == (terminal == "xterm")  # the bar
    assert "\x1b[?25l" not in stream.getvalue()  # a hidden cursor would stay so where the process ends at once


@pytest.mark.parametrize(("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (3599, "59:59"), (3723, "1:02:03")])
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text
