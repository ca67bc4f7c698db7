"""Scenes: what frames show, pixel by pixel, and what is drawn of an episode on axes."""

from __future__ import annotations

import string
from typing import Any

import jax
import numpy as np
import pytest

import envs_jax
from envs_jax.rooms.world import DOORS, MIDDLE, Rooms
from envs_jax.scenes import DiscScene, GridScene, Leg, Region
from envs_jax.scenes.glyphs import color_of, glyph

LEG = Leg(0, 0, "1. somewhere", (), (), reached=False)


def avoiding(*names: str) -> Leg:
    return Leg(0, 0, "1. somewhere", (), names, reached=False)


def scene_of(env: envs_jax.Environment) -> Any:
    assert isinstance(env, envs_jax.Drawable)
    return env.scene(jax.tree.map(np.asarray, env.sample_layout(jax.random.key(0), env.default_params)))


def cells_of(scene: GridScene, positions: Any, now: int) -> np.ndarray:
    """A frame as ``[H, W, pixels, pixels, 3]``."""
    (height, width), side = scene.shape, scene.cell_pixels
    image = scene.frame(np.asarray(positions), now, None)
    assert image.dtype == np.uint8
    return image.reshape(height, side, width, side, 3).transpose(0, 2, 1, 3, 4)


def test_letters_and_colours_can_be_told_apart() -> None:
    letters = string.ascii_lowercase
    assert len({glyph(letter, 48).tobytes() for letter in letters}) == 26
    assert len({color_of(letter) for letter in letters}) == 26
    assert color_of("red")[0] > 2 * color_of("red")[2]
    assert not glyph("7", 48).any()


def test_what_differs_in_a_grid() -> None:
    scene = GridScene((("", "", ""), ("", "", "e"), ("", "", "")), cell_pixels=20)
    cells = cells_of(scene, [(0, 0), (0, 1)], 1)
    assert (cells[1, 2] == color_of("e")).all(-1).mean() > 0.5
    empty = cells[2, 2]
    assert [tuple(cell) for cell in np.argwhere((cells != empty).any((2, 3, 4))).tolist()] == [(0, 0), (0, 1), (1, 2)]


def test_grids_that_cannot_be_drawn() -> None:
    with pytest.raises(ValueError, match=r"rows of \[2, 1\] cells"):
        GridScene((("", ""), ("",)))
    with pytest.raises(ValueError, match="cell_pixels is 5"):
        GridScene((("",),), cell_pixels=5)
    with pytest.raises(ValueError, match=r"at \[3, 0\]"):
        GridScene((("",) * 3,) * 3).frame(np.array([[3, 0]]), 0, None)


def test_the_scene_of_letter_is_its_layout() -> None:
    env = envs_jax.make("letter", size=3, num_letters=2, num_cells=2)
    scene = env.scene(np.array([[-1, 1, -1], [-1, -1, -1], [0, -1, -1]]))  # type: ignore[attr-defined]
    assert scene.cells == (("", "b", ""), ("", "", ""), ("a", "", ""))


def test_the_scene_of_rooms() -> None:
    env = Rooms()
    layout = jax.tree.map(np.asarray, env.sample_layout(jax.random.key(1), env.default_params))
    scene = env.scene(layout)
    found = {name: (i, j) for i, row in enumerate(scene.cells) for j, name in enumerate(row) if name}
    assert found == {
        "red": tuple(layout.red.tolist()),
        "blue": tuple(layout.blue.tolist()),
        "key": tuple(layout.key.tolist()),
        "door": (MIDDLE, DOORS[1]),
    }
    assert set(scene.walls) == {(row, column) for row in (0, 2) for column in DOORS}
    assert cells_of(scene, [layout.start], 0).shape[:2] == scene.shape == (3, 11)


def test_regions_of_the_picture_and_the_agent() -> None:
    walk = scene_of(envs_jax.make("walk"))
    scene = DiscScene(walk.regions, walk.low, walk.high, pixels=220)  # twenty pixels for each unit
    path = np.array([(3.0, 7.0), (2.0, 5.0)])
    image = scene.frame(path, 1, LEG)
    assert image.shape == (220, 220, 3)
    assert image.dtype == np.uint8

    def at(x: float, y: float) -> list[int]:
        return image[int((10 - y) * 20), int((x + 1) * 20)].tolist()

    background = at(3.0, -0.5)
    assert at(2.0, 5.0) != background  # the agent
    assert at(3.0, 7.0) == at(2.0, 5.0)  # the trail
    # Beside the middle, where the letter stands.
    colours = {region.name: at(region.x + 0.7, region.y) for region in scene.regions}
    assert len({tuple(colour) for colour in colours.values()}) == 5
    assert background not in colours.values()
    assert at(5.1, 4.5) == background == at(7.0, 4.0)
    differs = (scene.frame(path[1:], 0, LEG) != image).any(-1)
    assert 0 < differs.sum() < 40
    assert all(abs(row - 60) <= 4 and abs(column - 80) <= 4 for row, column in np.argwhere(differs))


def test_avoided_regions_and_headings_show() -> None:
    env = envs_jax.make("flatworld")
    scene = scene_of(env)
    assert len(scene.regions) == 9
    assert {region.name for region in scene.regions} == set(env.propositions)
    plain = scene.frame(np.array([[1.9, 1.9]]), 0, LEG)

    def changed(position: tuple[float, ...], leg: Leg) -> tuple[np.ndarray, np.ndarray]:
        row, column = np.argwhere((scene.frame(np.array([position]), 0, leg) != plain).any(-1)).T
        return -2 + column / 84, 2 - row / 84

    x, y = changed((1.9, 1.9), avoiding("yellow"))
    assert len(x) > 50
    assert (np.hypot(x + 1.0, y + 1.2) < 0.32).all()
    x, _ = changed((1.9, 1.9, np.pi), LEG)
    assert len(x) > 5
    assert x.max() < 1.9


