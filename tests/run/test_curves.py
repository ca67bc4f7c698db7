"""Learning curves show the mean over seeds with Student's t interval, and each run where it has come farther."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from hrlspec.run import curves
from hrlspec.run.curves import band, learning_curves
from hrlspec.run.figures import save

VALUES = np.array([[0.1, 0.5, 0.9], [0.2, 0.7, 0.8], [0.6, 0.6, 1.0]])


def rows(*values: float | None, name: str = "eval/success_rate") -> list[dict[str, Any]]:
    return [{"env_steps": 100 * number, name: value} for number, value in enumerate(values, start=1)]


def test_the_band_is_students_interval() -> None:
    ax = Figure().subplots()
    band(ax, [1e6, 2e6, 3e6], VALUES, color="C1", label="x")
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_xdata(), [1, 2, 3])
    np.testing.assert_allclose(line.get_ydata(), VALUES.mean(0))
    corners = np.asarray(ax.collections[0].get_paths()[0].vertices)
    for i, million in enumerate([1, 2, 3]):
        sample = VALUES[:, i]
        expected = scipy.stats.t.interval(0.95, 2, sample.mean(), scipy.stats.sem(sample))
        found = corners[corners[:, 0] == million, 1]
        np.testing.assert_allclose([found.min(), found.max()], expected)


@pytest.mark.parametrize("seeds", [1, 2])
def test_few_seeds_have_no_band(seeds: int) -> None:
    ax = Figure().subplots()
    band(ax, [1, 2, 3], VALUES[:seeds])
    assert len(ax.lines) == 1
    assert not ax.collections


def test_where_one_run_is_ahead_it_is_drawn_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Axes] = []
    monkeypatch.setattr(curves, "save", lambda figure, file: drawn.extend(figure.axes))
    learning_curves({"both": [rows(0.2, 0.4, 0.6, 0.8), rows(0.4, 0.8)], "none": [[]]}, tmp_path / "x.png")
    mean, ahead, none = drawn[0].lines
    np.testing.assert_allclose(mean.get_ydata(), [0.3, 0.6])
    np.testing.assert_allclose(ahead.get_xdata(), [2e-4, 3e-4, 4e-4])
    np.testing.assert_allclose(ahead.get_ydata(), [0.4, 0.6, 0.8])
    assert not len(none.get_xdata())
    drawn.clear()
    # An evaluation at which a run has no value is left out: nothing is a mean of fewer than it says.
    some = [rows(None, 7, 5, name="eval/steps_mean"), rows(9, 9, 9, name="eval/steps_mean")]
    learning_curves({"some": some}, tmp_path / "x.png")
    (mean,) = drawn[3].lines
    np.testing.assert_allclose(mean.get_ydata(), [8, 7])


def test_a_picture_of_curves(tmp_path: Path) -> None:
    file = learning_curves({"$a$": [rows(0.1, 0.2)], r"$\b": [rows(0.3)], "none": [[]]}, tmp_path / "x.png")
    with Image.open(file) as image:
        assert image.format == "PNG"


@pytest.mark.parametrize("ending", ["png", "svg"])
def test_the_same_figure_is_the_same_file(ending: str, tmp_path: Path) -> None:
    def drawn() -> bytes:
        figure = Figure(figsize=(2, 1))
        band(figure.subplots(), [1, 2, 3], VALUES, label="x")
        return save(figure, tmp_path / f"x.{ending}").read_bytes()

    first = drawn()
    assert first == drawn()
    assert first.startswith({"png": b"\x89PNG", "svg": b"<?xml"}[ending])


def test_a_picture_that_cannot_be_written_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = save(Figure(), tmp_path / "x.png")
    before = file.read_bytes()

    def full(self: Figure, name: Path, **options: object) -> None:
        name.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    with pytest.raises(OSError, match="No space left"):
        save(Figure(), file)
    assert file.read_bytes() == before
    assert list(tmp_path.iterdir()) == [file]
