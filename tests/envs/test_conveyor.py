"""Conveyor against moves worked out by hand, and a search over its graph."""

from __future__ import annotations

from collections import deque
from typing import Any

import jax
import numpy as np
import pytest

from envs_jax.conveyor.world import DOWN, LEFT, RIGHT, UP, Conveyor, names
from tests.probes import quick_jit

SIMPLE, ROOM = Conveyor(k=2, simple=True), Conveyor(k=2)


def play(env: Conveyor, actions: list[int]) -> tuple[list[tuple[int, int]], list[set[str]]]:
    """Cells and items after each action."""
    params = env.default_params
    step, labels = quick_jit(env.step_env), quick_jit(env.labels)
    _, state = env.reset_to(env.sample_layout(jax.random.key(0), params), jax.random.key(0), params)
    cells, items = [], []
    for number, action in enumerate(actions, 1):
        observation, state, reward, terminated, truncated, _ = step(jax.random.key(0), state, action, params)
        np.testing.assert_array_equal(observation, state.position)
        assert (reward, terminated, truncated) == (0, False, number == env.horizon)
        cells.append(tuple(np.asarray(state.position).tolist()))
        items.append({name for name, holds in zip(env.propositions, labels(state, params), strict=True) if holds})
    return cells, items


def test_one_column() -> None:
    """Items a at one, then b below and c above at two; no way back, no way aside."""
    cells, items = play(SIMPLE, [RIGHT, UP, DOWN, LEFT, UP, UP, DOWN])
    assert cells == [(1, 3), (1, 4), (1, 4), (1, 4), (1, 5), (1, 5), (1, 5)]
    assert items == [set(), {"a"}, {"a"}, {"a"}, {"c"}, {"c"}, {"c"}]
    cells, items = play(SIMPLE, [DOWN, UP, DOWN])
    assert (cells, items) == ([(1, 2), (1, 2), (1, 1)], [{"a"}, {"a"}, {"b"}])


def test_two_corridors() -> None:
    to_the_belt = [DOWN, DOWN, DOWN, DOWN, RIGHT, RIGHT, RIGHT]
    cells, items = play(ROOM, [*to_the_belt, LEFT, UP, RIGHT, LEFT, RIGHT, RIGHT, UP, UP, DOWN, RIGHT, RIGHT, RIGHT])
    assert cells[:7] == [(0, 3), (0, 2), (0, 1), (0, 1), (1, 1), (2, 1), (3, 1)]  # below (0, 1) there is a wall
    assert cells[7:9] == [(3, 1)] * 2  # not against the belt, and not through the wall
    assert cells[9:] == [(4, 1), (4, 1), (5, 1), (6, 1), (6, 2), (6, 2), (6, 1), (7, 1), (8, 1), (8, 1)]
    assert items[-3:] == [{"a"}, {"b"}, {"b"}]
    cells, items = play(ROOM, [RIGHT, RIGHT, RIGHT, UP, UP, UP, *[RIGHT] * 6])
    assert cells[2] == (2, 4)  # a wall
    assert (cells[5], cells[-1]) == ((2, 7), (8, 7))
    assert items[-2:] == [{"a"}, {"c"}]


def fewest(env: Conveyor, wanted: tuple[str, ...]) -> int | None:
    """Steps to items in their order, by breadth-first search; ``None`` if they cannot be reached."""
    successors, labels, start = map(
        np.asarray, env.transition_table(env.sample_layout(jax.random.key(0), env.default_params), env.default_params)
    )
    first = (int(start), 0)
    queue: deque[tuple[tuple[int, int], int]] = deque([(first, 0)])
    seen = {first}
    while queue:
        (cell, done), steps = queue.popleft()
        if done == len(wanted):
            return steps
        for there in successors[cell].tolist():
            after = (there, done + bool(labels[there, env.propositions.index(wanted[done])]))
            if after not in seen:
                seen.add(after)
                queue.append((after, steps + 1))
    return None


@pytest.mark.parametrize(("env", "shortest"), [(Conveyor(k=k, simple=True), k) for k in (1, 2, 8, 32)])
def test_either_chain_takes_k_steps_in_one_column(env: Conveyor, shortest: int) -> None:
    check_chains(env, shortest)


@pytest.mark.parametrize(("env", "shortest"), [(Conveyor(k=k), k + 9) for k in (1, 2, 10)])
def test_either_chain_takes_nine_steps_more_from_the_room(env: Conveyor, shortest: int) -> None:
    check_chains(env, shortest)


def check_chains(env: Conveyor, shortest: int) -> None:
    *items, below, above = env.propositions
    assert len(items) == env.k - 1
    for last in (below, above):
        assert fewest(env, (*items, last)) == shortest <= env.horizon
    assert fewest(env, (below, above)) is None


def test_names_and_sizes() -> None:
    assert names(33)[24:29] == ("y", "z", "aa", "ab", "ac")
    assert (Conveyor(k=32, simple=True).horizon, Conveyor(k=4, simple=True).horizon, Conveyor(k=10).horizon) == (
        128,
        50,
        50,
    )
    assert SIMPLE.map.shape == (3, 7)
    assert ROOM.map.shape == (9, 9)
    for k in (0, 33):
        with pytest.raises(ValueError, match=f"k is {k}, expected 1 to 32"):
            Conveyor(k=k)


@pytest.mark.parametrize("env", [SIMPLE, ROOM])
def test_the_picture_shows_what_there_is(env: Conveyor) -> None:
    params = env.default_params
    layout: Any = jax.tree.map(np.asarray, env.sample_layout(jax.random.key(0), params))
    env.check_layout(layout)
    scene = env.scene(layout)
    height, width = scene.shape
    assert (width, height) == env.map.shape
    for (x, y), item in env.map.items.items():
        assert scene.cells[height - 1 - y][x] == item
    assert len(scene.walls) == width * height - len(env.map.free)
    _, state = env.reset_to(layout, jax.random.key(0), params)
    row, column = np.asarray(env.position(state)).tolist()
    assert (column, height - 1 - row) == env.map.start
    with pytest.raises(ValueError, match="is a wall or outside"):
        env.check_layout(layout.replace(start=np.array([99, 0], np.int32)))