@pytest.mark.parametrize("name", ["letter", "walk", "zone"])
def test_an_outline_is_the_picture_upside_down(name: str) -> None:
    """What is shown of a place in a frame is there in the outline, whose y points down as the rows of a frame do."""
    env = envs_jax.make(name)
    scene = scene_of(env)
    outline = scene.outline()
    assert {shape.name for shape in outline.shapes} == {*env.propositions}
    empty = np.array([[0, 0]]) if name == "letter" else np.array([[scene.high, scene.high, 0.5]])
    image = scene.frame(empty, 0, None)
    height, width, _ = image.shape
    for shape in outline.shapes:  # beside the middle, where the letter stands
        x, y = shape.x + 0.8 * shape.radius, shape.y
        seen = image[int(y * height / outline.height), int(x * width / outline.width)]
        top = [some for some in outline.shapes if np.hypot(some.x - x, some.y - y) < some.radius]
        assert seen.tolist() == pytest.approx(color_of(top[-1].name), abs=70)
        assert shape.color in (None, color_of(shape.name))


@pytest.mark.parametrize("name", ["letter", "walk", "flatworld", "zone"])
def test_an_agent_lies_in_the_outline_where_it_lies_in_the_scene(name: str) -> None:
    env = envs_jax.make(name)
    scene = scene_of(env)
    outline = scene.outline()
    if isinstance(scene, GridScene):
        places = np.argwhere(np.array(scene.cells) != "")
        names = [scene.cells[row][column] for row, column in places]
    else:
        places = np.array([(region.x, region.y, 0.3) for region in scene.regions])
        names = [region.name for region in scene.regions]
    found = scene.in_outline(places)
    assert [(shape.name, shape.x, shape.y) for shape in outline.shapes] == [
        (name, x, y) for name, (x, y) in zip(names, found[:, :2].tolist(), strict=True)
    ]
    assert (found[:, 2:] == -0.3).all()  # which is counted the other way round
    assert (found[:, :2] >= 0).all()
    assert (found[:, :2] <= (outline.width, outline.height)).all()


def test_which_region_of_a_name_was_reached() -> None:
    scene = scene_of(envs_jax.make("flatworld"))
    (reached,) = scene.index_at((0.5, -1.3), ("red", "blue"))
    assert scene.regions[reached].name == "red"
    assert scene.regions[reached].y < 0  # the lower one of two
    assert scene.index_at((0.5, -1.3), ("blue",)) == ()


def test_discs_that_cannot_be_drawn() -> None:
    with pytest.raises(ValueError, match="pixels is 20"):
        DiscScene((), 0.0, 1.0, pixels=20)
    scene = DiscScene((Region("a", 0.5, 0.5, 0.2),), 0.0, 1.0)
    for position in ((0.0,), (0.0, np.nan)):
        with pytest.raises(ValueError, match="position is"):
            scene.frame(np.array([position]), 0, None)


def test_episodes_among_discs_on_axes() -> None:
    figure_module = pytest.importorskip("matplotlib.figure")
    scene = scene_of(envs_jax.make("walk"))
    ax = figure_module.Figure(figsize=(4, 4)).subplots()
    positions = np.stack([np.linspace(0, 5.1, 30), np.linspace(0, 3.1, 30)], 1)
    legs = [Leg(0, 19, "first", ("d",), ("c",), False), Leg(20, 28, "second", ("a",), (), True)]
    scene.draw(ax, positions, legs)
    _, labels = ax.get_legend_handles_labels()
    assert labels == ["first", "second"]
    circles = [patch for patch in ax.patches if hasattr(patch, "radius")]
    assert [circle.get_linewidth() > 1 for circle in circles] == [True, False, False, False, False]
    assert [bool(circle.get_hatch()) for circle in circles] == [False, False, True, False, False]
    lines = [line.get_xydata() for line in ax.lines if line.get_label() in labels]
    np.testing.assert_allclose(lines[0], positions[:21])
    np.testing.assert_allclose(lines[1], positions[20:])


@pytest.mark.parametrize("name", ["letter", "walk", "flatworld", "zone"])
def test_positions_lie_in_the_scene(name: str) -> None:
    """Where the agent is when a proposition holds, the scene shows it."""
    env = envs_jax.make(name)
    params = env.default_params
    layout = jax.tree.map(np.asarray, env.sample_layout(jax.random.key(0), params))
    _, state = env.reset_to(layout, jax.random.key(0), params)
    assert isinstance(env, envs_jax.Drawable)
    scene, step = env.scene(layout), jax.jit(env.step_env)
    held = 0
    for key in jax.random.split(jax.random.key(1), 150):
        _, state, *_ = step(key, state, env.action_space.sample(key), params)
        labels = np.asarray(env.labels(state, params))
        place = np.asarray(env.position(state))
        names = {env.propositions[i] for i in np.flatnonzero(labels)}
        if isinstance(scene, GridScene):
            assert {scene.cells[place[0]][place[1]]} - {""} == names
        else:
            assert {scene.regions[i].name for i in scene.index_at(place, env.propositions)} >= names
            assert scene.low <= place[:2].min() <= place[:2].max() <= scene.high
        held += len(names)
    assert held or name != "letter"  # in the other worlds a random walk stays near its start
