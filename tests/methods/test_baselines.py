"""The baselines' defining traits: what an option does not know, and what a flat policy sees."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.agent.agent import Agent
from hrlspec.agent.networks.controller import Instruction
from hrlspec.learning.train import Trainer
from hrlspec.methods import METHODS, option
from hrlspec.methods.option import Measurements
from hrlspec.spec import TaskState, TaskTree, initial, open_edges
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import Bonus, reward_machine
from tests.probes import Corridor, on_device, padded, quick_jit, random_params, small_agent, small_config
from tests.trees import random_tree, tree_of

ENV = Corridor()
P = 4
GAMMA, DECAY = 0.9, option.LogicValueIteration().decay


def baseline(name: str, **changes: Any) -> Agent:
    method = METHODS[name]
    config = small_config(**changes)
    # As it is trained, but with the small networks, and Option with its roles.
    return Agent(ENV, config if name == "option" else method.configure(config), method)


def instruction_for(agent: Agent, params: Any, tree: TaskTree, state: TaskState, edge: int) -> Instruction:
    tree = on_device(tree)
    book = agent.low.instruct(params, tree)
    feasible = open_edges(tree, state)
    return agent.low.instructions_at(params, book, (), jnp.int32(edge), feasible, book.ahead[edge])


def behaviour(agent: Agent, params: Any, tree: TaskTree, state: TaskState, edge: int) -> np.ndarray:
    """What describes the low level's policy, and its value, in three cells."""
    instruction = instruction_for(agent, params, tree, state, edge)
    views = ENV.view_at(np.array([1, 2, 3]))
    outputs, value = jax.vmap(agent.low.control, (None, 0, None))(params, views, instruction)
    return np.concatenate([outputs, value[:, None]], 1)


# One first sub-task, but for its own `ensuring`, and different tasks after it.
FIRST = tree_of([(0, "a", "c"), (1, "b", "")], num_propositions=P, num_nodes=4)
OTHER_FUTURE = tree_of([(0, "a", "c"), (1, "d", "c"), (2, "b", "")], num_propositions=P, num_nodes=4)
OTHER_GOAL = tree_of([(0, "b", "c"), (1, "b", "")], num_propositions=P, num_nodes=4)
OTHER_AVOID = tree_of([(0, "a", "d"), (1, "b", "")], num_propositions=P, num_nodes=4)
LATER_AVOID = tree_of([(0, "a", "c"), (1, "b", "d")], num_propositions=P, num_nodes=4)


def test_an_option_knows_its_own_goal_and_what_to_avoid_and_nothing_else() -> None:
    agent = baseline("option")
    params = random_params(agent, 0)
    here = behaviour(agent, params, FIRST, initial(FIRST), 1)
    np.testing.assert_array_equal(here, behaviour(agent, params, OTHER_FUTURE, initial(FIRST), 1))
    for other in (OTHER_GOAL, OTHER_AVOID):
        assert np.abs(here - behaviour(agent, params, other, initial(FIRST), 1)).max() > 1e-3
    ours = small_agent(ENV)
    mine = behaviour(ours, random_params(ours, 0), FIRST, initial(FIRST), 1)
    theirs = behaviour(ours, random_params(ours, 0), OTHER_FUTURE, initial(FIRST), 1)
    assert np.abs(mine - theirs).max() > 1e-3


def test_a_flat_policy_sees_the_whole_task_and_no_sub_task() -> None:
    agent = baseline("ltl2action")
    params = random_params(agent, 0)
    here = behaviour(agent, params, FIRST, initial(FIRST), TaskTree.ROOT)
    for other in (OTHER_FUTURE, OTHER_GOAL, OTHER_AVOID, LATER_AVOID):
        assert np.abs(here - behaviour(agent, params, other, initial(other), TaskTree.ROOT)).max() > 1e-3
    # What the loop assigns means nothing to it.
    np.testing.assert_array_equal(here, behaviour(agent, params, FIRST, initial(FIRST), 1))


def test_a_flat_policy_sees_what_remains_of_its_task() -> None:
    agent = baseline("ltl2action")
    params = random_params(agent, 0)
    tree = tree_of([(0, "a", ""), (0, "b", "c"), (2, "d", "a"), (2, "a", "")], num_propositions=P)
    rest = tree_of([(0, "d", "a"), (0, "a", "")], num_propositions=P)
    moved = initial(tree).replace(node=jnp.int32(2))
    remaining = behaviour(agent, params, tree, moved, TaskTree.ROOT)
    np.testing.assert_allclose(
        remaining, behaviour(agent, params, rest, initial(rest), TaskTree.ROOT), rtol=1e-5, atol=1e-6
    )
    # An edge that is blocked is no longer part of it.
    blocked = initial(tree).replace(blocked=jnp.arange(5) == 2)
    only = tree_of([(0, "a", "")], num_propositions=P)
    np.testing.assert_allclose(
        behaviour(agent, params, tree, blocked, TaskTree.ROOT),
        behaviour(agent, params, only, initial(only), TaskTree.ROOT),
        rtol=1e-5,
        atol=1e-6,
    )


def random_measurements(rng: np.random.Generator) -> Measurements:
    attempts = rng.uniform(1, 5, (P + 1, P))
    successes = rng.uniform(0.5, 4, (2, P))
    arrays = (
        attempts,
        attempts * rng.uniform(0.1, 1, (P + 1, P)),
        successes,
        successes * rng.uniform(0, 5, (2, P)),
    )
    return Measurements(*(jnp.asarray(x, jnp.float32) for x in arrays))


