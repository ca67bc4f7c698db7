"""Layouts changed by hand: what was moved lies where it was put, the rest as before; what cannot be is refused."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

import envs_jax

WORLDS = ("letter", "walk", "flatworld", "zone", "zone-ltl2action", "zone-jaxolotl")


def world(name: str) -> tuple[envs_jax.Rearrangeable, Any]:
    """A world and a layout of it."""
    env = envs_jax.make(name)
    assert isinstance(env, envs_jax.Rearrangeable)
    return env, jax.tree.map(np.asarray, env.sample_layout(jax.random.key(3), env.default_params))


def places_of(env: envs_jax.Rearrangeable, layout: Any) -> np.ndarray:
    return np.array([thing.place for thing in env.things(layout)], float)


@pytest.mark.parametrize("name", WORLDS)
def test_what_stays_where_it_is_changes_nothing(name: str) -> None:
    env, layout = world(name)
    same = env.rearranged(layout, places_of(env, layout))
    for new, old in zip(jax.tree.leaves(same), jax.tree.leaves(layout), strict=True):
        np.testing.assert_array_equal(new, old)
        assert new.dtype == old.dtype


@pytest.mark.parametrize("name", WORLDS)
def test_things_are_where_the_scene_has_them_and_the_way_there_leads_back(name: str) -> None:
    env, layout = world(name)
    scene, places = env.scene(layout), places_of(env, layout)
    outline = scene.outline()
    assert outline is not None
    drawn = {(shape.name, round(shape.x, 5), round(shape.y, 5)) for shape in outline.shapes}
    inside = scene.in_outline(places)
    for thing, (x, y) in zip(env.things(layout), inside.tolist(), strict=True):
        assert not thing.name or (thing.name, round(x, 5), round(y, 5)) in drawn
    np.testing.assert_allclose(scene.from_outline(inside), places, atol=1e-9)


def test_a_letter_moves_and_two_change_places() -> None:
    env, layout = world("letter")
    places = places_of(env, layout)
    free = np.argwhere(layout == -1)[-1]
    moved = env.rearranged(layout, np.concatenate([[free], places[1:]]))
    first = tuple(places[0].astype(int))
    assert moved[tuple(free)] == layout[first]
    assert moved[first] == -1
    assert (moved != layout).sum() == 2
    swapped = env.rearranged(layout, places[[1, 0, *range(2, len(places))]])
    assert swapped[first] == layout[tuple(places[1].astype(int))]


def test_the_agent_begins_where_it_was_put() -> None:
    for name, place in (("walk", (2.5, 7.0)), ("zone", (0.1, -2.9))):
        env, layout = world(name)
        places = places_of(env, layout)
        places[-1] = place
        moved = env.rearranged(layout, places)
        _, state = env.reset_to(moved, jax.random.key(0), env.default_params)
        np.testing.assert_allclose(env.position(state)[:2], place, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "thing", "place", "message"),
    [
        ("letter", 0, (0, 0), "the start cell"),
        ("letter", 0, (7, 1), "outside of the grid"),
        ("letter", 0, (-1, 1), "outside of the grid"),
        ("letter", 0, None, "two letters are in one cell"),
        ("walk", 0, (5.1, 3.1), "is in the region of a"),
        ("walk", 0, (11, 3), "outside of the square"),
        ("zone", 0, None, "two zones overlap"),
        ("zone", 0, (3.4, 0), "outside the square"),
        ("zone", -1, (0, 3.3), "the robot starts at"),
        ("zone-jaxolotl", 3, None, "two zones overlap"),
        ("zone-jaxolotl", -1, (0, 3.31), "the robot starts at"),
    ],
)
def test_what_cannot_lie_there_is_refused(
    name: str, thing: int, place: tuple[float, float] | None, message: str
) -> None:
    """Without a place: where another thing is."""
    env, layout = world(name)
    places = places_of(env, layout)
    places[thing] = places[1] if place is None else place
    with pytest.raises(ValueError, match=message):
        env.rearranged(layout, places)
