"""Banks of training tasks: drawn from the seed and the number alone, without what is held out."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest

from hrlspec.config import CurriculumConfig
from hrlspec.spec import compile_task, parse, task_hashes
from hrlspec.tasks.bank import ITERATIONS_PER_BANK, TaskBanks, seed_of
from hrlspec.tasks.curriculum import draw_bank

CONFIG = CurriculumConfig(levels=2, tasks_per_level=32, max_nodes=6, tree_share=0.5)
NOTHING = np.zeros(0, np.uint32)


def equal(one: Any, other: Any) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def test_a_bank_is_drawn_anew_after_so_many_iterations() -> None:
    banks = TaskBanks(3, CONFIG, 4, NOTHING)
    first = banks.at(0)
    # The same arrays: nothing is drawn or sent to the device again.
    assert all(banks.at(i) is first for i in range(ITERATIONS_PER_BANK))
    second = banks.at(ITERATIONS_PER_BANK)
    assert not equal(first, second)
    assert not equal(second, banks.at(2 * ITERATIONS_PER_BANK))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), second) == jax.tree.map(lambda x: (x.shape, x.dtype), first)


def test_a_bank_has_the_tasks_of_its_seed_and_number() -> None:
    found = TaskBanks(3, CONFIG, 4, NOTHING).at(5 * ITERATIONS_PER_BANK + 1)
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(found))
    assert found.parent.shape == (64, 6)
    assert equal(found, draw_bank(np.random.default_rng([3, 5]), CONFIG, 4, NOTHING))


def test_a_resumed_run_has_the_same_banks() -> None:
    """Whatever was asked for before; a run that was resumed begins in the middle."""
    straight = TaskBanks(3, CONFIG, 4, NOTHING)
    seen = [straight.at(i * ITERATIONS_PER_BANK) for i in range(4)]
    resumed = TaskBanks(3, CONFIG, 4, NOTHING)
    for i in (2, 3, 1, 0):
        assert equal(resumed.at(i * ITERATIONS_PER_BANK), seen[i])


def test_seeds_have_banks_of_their_own() -> None:
    assert not equal(TaskBanks(3, CONFIG, 4, NOTHING).at(0), TaskBanks(4, CONFIG, 4, NOTHING).at(0))
    large = 2**63 + 5  # as the seeds of derived keys are
    assert equal(TaskBanks(large, CONFIG, 4, NOTHING).at(0), TaskBanks(large, CONFIG, 4, NOTHING).at(0))


def test_held_out_tasks_are_in_no_bank() -> None:
    free = TaskBanks(3, CONFIG, 4, NOTHING)
    reserved = np.unique(task_hashes(free.at(0)))[::2]
    assert np.isin(task_hashes(free.at(0)), reserved).any()
    banks = TaskBanks(3, CONFIG, 4, reserved)
    for number in range(5):
        assert not np.isin(task_hashes(banks.at(number * ITERATIONS_PER_BANK)), reserved).any()


def test_where_every_task_is_held_out_there_is_no_bank() -> None:
    config = CurriculumConfig(levels=1, tasks_per_level=8, max_nodes=3)
    tree = compile_task(parse("achieve goal"), ("goal",), max_nodes=3)
    only = task_hashes(jax.tree.map(lambda x: np.asarray(x)[None], tree))
    assert TaskBanks(0, config, 1, NOTHING).at(0).parent.shape == (8, 3)
    with pytest.raises(ValueError, match="tasks could not be drawn in"):
        TaskBanks(0, config, 1, only)


# --- The seed of a key ---


@pytest.mark.parametrize("seed", [0, 1, 7, 2**31 - 1])
def test_the_seed_that_a_key_was_made_of(seed: int) -> None:
    assert seed_of(jax.random.key(seed)) == seed


def test_keys_that_differ_have_seeds_that_differ() -> None:
    key = jax.random.key(0)
    keys = [key, *jax.random.split(key, 5), jax.random.fold_in(key, 9), jax.random.key(1)]
    seeds = {seed_of(some) for some in keys}
    assert len(seeds) == len(keys)
    assert all(0 <= seed < 2**64 for seed in seeds)
    words = jax.random.wrap_key_data(np.array([2, 3], np.uint32))
    assert seed_of(words) == 2 * 2**32 + 3
