"""Rooms against a plain reading of its walls, its door and its key, and its exact steps against a search."""

from __future__ import annotations

from collections import deque
from typing import Any

import jax
import numpy as np
import pytest

from envs_jax.rooms.world import COLUMNS, DOORS, MIDDLE, ROWS, Rooms, fewest_steps
from tests.probes import quick_jit

ENV = Rooms()
PARAMS = ENV.default_params


def layouts(number: int = 50) -> list[Any]:
    drawn = jax.vmap(ENV.sample_layout, (0, None))(jax.random.split(jax.random.key(0), number), PARAMS)
    return [jax.tree.map(lambda x, i=i: np.asarray(x)[i], drawn) for i in range(number)]


def plain_step(layout: Any, here: tuple[int, int], has_key: bool, action: int) -> tuple[tuple[int, int], bool]:
    row, column = here[0] + (-1, 1, 0, 0)[action], here[1] + (0, 0, -1, 1)[action]
    door = (MIDDLE, DOORS[0]), (MIDDLE, DOORS[1])
    wall = column in DOORS and (row, column) not in (door if has_key else door[:1])
    there = here if wall or not (0 <= row < ROWS and 0 <= column < COLUMNS) else (row, column)
    return there, has_key or there == tuple(layout.key)


def test_rooms_walls_and_the_locked_door() -> None:
    step = quick_jit(ENV.step_env)
    rng = np.random.default_rng(0)
    opened = 0
    for layout in layouts(20):
        ENV.check_layout(layout)
        _, state = ENV.reset_to(layout, jax.random.key(0), PARAMS)
        for _ in range(60):
            action = int(rng.choice(4, p=[0.2, 0.2, 0.2, 0.4]))
            expected = plain_step(layout, tuple(np.asarray(state.position).tolist()), bool(state.has_key), action)
            observation, state, reward, terminated, _, _ = step(jax.random.key(0), state, action, PARAMS)
            assert (tuple(np.asarray(state.position).tolist()), bool(state.has_key)) == expected
            assert (reward, terminated) == (0, False)
            assert observation[3].sum() == (not state.has_key)
            opened += int(state.position[1]) > DOORS[1]
    assert opened


@pytest.mark.parametrize("key_first", [True, False])
def test_fewest_steps_are_those_of_a_search(key_first: bool) -> None:
    """Breadth-first over cell, key, and whether red was visited; without the key before it unless it comes first."""
    for layout in layouts():
        start = (tuple(layout.start), False, False)
        queue, seen = deque([(start, 0)]), {start}
        while True:
            (here, has_key, done), steps = queue.popleft()
            if done and here == tuple(layout.blue):
                break
            for action in range(4):
                there, key = plain_step(layout, here, has_key, action)
                red = done or there == tuple(layout.red)
                skipped = key and not red if not key_first else red and not key
                if (there, key, red) not in seen and not skipped:
                    seen.add((there, key, red))
                    queue.append(((there, key, red), steps + 1))
        assert steps == fewest_steps(layout, key_first=key_first)


def test_layouts_out_of_their_rooms_are_refused() -> None:
    layout = layouts(1)[0]
    with pytest.raises(ValueError, match="blue is not in room 3"):
        ENV.check_layout(layout.replace(blue=layout.red))
