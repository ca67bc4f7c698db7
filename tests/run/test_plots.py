"""Pictures: the files are there, of the right form, and show what happened."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import envs_jax
from envs_jax.scenes import GridScene, Leg
from hrlspec.agent.agent import Agent
from hrlspec.config import Config, NetworkConfig
from hrlspec.evaluation import suite_from_text
from hrlspec.methods import METHODS
from hrlspec.run import plots
from hrlspec.run.plots import Episode
from hrlspec.run.timeline import Timeline
from hrlspec.tasks.rewards import reward_machine
from tests.bare import Bare
from tests.probes import Corridor, random_params
from tests.trees import tree_of

NAMES = tuple("abcde")
SMALL = Config(
    network=NetworkConfig(latent=8, conv_channels=(), encoder_mlp=(8,), actor=(8,), critic=(8,), task_rounds=0)
)


@pytest.fixture
def episode() -> Episode:
    """Down over the edge of the torus onto a, then right to b; c is the other branch."""
    rows = ("", "", "", "", ""), ("", "c", "", "", ""), ("a", "", "b", "", "")
    scene = GridScene((rows[0], rows[1], rows[0], rows[2], rows[0]))
    cells = np.array([[0, 0], [4, 0], [3, 0], [3, 1], [3, 2]])
    return Episode(
        formula="(achieve a; achieve b) or achieve c",
        tree=tree_of([(0, "a", ""), (0, "c", ""), (1, "b", "d")]),
        scene=scene,
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
    with Image.open(plots.animation([episode], NAMES, tmp_path / "e.gif")) as image:
        assert image.format == "GIF"
        assert image.n_frames == len(episode.positions)
        frames = []
        for i in range(image.n_frames):
            image.seek(i)
            frames.append(np.asarray(image.convert("RGB"), int))
    size = 5 * 48
    assert all(frame.shape == (size + 28, size, 3) for frame in frames)
    assert all((first != second).any() for first, second in itertools.pairwise(frames))


def test_animations_of_several_episodes_follow_each_other(episode: Episode, tmp_path: Path) -> None:
    with Image.open(plots.animation([episode, episode], NAMES, tmp_path / "e.gif")) as image:
        assert image.n_frames == 2 * len(episode.positions)
        pauses = []
        for i in range(image.n_frames):
            image.seek(i)
            pauses.append(image.info["duration"])
    assert pauses == [*[350] * 4, 1500] * 2


def test_a_video_shows_what_the_animation_does(episode: Episode, tmp_path: Path) -> None:
    """Read back: each state for as long, in nearly the same colours."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    gif = plots.animation([episode], NAMES, tmp_path / "e.gif")
    video = plots.animation([episode], NAMES, tmp_path / "e.mp4")
    assert sorted(tmp_path.iterdir()) == [gif, video]
    read = [ffmpeg, "-v", "error", "-i", str(video), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    content = subprocess.run(read, capture_output=True, check=True).stdout
    with Image.open(gif) as image:
        stills = []
        for i in range(image.n_frames):
            image.seek(i)
            stills.append(np.asarray(image.convert("RGB"), int))
    frames = np.frombuffer(content, np.uint8).reshape(-1, *stills[0].shape).astype(int)
    assert len(frames) == pytest.approx(25 * (4 * 0.35 + 1.5), abs=1)
    for number, frame in enumerate(frames):
        differences = [np.abs(frame - still).mean() for still in stills]
        assert np.argmin(differences) == pytest.approx(min(number / 25 / 0.35, 4), abs=1)
        assert min(differences) < 4


def test_what_the_encoder_says_is_told(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    with pytest.raises(OSError, match="Error opening input"):
        plots._encode(b"no animation", tmp_path / "e.mp4")


@pytest.mark.parametrize("name", ["flatworld", pytest.param("zone", marks=pytest.mark.slow)])
def test_worlds_of_discs_are_drawn_from_above(name: str, tmp_path: Path) -> None:
    """A long straight line: fewer frames than steps, every sub-task named, goals where regions are."""
    env = envs_jax.make(name)
    layout = jax.tree.map(np.asarray, env.sample_layout(jax.random.key(0), env.default_params))
    assert isinstance(env, envs_jax.Drawable)
    line = np.linspace([0, 0, 0], [1.5, 1, 1], 301)[:, : 3 if name == "zone" else 2]
    episode = Episode(
        formula="one; other",
        tree=tree_of([(0, "a", ""), (1, "b", "c")], num_propositions=env.num_propositions),
        scene=env.scene(layout),
        positions=line,
        nodes=np.repeat([0, 1, 2], [150, 150, 1]),
        assigned=np.repeat([1, 2], 150),
        success=True,
        violated=False,
    )
    names = env.propositions
    assert [leg.label for leg in episode.legs(names)] == [f"1. {names[0]}", f"2. {names[1]}, avoiding {names[2]}"]
    with Image.open(plots.trajectory(episode, names, tmp_path / "t.png")) as image:
        assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    with Image.open(plots.animation([episode], names, tmp_path / "e.gif")) as image:
        assert 50 < image.n_frames <= 81


# --- Environments that do not say what they look like. ---

NOWHERE, A, B = (0, 0, 0), (1, 0, 0), (0, 1, 0)
HELD = np.array([NOWHERE, NOWHERE, A, NOWHERE, B], bool)
LEGS = [Leg(0, 1, "1. a, avoiding c", ("a",), ("c",), True), Leg(2, 3, "2. b", ("b",), (), True)]


def test_a_timeline_shows_what_held_what_was_asked_and_when_it_moved_on() -> None:
    ax = Figure().subplots()
    Timeline(("a", "b", "c")).draw(ax, HELD, LEGS)
    bars = [(round(bar.get_y() + bar.get_height() / 2), bar.get_x(), bar.get_width()) for bar in ax.patches]
    assert bars[:2] == [(0, 1.5, 1.0), (1, 3.5, 1.0)]  # a held before step 2, b after the last
    assert (0, 0, 2) in bars  # a was to be reached in steps 0 and 1
    assert (2, 0, 2) in bars  # and c to be avoided
    assert (1, 2, 2) in bars
    assert [(x, row, width) for row, x, width in bars if row == 3] == [(0, 3, 2), (2, 3, 2)]  # sub-tasks
    assert [line.get_xdata()[0] for line in ax.lines] == [2, 4]
    assert ax.get_legend_handles_labels()[1] == [leg.label for leg in LEGS]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["a", "b", "c", "sub-task"]


def test_a_frame_of_a_timeline_shows_no_more_than_has_happened() -> None:
    line = Timeline(("a", "b", "c"))
    frames = [line.frame(HELD, now, LEGS[min(now // 2, 1)] if now < 4 else None) for now in range(5)]
    assert len({frame.shape for frame in frames}) == 1
    dark = [(frame[:, 120:] < 60).all(-1).reshape(3, 22, -1).any((1, 2)).tolist() for frame in frames]
    assert dark == [[False] * 3] * 2 + [[True, False, False]] * 2 + [[True, True, False]]
    background = [frame[3, -3].tolist() for frame in frames]
    assert background[0] == background[1] != background[2] == background[4]  # a is asked for in the first leg alone


def test_any_environment_is_drawn(tmp_path: Path) -> None:
    """With nothing but the contract: what an untrained agent does, as picture and animation."""
    env = Corridor(horizon=6)
    assert not isinstance(env, envs_jax.Drawable)
    agent = Agent(env, SMALL, METHODS["ltl2action"])
    suite = suite_from_text("two", "achieve a\nachieve b; achieve c", env.propositions)
    params = random_params(agent, 0)
    machine = reward_machine(env.propositions)
    shown = plots.episodes_of(jax.random.key(0), agent, params, machine, suite)
    for episode in shown:
        assert episode.scene == Timeline(env.propositions)
        assert episode.positions.shape == (len(episode.assigned) + 1, 4) or len(episode.assigned) == env.horizon - 1
        assert episode.positions.dtype == bool
    files = plots.examples(jax.random.key(0), agent, params, machine, suite, tmp_path)
    assert sorted(file.name for file in files) == sorted(
        [*(f"{kind}_{depth}.png" for kind in ("example", "task") for depth in (1, 2)), "episode.gif"]
    )
    for file in files:
        with Image.open(file) as image:
            assert min(image.size) > 80


def test_positions_are_those_of_the_labels(tmp_path: Path) -> None:
    """A letter holds on the timeline just when the same episode's place in the scene bears it."""
    letter = envs_jax.make("letter", horizon=20)
    suite = suite_from_text("one", "achieve a; achieve b", letter.propositions)
    machine = reward_machine(letter.propositions)
    key = jax.random.key(1)
    (seen,), (bare,) = (
        plots.episodes_of(key, agent, random_params(agent, 1), machine, suite)
        for agent in (Agent(env, SMALL, METHODS["ltl2action"]) for env in (letter, Bare(letter)))
    )
    scene = seen.scene
    assert isinstance(scene, GridScene)
    names = [scene.cells[row][column] for row, column in seen.positions]
    assert names == ["".join(np.array(list(letter.propositions))[held]) for held in bare.positions]
    assert any(names)
