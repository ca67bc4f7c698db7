"""Rewards against an independent reading of the rules, and the paper's bonuses as examples."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.tasks import rewards
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine

LETTERS = "abcde"
PAPER = [Bonus("a", "d", 5.0), Bonus("b", "e", 10.0, ("a",))]


@jax.jit
def pay(
    machine: RewardMachine, labels: jax.Array, reached: jax.Array, taken: jax.Array, completed: jax.Array
) -> jax.Array:
    """Rewards of one episode, ``[T]``."""

    def step(rules: jax.Array, x: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        return rewards.step(machine, rules, *x)

    return jax.lax.scan(step, rewards.initial(machine), (labels, reached, taken, completed))[1]


def episode(*steps: tuple[str, str]) -> tuple[np.ndarray, ...]:
    """``(labels, what the edge taken reaches)`` per step, the second empty for no edge; the last edge completes."""
    labels = np.array([[x in seen for x in LETTERS] for seen, _ in steps])
    reached = np.array([[x in goal for x in LETTERS] for _, goal in steps])
    taken = reached.any(-1)
    completed = taken & (np.arange(len(steps)) == len(steps) - 1)
    return labels, reached, taken, completed


def reference(
    rules: list[Bonus],
    completion: float,
    subtask: float,
    labels: np.ndarray,
    reached: np.ndarray,
    taken: np.ndarray,
    completed: np.ndarray,
) -> list[float]:
    """Looks at the whole episode for each rule: when is it paid, if ever?"""
    paid = [completion * bool(c) + subtask * bool(t) for c, t in zip(completed, taken, strict=True)]
    for rule in rules:
        first, second = LETTERS.index(rule.first), LETTERS.index(rule.second)
        banned = [LETTERS.index(x) for x in rule.avoid]
        starts = [t for t in range(len(taken)) if taken[t] and reached[t, first]]
        if not starts or labels[: starts[0] + 1, banned].any():
            continue
        ends = [t for t in range(starts[0] + 1, len(taken)) if taken[t] and reached[t, second]]
        if ends:
            paid[ends[0]] += rule.bonus
    return paid


@pytest.mark.parametrize("rules", [PAPER, [*PAPER, Bonus("c", "c", 2.0, ("d", "e"))]])
def test_random_episodes_pay_what_the_rules_say(rules: list[Bonus]) -> None:
    rng = np.random.default_rng(len(rules))
    machine = reward_machine(LETTERS, completion=1.0, subtask=0.5, bonuses=rules)
    total = 0.0
    for _ in range(300):
        labels = rng.random((12, 5)) < 0.12
        taken = rng.random(12) < 0.5
        # What an edge reaches holds when it is taken.
        reached = np.eye(5, dtype=bool)[rng.integers(5, size=12)]
        labels |= reached & taken[:, None]
        completed = taken & (np.arange(12) == 11)
        expected = reference(rules, 1.0, 0.5, labels, reached, taken, completed)
        np.testing.assert_allclose(pay(machine, labels, reached, taken, completed), expected)
        total += sum(expected)
    assert total > 1000  # bonuses were paid


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([("a", "a"), ("", ""), ("d", "d")], [1, 0, 7]),  # a then d: +5
        ([("a", "a"), ("c", "c"), ("d", "d")], [1, 1, 7]),  # not necessarily one after the other
        ([("a", ""), ("d", "d")], [0, 2]),  # a was stepped on, but no edge reached it
        ([("a", "a"), ("d", ""), ("c", "c")], [1, 0, 2]),  # nor d
        ([("d", "d"), ("a", "a")], [1, 2]),  # wrong order
        ([("a", "a"), ("d", "d"), ("a", "a"), ("d", "d")], [1, 6, 1, 2]),  # at most once an episode
        ([("b", "b"), ("e", "e")], [1, 12]),  # b then e: +10
        ([("a", ""), ("b", "b"), ("e", "e")], [0, 1, 2]),  # a was seen before b
        ([("b", "b"), ("a", ""), ("e", "e")], [1, 0, 12]),  # only before b does it matter
        ([("ab", "b"), ("e", "e")], [1, 2]),  # in the same step it does, too
        ([("b", "b"), ("a", "a"), ("e", "e"), ("d", "d")], [1, 1, 11, 7]),  # both
    ],
)
def test_the_papers_letter_bonuses(steps: list[tuple[str, str]], expected: list[float]) -> None:
    machine = reward_machine(LETTERS, subtask=1.0, bonuses=PAPER)
    np.testing.assert_allclose(pay(machine, *episode(*steps)), expected)


def test_reward_set_one_pays_completion_alone() -> None:
    assert pay(reward_machine(LETTERS), *episode(("a", "a"), ("b", ""), ("d", "d"))).tolist() == [0, 0, 1]


def test_no_rules_is_a_machine_without_state() -> None:
    assert rewards.initial(reward_machine(LETTERS)).shape == (0,)
    assert reward_machine(LETTERS).num_rules == 0


def test_episodes_share_nothing() -> None:
    machine = reward_machine(LETTERS, bonuses=PAPER)
    armed = jnp.full(2, RewardMachine.ARMED)
    assert (np.asarray(rewards.initial(machine)) == RewardMachine.WAITING).all()
    rules, paid = rewards.step(machine, armed, *(jnp.asarray(x[0]) for x in episode(("d", "d"), ("", ""))))
    assert float(paid) == 5
    assert rules.tolist() == [RewardMachine.PAID, RewardMachine.ARMED]


def test_unknown_proposition_is_named() -> None:
    with pytest.raises(ValueError, match=r"\['z'\].*\['a', 'b', 'c', 'd', 'e'\]"):
        reward_machine(LETTERS, bonuses=[Bonus("a", "z", 1.0)])
