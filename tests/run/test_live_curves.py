"""Learning curves are there from the first evaluation on, and cost a hundredth of the time at most after that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from hrlspec.run import curves, live_curves
from hrlspec.run.folder import open_run
from hrlspec.run.live_curves import CURVES, LiveCurves


class Heard:
    """A display that remembers."""

    def __init__(self) -> None:
        self.steps: list[int] = []
        self.rows: list[Mapping[str, Any]] = []

    def advance(self, env_steps: int, metrics: Mapping[str, float]) -> None:
        self.steps.append(env_steps)

    def row(self, row: Mapping[str, Any]) -> None:
        self.rows.append(row)


def test_the_picture_is_there_from_the_first_evaluation_on(tmp_path: Path) -> None:
    with open_run(tmp_path, {}, tensorboard=False) as run:
        heard = Heard()
        live = LiveCurves(heard, run, "name")
        row = {"env_steps": 100, "eval/success_rate": 0.5, "level": 1}
        run.append(row)
        live.row(row)
        live.advance(200, {})
        assert (heard.rows, heard.steps) == ([row], [200])
        with Image.open(run.plots / CURVES) as image:
            assert min(image.size) > 400


@pytest.mark.parametrize("number", [1, 2])
def test_drawing_costs_its_share_and_no_more(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And with others side by side no more than that together."""
    now, drawn = [1000.0], list[tuple[float, int]]()

    def draw(runs: Mapping[str, Sequence[Any]], file: Path) -> None:
        drawn.append((now[0], len(runs["name"][0])))
        now[0] += 2.0

    monkeypatch.setattr(live_curves, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(curves, "learning_curves", draw)
    with open_run(tmp_path, {}, tensorboard=False) as run:
        live = LiveCurves(Heard(), run, "name", number)
        for step in range(1, 101):
            run.append({"env_steps": step})
            live.row({"env_steps": step})
            now[0] += 10.0
    assert drawn == [(1000.0 + (200 * number + 2) * i, 1 + 20 * number * i) for i in range(-(-5 // number))]


def test_what_cannot_be_drawn_is_tried_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries = []

    def draw(runs: Any, file: Path) -> None:
        tries.append(file)
        raise RuntimeError("latex could not be found")

    monkeypatch.setattr(curves, "learning_curves", draw)
    heard = Heard()
    with open_run(tmp_path, {}, tensorboard=False) as run:
        live = LiveCurves(heard, run, "name")
        for step in (1, 2):
            live.row({"env_steps": step})
    assert len(tries) == 1
    assert len(heard.rows) == 2
