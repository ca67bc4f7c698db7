"""Letter against plain-Python readings of its rules."""

from __future__ import annotations

import collections
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import envs_jax
from tests.probes import quick_jit


def _layouts(env: envs_jax.Letter, number: int, seed: int = 0) -> np.ndarray:
    sample = jax.jit(jax.vmap(lambda key: env.sample_layout(key, env.default_params)))
    return np.asarray(sample(jax.random.split(jax.random.key(seed), number)))


def _reachable_letters(layout: np.ndarray) -> set[int]:
    """Letters met by a plain breadth-first search from (0, 0) that never goes on from a lettered cell."""
    n = len(layout)
    seen, queue, found = {(0, 0)}, collections.deque([(0, 0)]), set()
    while queue:
        i, j = queue.popleft()
        if layout[i][j] >= 0:
            found.add(int(layout[i][j]))
            continue
        for cell in ((i - 1) % n, j), ((i + 1) % n, j), (i, (j - 1) % n), (i, (j + 1) % n):
            if cell not in seen:
                seen.add(cell)
                queue.append(cell)
    return found


ENVS = [
    envs_jax.make("letter"),
    envs_jax.make("letter12"),
    envs_jax.make("letter", size=4, num_letters=3, num_cells=6),
    envs_jax.make("letter", size=6, num_letters=9, num_cells=18),
]


