"""Layouts where nearest-first loses: the loss, by brute force, and what is drawn."""

from __future__ import annotations

import jax
import numpy as np

import envs_jax
from envs_jax.letter.contested import FAR, most_contested, myopia_regret
from tests.probes import quick_jit

ENV = envs_jax.make("letter", size=5, num_letters=3, num_cells=6)


def apart(x: np.ndarray, y: np.ndarray) -> int:
    gap = np.abs(x - y)
    return int(np.minimum(gap, ENV.size - gap).sum())


def brute_force(layout: np.ndarray, first: int, second: int) -> int:
    ways = []
    for x in np.argwhere(layout == first):
        near = apart(np.zeros(2, int), x)
        ways.append((near, near + min([apart(x, y) for y in np.argwhere(layout == second)], default=FAR)))
    nearest = min((near for near, _ in ways), default=0)
    worst = max((total for near, total in ways if near == nearest), default=0)
    return worst - min((total for _, total in ways), default=0)


def layouts(count: int) -> np.ndarray:
    draw = quick_jit(jax.vmap(ENV.sample_layout, (0, None)))
    return np.asarray(draw(jax.random.split(jax.random.key(0), count), ENV.default_params))


def test_regret_is_what_nearest_first_loses() -> None:
    drawn = layouts(200)
    found = np.asarray(quick_jit(jax.vmap(lambda x: myopia_regret(x, 3)))(drawn))
    for layout, regret in zip(drawn, found, strict=True):
        for first, second in [(0, 1), (1, 0), (0, 2), (2, 1)]:
            assert regret[first, second] == brute_force(layout, first, second)
    assert (found[:, 0, 1] > 0).any()
    assert (found[:, 0, 1] == 0).any()


def test_a_missing_letter_has_no_regret() -> None:
    layout = np.full((5, 5), -1, np.int8)
    layout[1, 2] = layout[3, 3] = 0
    regret = np.asarray(myopia_regret(layout, 3))
    assert not regret[:, 1:].any()
    assert not regret[1:].any()


def test_the_pair_with_the_largest_regret_is_picked() -> None:
    regret = np.arange(9, dtype=np.int8).reshape(3, 3)
    first, second = most_contested(jax.random.key(0), jax.numpy.asarray(regret), 200)
    assert (first, second) == (2, 1)  # the diagonal is no pair


def test_contested_layouts_lose_more_and_have_the_same_letters() -> None:
    params = ENV.default_params
    wanted = np.eye(3, dtype=bool)
    draw = quick_jit(jax.vmap(ENV.contested_layout, (0, None, None, None)))
    keys = jax.random.split(jax.random.key(1), 200)
    drawn = np.asarray(draw(keys, wanted[2], wanted[0], params))
    assert all((np.bincount(x[x >= 0], minlength=3) == 2).all() for x in drawn)
    assert (drawn[:, 0, 0] == -1).all()
    lost = np.mean([brute_force(x, 2, 0) for x in drawn])
    plain = np.mean([brute_force(x, 2, 0) for x in layouts(200)])
    assert lost > 2 * plain


def test_without_a_second_goal_the_layout_is_a_plain_one() -> None:
    params, nothing, key = ENV.default_params, np.zeros(3, bool), jax.random.key(2)
    plain = ENV.contested_layout(key, nothing, nothing, params)
    for first, second in [(nothing, ~nothing), (~nothing, nothing)]:
        np.testing.assert_array_equal(ENV.contested_layout(key, first, second, params), plain)
