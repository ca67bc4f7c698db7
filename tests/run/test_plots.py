"""Pictures: the files are there, of the right form, and show what happened."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image

import envs_jax
from hrlspec.run import plots
from hrlspec.run.plots import Episode
from hrlspec.run.stages import LetterStage, stage_of
from tests.trees import tree_of

NAMES = tuple("abcde")


@pytest.fixture
def episode() -> Episode:
    """Down over the edge of the torus onto a, then right to b; c is the other branch."""
    layout = np.full((5, 5), -1)
    layout[3, 0], layout[3, 2], layout[1, 1] = 0, 1, 2
    cells = np.array([[0, 0], [4, 0], [3, 0], [3, 1], [3, 2]])
    return Episode(
        formula="(achieve a; achieve b) or achieve c",
        tree=tree_of([(0, "a", ""), (0, "c", ""), (1, "b", "d")]),
        stage=LetterStage(layout),
        positions=cells,
        nodes=np.array([0, 0, 1, 1, 3]),
        assigned=np.array([1, 1, 3, 3]),
        success=True,
        violated=False,
    )


def test_a_flat_policy_is_shown_by_what_it_completed(episode: Episode) -> None:
    flat = dataclasses.replace(episode, assigned=np.zeros(4, int))
    assert [leg.label for leg in flat.legs(NAMES)] == ["1. a, avoiding c", "2. b, avoiding d"]
    unfinished = dataclasses.replace(flat, nodes=np.array([0, 0, 1, 1, 1]), success=False)
    expected = [("1. a, avoiding c", True), ("2. what remains", False)]
    assert [(leg.label, leg.reached) for leg in unfinished.legs(NAMES)] == expected


def test_a_trajectory_names_its_subtasks(episode: Episode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    labels: list[str] = []
    circles: list[tuple[float, float]] = []
    plot = Axes.plot

    def spy(self: Axes, *args: object, **options: object) -> object:
        if options.get("label"):
            labels.append(str(options["label"]))
        if options.get("markersize") == 30:
            circles.append((float(args[0]), float(args[1])))  # type: ignore[arg-type]
        return plot(self, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Axes, "plot", spy)
    with Image.open(plots.trajectory(episode, NAMES, tmp_path / "t.png")) as image:
        assert image.format == "PNG"
    assert labels == ["1. a, avoiding c", "2. b, avoiding d"]
    assert circles == [(0, 3), (2, 3)]  # column, row of a and of b


@pytest.mark.parametrize("number", [1, 4])
def test_a_gallery_holds_every_episode(number: int, episode: Episode, tmp_path: Path) -> None:
    with Image.open(plots.gallery([episode] * number, NAMES, tmp_path / "g.png")) as image:
        assert image.width > min(number, 3) * 400
        assert image.height > -(-number // 3) * 400
    drawn = [plots.gallery([episode] * number, NAMES, tmp_path / "g.svg").read_bytes() for _ in range(2)]
    assert drawn[0] == drawn[1]
    assert drawn[0].startswith(b"<?xml")


def test_a_task_graph(episode: Episode, tmp_path: Path) -> None:
    with Image.open(plots.task_graph(episode, NAMES, tmp_path / "g.png")) as image:
        assert min(image.size) > 100


def test_an_animation_has_a_frame_for_each_state(episode: Episode, tmp_path: Path) -> None:
    with Image.open(plots.animation(episode, NAMES, tmp_path / "e.gif")) as image:
        assert image.format == "GIF"
        assert image.n_frames == len(episode.positions)
        frames = []
        for i in range(image.n_frames):
            image.seek(i)
            frames.append(np.asarray(image.convert("RGB"), int))
    size = 5 * LetterStage(np.zeros((5, 5))).cell
    assert all(frame.shape == (size + 28, size, 3) for frame in frames)
    assert all((first != second).any() for first, second in itertools.pairwise(frames))


def test_learning_curves_of_several_runs(tmp_path: Path) -> None:
    rows = [{"env_steps": step, "eval/success_rate": step / 100, "eval/spl": None, "level": 1} for step in (0, 50, 100)]
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    assert plots.learning_curves({"a": rows}, one) == one
    plots.learning_curves({"a": rows, "b": rows[:2]}, two)
    plots.learning_curves({"a": []}, tmp_path / "none.png")
    assert one.read_bytes() != two.read_bytes()


@pytest.mark.parametrize("name", ["walk", "flatworld", "zone"])
def test_worlds_of_discs_are_drawn_from_above(name: str, tmp_path: Path) -> None:
    """A long straight way: fewer frames than steps, every sub-task named, goals where regions are."""
    env = envs_jax.make(name)
    layout = jax.tree.map(np.asarray, env.sample_layout(jax.random.key(0), env.default_params))
    stage = stage_of(env, layout)
    assert stage is not None
    way = np.linspace([0, 0, 0], [1.5, 1, 1], 301)[:, : 3 if name == "zone" else 2]
    episode = Episode(
        formula="one; other",
        tree=tree_of([(0, "a", ""), (1, "b", "c")], num_propositions=env.num_propositions),
        stage=stage,
        positions=way,
        nodes=np.repeat([0, 1, 2], [150, 150, 1]),
        assigned=np.repeat([1, 2], 150),
        success=True,
        violated=False,
    )
    names = env.propositions
    assert [leg.label for leg in episode.legs(names)] == [f"1. {names[0]}", f"2. {names[1]}, avoiding {names[2]}"]
    with Image.open(plots.trajectory(episode, names, tmp_path / "t.png")) as image:
        assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    with Image.open(plots.animation(episode, names, tmp_path / "e.gif")) as image:
        assert 50 < image.n_frames <= 81