@pytest.mark.parametrize("env", ENVS, ids=lambda env: f"{env.size}x{env.num_letters}x{env.num_cells}")
def test_layouts_follow_the_rules(env: envs_jax.Letter) -> None:
    for layout in _layouts(env, 256):
        assert layout[0, 0] == -1
        assert np.bincount(layout[layout >= 0], minlength=env.num_letters).tolist() == (
            [env.num_cells // env.num_letters] * env.num_letters
        )
        assert _reachable_letters(layout) == set(range(env.num_letters))


@pytest.mark.parametrize("env", ENVS, ids=lambda env: f"{env.size}x{env.num_letters}x{env.num_cells}")
def test_reachability_agrees_with_a_plain_search(env: envs_jax.Letter) -> None:
    rng = np.random.default_rng(0)
    values = np.r_[np.repeat(np.arange(env.num_letters), env.num_cells // env.num_letters)]
    values = np.r_[values, np.full(env.size**2 - 1 - env.num_cells, -1)]
    layouts = np.stack([np.r_[-1, rng.permutation(values)].reshape(env.size, env.size) for _ in range(600)])
    # Dense ones too, or hardly any would be refused.
    layouts[::2] = np.where((layouts[::2] < 0) & (rng.random(layouts[::2].shape) < 0.3), 0, layouts[::2])
    layouts[:, 0, 0] = -1
    expected = [_reachable_letters(layout) == set(range(env.num_letters)) for layout in layouts]
    assert 0.02 < np.mean(expected) < 0.98
    assert np.array_equal(jax.jit(jax.vmap(env._all_reachable))(jnp.asarray(layouts, jnp.int8)), expected)


def test_layouts_are_uniform() -> None:
    """Every layout of a tiny world comes equally often, and none that leaves a letter out of reach comes at all."""
    env = envs_jax.make("letter", size=3, num_letters=2, num_cells=4)
    drawn = collections.Counter(layout.tobytes() for layout in _layouts(env, 8192))
    cells = [[-1, *rest] for rest in _arrangements([2, 2, 4])]
    possible = [np.array(one, np.int8).reshape(3, 3) for one in cells]
    allowed = [one.tobytes() for one in possible if _reachable_letters(one) == {0, 1}]
    assert set(drawn) <= set(allowed)
    assert stats.chisquare([drawn[one] for one in allowed]).pvalue > 1e-3


def test_letters_are_everywhere_equally_often() -> None:
    env = envs_jax.make("letter")
    layouts = _layouts(env, 6000)
    counts = np.stack([(layouts == i).sum(0).ravel()[1:] for i in range(5)])
    assert stats.chi2_contingency(counts).pvalue > 1e-3
    # Cells that touch the start are reached more surely, so only nearly uniform: 2/48 for each letter and cell.
    assert np.allclose(counts / 6000, 2 / 48, rtol=0.2)


def _arrangements(counts: list[int]):
    """All sequences with counts[0] zeros, counts[1] ones, and counts[2] times -1."""
    if not any(counts):
        yield []
    for i, value in enumerate((0, 1, -1)):
        if counts[i]:
            rest = [count - (j == i) for j, count in enumerate(counts)]
            yield from ([value, *tail] for tail in _arrangements(rest))


def test_moves_wrap_around() -> None:
    env = envs_jax.make("letter", size=4, num_letters=2, num_cells=2)
    layout = np.full((4, 4), -1, np.int8)
    layout[3, 0], layout[0, 3] = 0, 1
    expected = {
        0: ((3, 0), [True, False]),
        1: ((1, 0), [False] * 2),
        2: ((0, 3), [False, True]),
        3: ((0, 1), [False] * 2),
    }
    for action, (position, labels) in expected.items():
        _, state = env.reset_to(layout, jax.random.key(0), env.default_params)
        assert not env.labels(state, env.default_params).any()
        _, state, *_ = env.step_env(jax.random.key(0), state, jnp.int32(action), env.default_params)
        assert tuple(state.position.tolist()) == position
        assert env.labels(state, env.default_params).tolist() == labels


@pytest.mark.parametrize("size", [4, 7])
def test_observation_and_labels_along_a_walk(size: int) -> None:
    """Brute force: the cell seen at offset (i, j) from the middle is the cell that many moves away."""
    env = envs_jax.make("letter", size=size, num_letters=3, num_cells=6)
    params, rng = env.default_params, np.random.default_rng(0)
    layout = _layouts(env, 1)[0]
    step, labels = jax.jit(env.step_env), jax.jit(env.labels)
    observation, state = env.reset_to(layout, jax.random.key(0), params)
    row = column = 0
    for t in range(60):
        expected = np.zeros(env.observation_shape, np.float32)
        for i in range(size):
            for j in range(size):
                letter = layout[(row + i - size // 2) % size][(column + j - size // 2) % size]
                if letter >= 0:
                    expected[i, j, letter] = 1.0
        expected[size // 2, size // 2, -1] = 1.0
        np.testing.assert_array_equal(observation, expected)
        assert labels(state, params).tolist() == [layout[row, column] == i for i in range(3)]
        assert int(state.time) == t
        per_proposition, shared = env.proposition_view(observation)
        np.testing.assert_array_equal(per_proposition, expected[..., :-1].transpose(2, 0, 1))
        assert shared.shape == (0,)
        action = int(rng.integers(4))
        row, column = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)][action]
        row, column = row % size, column % size
        observation, state, *_ = step(jax.random.key(0), state, jnp.int32(action), params)


def test_transition_table_is_the_environment() -> None:
    env = envs_jax.make("letter", size=5)
    params, layout = env.default_params, _layouts(envs_jax.make("letter", size=5), 1)[0]
    successors, labels, start = env.transition_table(layout, params)
    assert int(start) == 0
    assert successors.shape == (25, 4)
    assert labels.shape == (25, 5)
    step_env = jax.jit(env.step_env)
    _, first = env.reset_to(layout, jax.random.key(0), params)
    for cell in range(25):
        state = first.replace(position=jnp.array(divmod(cell, 5), jnp.int32))
        assert int(env.graph_state(state)) == cell
        np.testing.assert_array_equal(labels[cell], env.labels(state, params))
        for action in range(4):
            _, after, *_ = step_env(jax.random.key(0), state, jnp.int32(action), params)
            assert int(successors[cell, action]) == int(after.position[0]) * 5 + int(after.position[1])


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"size": 1}, "size is 1"),
        ({"size": 33}, "size is 33"),
        ({"num_letters": 0}, "num_letters is 0"),
        ({"num_letters": 27, "num_cells": 27}, "num_letters is 27"),
        ({"num_cells": 11}, "num_cells is 11"),
        ({"num_cells": 0}, "num_cells is 0"),
        ({"size": 3, "num_cells": 10}, "fewer than the 9 cells"),
        ({"horizon": 0}, "horizon is 0"),
        ({"size": 3, "num_letters": 8, "num_cells": 8}, "out of reach"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(sizes: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        envs_jax.make("letter", **sizes)


def test_a_turned_world_is_the_same_world() -> None:
    """A step and then a turn shows what a turn and then the turned step shows."""
    env = envs_jax.make("letter")
    params, turns = env.default_params, env.symmetries
    assert turns is not None
    assert len(set(turns.actions)) == 8

    @quick_jit
    def seen(layout: jax.Array, action: jax.Array) -> jax.Array:
        _, state = env.reset_to(layout, jax.random.key(0), params)
        return env.step_env(jax.random.key(0), state, action, params)[0]

    def turn(image: np.ndarray, transpose: bool, rows: bool, columns: bool) -> np.ndarray:
        image = image.swapaxes(0, 1) if transpose else image
        return image[:: -1 if rows else 1, :: -1 if columns else 1]

    middle = env.size // 2
    layout = np.asarray(env.sample_layout(jax.random.key(0), params))
    for bits, actions in zip(itertools.product((False, True), repeat=3), turns.actions, strict=True):
        around = turn(np.roll(layout, (middle, middle), (0, 1)), *bits)
        turned = np.roll(around, (-middle, -middle), (0, 1))
        for action in range(env.num_actions):
            now = turn(np.asarray(seen(layout, action)), *bits)
            np.testing.assert_array_equal(seen(turned, actions[action]), now)
    assert envs_jax.make("letter", size=6).symmetries is None
