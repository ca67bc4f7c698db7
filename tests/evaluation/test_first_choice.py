"""First choices of an agent that takes edges by their number: what is best is known without the library's solvers."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import envs_jax
from hrlspec.evaluation import first_choice_evaluation, suite_from_text
from hrlspec.presets import preset
from hrlspec.tasks.rewards import RewardMachine, reward_machine
from tests.evaluation.scripted import manner, walker

LETTER = envs_jax.make("letter")
COMPLETION = reward_machine(LETTER.propositions)
FIRST, LAST = manner(), manner(last=True)
WALK_NAMES = ("a", "b", "c", "d", "e")
KEY = jax.random.key(0)


def rates(text: str, machine: RewardMachine, layouts: int = 60) -> tuple[float, float]:
    """Of the agents that take the first edge and the last one."""
    suite = suite_from_text("tasks", text, LETTER.propositions)
    evaluation = first_choice_evaluation(LETTER, suite, machine, layouts_per_task=layouts, greedy=True)
    agent = walker(LETTER)
    first, last = (evaluation(KEY, agent, params, machine).rate.estimate for params in (FIRST, LAST))
    return first, last


def test_of_two_letters_the_nearer_one_is_best() -> None:
    """Steps on the torus, counted here; where both are as near the choice does not matter."""
    suite = suite_from_text("tasks", "achieve a or achieve b", LETTER.propositions)
    evaluation = first_choice_evaluation(LETTER, suite, COMPLETION, layouts_per_task=60, greedy=True)
    board = np.asarray(evaluation.cases.layouts)
    rows, columns = np.indices(board.shape[1:])
    steps = np.minimum(rows, board.shape[1] - rows) + np.minimum(columns, board.shape[2] - columns)
    near = [np.where(board == letter, steps, 99).min((1, 2)) for letter in (0, 1)]
    assert (near[0] != near[1]).all()
    assert evaluation.cases.best[:, 1:3].tolist() == np.stack([near[0] < near[1], near[1] < near[0]], 1).tolist()
    assert evaluation.cases.chance == 0.5
    first, last = rates("achieve a or achieve b", COMPLETION)
    assert first == pytest.approx((near[0] < near[1]).mean())
    assert first + last == pytest.approx(1)


def test_the_branch_that_pays_more_is_best() -> None:
    """Three for two sub-tasks and completion, two for one and completion."""
    pays = reward_machine(LETTER.propositions, subtask=1.0)
    assert rates("achieve a or (achieve b; achieve c)", pays) == (0.0, 1.0)
    assert rates("(achieve b; achieve c) or achieve a", pays) == (1.0, 0.0)


def test_without_a_graph_only_what_is_paid_counts() -> None:
    """Walk's rule: b after d pays 5 more. The layouts do not enter."""
    world = preset("walk")
    env, machine = world.make(), world.rewards(2)
    suite = suite_from_text(
        "tasks", "(achieve a; achieve c) or (achieve d; achieve b)\nachieve a or achieve b", WALK_NAMES
    )
    cases = first_choice_evaluation(env, suite, machine, layouts_per_task=3).cases
    assert (cases.by, len(cases), cases.excluded) == ("return without distances", 3, 3)
    assert cases.task.tolist() == [0, 0, 0]
    assert np.flatnonzero(cases.best[0]).tolist() == [int(np.flatnonzero(np.asarray(suite.trees.reach)[0, :, 3])[0])]


def test_on_a_grid_steps_count() -> None:
    """From the middle of Walk's square a is 5.9 away and d 8.9."""
    world = preset("walk")
    suite = suite_from_text("tasks", "achieve a or achieve d", WALK_NAMES)
    cases = first_choice_evaluation(world.make(), suite, world.rewards(1), layouts_per_task=2).cases
    assert (cases.by, len(cases)) == ("steps", 2)
    assert np.asarray(suite.trees.reach)[0][np.flatnonzero(cases.best[0])].argmax(-1).tolist() == [0]


def test_what_is_not_known_is_refused() -> None:
    zone = preset("zone")
    suite = suite_from_text("tasks", "achieve blue or achieve green", zone.make().propositions)
    with pytest.raises(ValueError, match="no graph and no grid"):
        first_choice_evaluation(zone.make(), suite, zone.rewards(1))
    alone = suite_from_text("tasks", "achieve a", LETTER.propositions)
    with pytest.raises(ValueError, match="matters in none of 10 cases"):
        first_choice_evaluation(LETTER, alone, COMPLETION)
