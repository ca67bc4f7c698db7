"""Levels, promotion, and the bank of training tasks."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.config import CurriculumConfig
from hrlspec.spec import task_hashes
from hrlspec.tasks import curriculum

CONFIG = CurriculumConfig(levels=3, promotion=0.95, window=100, tasks_per_level=64, max_nodes=8)


def after(*batches: tuple[int, int]) -> curriculum.Curriculum:
    state = curriculum.initial()
    for finished, succeeded in batches:
        state = curriculum.update(state, jnp.int32(finished), jnp.int32(succeeded), CONFIG)
    return jax.tree.map(int, state)


@pytest.mark.parametrize(
    ("batches", "level", "finished"),
    [
        ([], 0, 0),
        ([(99, 99)], 0, 99),  # the window is not full
        ([(99, 94), (1, 1)], 1, 0),  # 95 of 100
        ([(100, 94)], 0, 0),  # one too few: a new window begins
        ([(100, 94), (100, 96)], 1, 0),
        ([(100, 0), (50, 50)], 0, 50),  # failures are forgotten with their window
        ([(100, 100), (100, 100), (100, 100), (100, 100)], 2, 0),  # the last level stays
    ],
)
def test_promotion(batches: list[tuple[int, int]], level: int, finished: int) -> None:
    state = after(*batches)
    assert (state.level, state.finished) == (level, finished)


def test_types_never_change() -> None:
    """Or the training iteration would compile anew after the first."""
    first = curriculum.initial()
    then = curriculum.update(first, jnp.int32(500), jnp.int32(500), CONFIG)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(then), strict=True):
        assert (a.dtype, a.weak_type, a.shape) == (b.dtype, b.weak_type, b.shape)


@pytest.mark.parametrize("level", [0, 1, 3])
def test_a_share_of_earlier_levels(level: int) -> None:
    drawn = np.asarray(
        curriculum.draw_levels(jax.random.uniform(jax.random.key(level), (2, 4000)), jnp.int32(level), 0.2)
    )
    assert drawn.max() == level
    assert drawn.min() == 0
    assert (drawn < level).mean() == pytest.approx(0.2 if level else 0, abs=0.03)
    counts = np.bincount(drawn, minlength=level + 1)[:level]
    assert (counts > 0.6 * 800 / max(level, 1)).all()


def depths(bank: object) -> np.ndarray:
    return np.asarray(bank.depth).max(-1).reshape(CONFIG.levels, CONFIG.tasks_per_level)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_bank_is_level_by_level(share: float) -> None:
    config = CurriculumConfig(levels=3, tasks_per_level=64, max_nodes=8, tree_share=share)
    bank = curriculum.draw_bank(np.random.default_rng(0), config, 5, np.zeros(0, np.uint32))
    np.testing.assert_array_equal(depths(bank), np.repeat([[1], [2], [3]], 64, 1))
    leaves = bank.accepting.sum(-1).reshape(3, 64)
    branched = (leaves > 1).mean(1)
    assert (branched <= share).all()
    if share:
        assert (branched >= share * 0.3).all()


def test_bank_avoids_reserved_tasks_and_repeats_itself() -> None:
    nothing = np.zeros(0, np.uint32)
    bank = curriculum.draw_bank(np.random.default_rng(1), CONFIG, 5, nothing)
    again = curriculum.draw_bank(np.random.default_rng(1), CONFIG, 5, nothing)
    jax.tree.map(np.testing.assert_array_equal, bank, again)
    reserved = np.unique(task_hashes(bank))[::3]
    assert np.isin(task_hashes(bank), reserved).any()
    held = curriculum.draw_bank(np.random.default_rng(1), CONFIG, 5, reserved)
    assert not np.isin(task_hashes(held), reserved).any()


def test_a_share_of_tasks_ends_with_staying() -> None:
    """Their leaves are followed by another that reaches the same and avoids all else; other tasks are as they were."""
    stays = dataclasses.replace(CONFIG, stay=0.5, hold_before_jump=7, longest_stay=9, tree_share=0.5, max_nodes=12)
    none = np.zeros(0, np.uint32)
    with_stays = curriculum.draw_bank(np.random.default_rng(0), stays, 5, none)
    without = curriculum.draw_bank(np.random.default_rng(0), dataclasses.replace(stays, stay=0.0), 5, none)
    assert without.hold is None
    assert with_stays.hold is not None
    changed = (with_stays.hold > 1).any(-1)
    assert 0.3 < changed.mean() < 0.6
    longest = set()
    for row in range(len(changed)):
        new, old = (jax.tree.map(lambda x, row=row: x[row], bank) for bank in (with_stays, without))
        for name in ("parent", "reach", "avoid", "valid", "depth"):
            kept = getattr(new, name)[old.valid], getattr(old, name)[old.valid]
            np.testing.assert_array_equal(*kept)
        if not changed[row]:
            np.testing.assert_array_equal(new.accepting, old.accepting)
            continue
        ends = np.flatnonzero(new.accepting)
        np.testing.assert_array_equal(np.sort(new.parent[ends]), np.flatnonzero(old.accepting))
        assert (new.hold[new.parent[ends]] == 7).all()
        np.testing.assert_array_equal(new.reach[ends], new.reach[new.parent[ends]])
        np.testing.assert_array_equal(new.avoid[ends], ~new.reach[ends])
        assert (new.hold > 1).sum() == 2 * len(ends)
        longest |= set(new.hold[ends].tolist())
    assert longest == {2, 3, 4, 5, 6, 7, 8, 9}