def plain_value(known: Measurements, tree: TaskTree, node: int) -> float:
    """The value of taking the edge into a node and going on, read from the definition."""
    parent = int(tree.parent[node])
    origins = [P] if parent == 0 else np.flatnonzero(tree.reach[parent]).tolist()
    kind = int(tree.accepting[node])
    takes, earns = [], []
    for goal in np.flatnonzero(tree.reach[node]):
        takes.append(np.mean([known.discounted[o, goal] / known.attempts[o, goal] for o in origins]))
        earns.append(known.rewards[kind, goal] / known.successes[kind, goal])
    children = [child for child in range(1, tree.num_nodes) if tree.valid[child] and tree.parent[child] == node]
    ahead = 0.0 if tree.accepting[node] else max(plain_value(known, tree, child) for child in children)
    return float(min(takes) * (max(earns) + ahead))


def test_logic_value_iteration() -> None:
    rng = np.random.default_rng(0)
    values = quick_jit(option.values)
    for _ in range(100):
        tree, known = random_tree(rng, num_nodes=8, num_propositions=P, most_together=2), random_measurements(rng)
        tree = padded(tree, 8)
        state = initial(tree).replace(blocked=jnp.asarray(rng.random(8) < 0.2))
        result, feasible = values(known, tree, state), np.asarray(open_edges(tree, state))
        expected = [plain_value(known, tree, node) if feasible[node] else -np.inf for node in range(8)]
        np.testing.assert_allclose(result, expected, rtol=1e-5)


def test_what_was_never_tried_stays_worth_a_try() -> None:
    """However long ago its only, imagined attempt was."""
    faded = jax.tree.map(jnp.zeros_like, option.unmeasured(P))
    tree = on_device(FIRST)
    assert np.isfinite(np.asarray(option.values(faded, tree, initial(tree)))[1])


def test_measurements_are_sums_over_attempts_that_fade() -> None:
    rng = np.random.default_rng(1)
    shape = (6, 3)
    origin = np.eye(P + 1, dtype=bool)[rng.integers(P + 1, size=shape)]
    goal = np.eye(P, dtype=bool)[rng.integers(P, size=shape)]
    ended, reached, last = rng.random((3, *shape)) < 0.6
    duration, reward = rng.integers(1, 9, shape), rng.normal(size=shape).astype(np.float32)
    new = option.sums(origin, goal, ended, reached, last, duration, reward, discount=GAMMA)
    known = option.LogicValueIteration(decay=DECAY).observe(option.unmeasured(P), new)
    for g in range(P):
        here = ended & goal[..., g]
        for o in range(P + 1):
            ours = here & origin[..., o]
            np.testing.assert_allclose(known.attempts[o, g], DECAY + ours.sum(), rtol=1e-5)
            won = (GAMMA**duration)[ours & reached].sum()
            np.testing.assert_allclose(known.discounted[o, g], DECAY + won, rtol=1e-5)
        for kind in (0, 1):
            mine = here & reached & (last == kind)
            np.testing.assert_allclose(known.successes[kind, g], DECAY + mine.sum(), rtol=1e-5)
            np.testing.assert_allclose(known.rewards[kind, g], reward[mine].sum(), rtol=1e-4, atol=1e-4)


@pytest.mark.slow  # compiles an iteration of each
@pytest.mark.parametrize("method", ["option", "ltl2action"])
def test_baselines_train_in_the_same_loop(method: str) -> None:
    """A corridor with the start in the middle: each baseline learns to go to what it is told."""
    agent = baseline(method, total_steps=60 * 32 * 24)
    trainer, config = Trainer(agent), agent.config
    machine = reward_machine(ENV.propositions, bonuses=[Bonus("a", "b", 2.0)])
    bank = draw_bank(np.random.default_rng(0), config.curriculum, 2, np.zeros(0, np.uint32))
    wide = lambda x: np.pad(x, ((0, 0), (0, 0), (0, P - 2)))  # noqa: E731
    bank = dataclasses.replace(bank, reach=wide(bank.reach), avoid=wide(bank.avoid))
    state = trainer.init(jax.random.key(0), bank, machine)
    rates = []
    for _ in range(60):
        state, metrics = trainer.iterate(state, bank, machine, np.zeros(0, np.uint32))
        rates.append(float(metrics["successes"] / metrics["episodes"]))
    # Over 20 seeds at three instruction sets: in the end 1.000 in every one, at first 0.63 ± 0.05 (standard deviation).
    assert np.mean(rates[-5:]) > 0.9 > rates[0] + 0.05
    assert "high" not in state.optimisers  # nothing of the high level is learned by gradient
    if method == "option":
        known = state.params["high"]
        # a is in cell 0 and b in cell 4: from one to the other it takes four steps. Found: γ^4 less 0.0024 ± 0.0007.
        per_attempt = np.asarray(known.discounted / known.attempts)
        assert GAMMA**5 < per_attempt[0, 1] <= GAMMA**4 + 1e-3
        # Starts lie nearer: found 0.154 ± 0.003.
        assert per_attempt[P, 0] > per_attempt[1, 0] + 0.05
        # b as the last sub-task earns 1, and 3 after a; what is known is one figure for both: found 2.45 ± 0.02.
        assert 1.5 < (known.rewards / known.successes)[1, 1] < 2.8
