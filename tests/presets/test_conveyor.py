"""Conveyor's presets: worlds named by a number, whose two chains are all that is collected on."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import hrlspec
from hrlspec.presets import preset
from hrlspec.tasks.bank import TaskBanks

LEARNED = 0.9


@pytest.mark.parametrize(("name", "k"), [("conveyor-4", 4), ("conveyor-simple-32", 32)])
def test_the_tasks_are_two_chains_that_differ_in_the_end(name: str, k: int) -> None:
    world = preset(name)
    env, config = world.make(), world.settings()[0]
    assert (world.name, env.name, env.num_propositions) == (name, name, k + 1)
    trees = world.collected_tasks(config.curriculum.max_nodes)
    assert trees is not None
    assert trees.parent.shape == (2, config.curriculum.max_nodes)
    reach = np.asarray(trees.reach).argmax(-1)[:, 1 : k + 1]
    common = list(range(k - 1))
    assert reach.tolist() == [[*common, k - 1], [*common, k]]
    assert not trees.avoid.any()
    assert np.array_equal(world.suite_for("test").trees.reach[:, : k + 1], trees.reach[:, : k + 1])
    assert len(world.reserved) == 0


def test_banks_hold_given_tasks_in_turn() -> None:
    world = preset("conveyor-simple-2")
    config = world.settings()[0].curriculum
    given = world.collected_tasks(config.max_nodes)
    assert given is not None
    banks = TaskBanks(0, config, 3, world.reserved, given)
    for iteration in (0, 100):
        bank = banks.at(iteration)
        assert len(bank.parent) == config.levels * config.tasks_per_level
        for rows in (bank.reach[::2], bank.reach[1::2]):
            assert (np.asarray(rows) == np.asarray(rows[0])).all()
        assert np.array_equal(bank.reach[:2], given.reach)


@pytest.mark.parametrize("name", ["conveyor-0", "conveyor-simple-33"])
def test_numbers_out_of_range(name: str) -> None:
    with pytest.raises(ValueError, match=f"k is {name.rpartition('-')[2]}, expected 1 to 32"):
        preset(name)


@pytest.mark.slow
def test_it_plans_ahead_where_the_nearest_goal_says_nothing() -> None:
    """Half of the episodes is what an agent gets that does not see the last item."""
    trained = hrlspec.train(jax.random.key(0), "conveyor-simple-4", total_steps=100_000)
    result = hrlspec.evaluate(jax.random.key(1), trained, preset("conveyor-simple-4").suite_for("test"))
    assert result.total.success_rate.estimate > LEARNED
