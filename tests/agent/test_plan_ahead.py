"""Ways to the leaves, and the low level's advice on them."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hrlspec.agent.networks.tree import forks, lookahead, lookback, routes
from hrlspec.methods import Ours
from hrlspec.spec import TaskState, TaskTree, advance, initial, open_edges
from tests.probes import Corridor, on_device, quick_jit, random_params, small_agent, small_config, small_planner
from tests.trees import random_tree

ENV = Corridor()
LENGTH = 3
follow = quick_jit(advance)


def way_to(tree: TaskTree, node: int, below: int) -> list[int]:
    """The nodes after ``node`` on the way to ``below``, by climbing; empty when it is not below."""
    way: list[int] = []
    here = below
    while here != node and here != TaskTree.NO_NODE:
        way.insert(0, here)
        here = int(tree.parent[here])
    return way if here == node else []


def test_routes_are_the_ways_down() -> None:
    rng = np.random.default_rng(0)
    compiled = quick_jit(lambda tree, node: routes(tree, node, LENGTH))
    for _ in range(30):
        tree = random_tree(rng, num_nodes=10, num_propositions=4)
        node = int(rng.integers(np.asarray(tree.valid).sum()))
        found = np.asarray(compiled(on_device(tree), jnp.int32(node)))
        for below in range(10):
            way = way_to(tree, node, below)[:LENGTH] if tree.valid[below] else []
            assert found[below].tolist() == way + [TaskTree.NO_NODE] * (LENGTH - len(way))


def test_forks_are_where_more_than_one_way_leads_on() -> None:
    rng = np.random.default_rng(4)
    found, compiled = {False: 0, True: 0}, quick_jit(forks)
    for _ in range(40):
        tree = random_tree(rng, num_nodes=8, num_propositions=4)
        nodes = np.flatnonzero(tree.valid)
        children = np.bincount(tree.parent[nodes[1:]], minlength=8)
        for node, fork in zip(nodes, np.asarray(compiled(on_device(tree)))[nodes], strict=True):
            assert fork == any(children[below] > 1 for below in nodes if below == node or way_to(tree, node, below))
            found[bool(fork)] += 1
    assert min(found.values()) > 20


@pytest.mark.parametrize("advice", [0.0, 10.0])
def test_where_nothing_is_to_choose_the_planner_would_choose_the_same(advice: float) -> None:
    """And hand down the same way, whatever it has learned."""
    network = dataclasses.replace(small_config().network, roles=True, lookahead=LENGTH)
    agent = small_agent(ENV, small_config(network=network), Ours(high=small_planner(network__advice=advice)))
    params, view = random_params(agent, 5), ENV.view_at(2)

    @quick_jit
    def both(tree: TaskTree, state: TaskState) -> Any:
        book = agent.low.prepare(params, jax.tree.map(lambda x: x[None], tree))
        batch = jax.tree.map(lambda x: x[None], (view, tree, state))
        choice = agent.high.choose(agent.low, params, *batch, book.instructions)
        return agent.high.settled(*batch[1:], book.forks)[0], jax.tree.map(lambda x: x[0], choice), book.instructions

    rng = np.random.default_rng(6)
    settled = 0
    for _ in range(60):
        tree = on_device(random_tree(rng, num_nodes=6, num_propositions=ENV.num_propositions, distinct=True))
        state = initial(tree)
        for _ in range(int(rng.integers(3))):
            labels = jnp.asarray(rng.random(ENV.num_propositions) < 0.4)
            state = follow(tree, state, labels, TaskTree.NO_NODE)
        edge, choice, instructions = jax.tree.map(np.asarray, both(tree, state))
        ways = [way_to(tree, int(state.node), leaf) for leaf in np.flatnonzero(tree.accepting)]
        is_open = np.asarray(open_edges(tree, state))
        open_ways = [way for way in ways if way and is_open[way[0]]]
        edges = {way[0] for way in open_ways}
        assert (edge != TaskTree.NO_NODE) == (len(open_ways if advice else edges) == 1)
        if edge != TaskTree.NO_NODE:
            assert edges == {int(edge)}
            assert choice.logits.argmax() == edge
            np.testing.assert_array_equal(choice.ahead[edge], instructions.ahead[0, edge])
            settled += 1
    assert 10 < settled < 50


def test_lookahead_collects_what_each_depth_reaches() -> None:
    rng = np.random.default_rng(1)
    compiled = quick_jit(lambda tree: lookahead(tree, 2))
    for _ in range(10):
        tree = random_tree(rng, num_nodes=8, num_propositions=4)
        ahead = np.asarray(compiled(on_device(tree)))
        for node in np.flatnonzero(tree.valid):
            for steps in (1, 2):
                below = [k for k in np.flatnonzero(tree.valid) if len(way_to(tree, node, k)) == steps]
                np.testing.assert_array_equal(ahead[node, steps - 1], tree.reach[below].any(0))


def test_lookback_recalls_what_was_reached_on_the_way() -> None:
    rng = np.random.default_rng(3)
    compiled = quick_jit(lambda tree: lookback(tree, 3))
    for _ in range(10):
        tree = random_tree(rng, num_nodes=8, num_propositions=4)
        behind = np.asarray(compiled(on_device(tree)))
        for edge in np.flatnonzero(tree.valid)[1:]:
            earlier = tree.reach[way_to(tree, TaskTree.ROOT, edge)[-2::-1]][:3]
            np.testing.assert_array_equal(behind[edge], np.pad(earlier, ((0, 3 - len(earlier)), (0, 0))))


def test_the_low_level_remembers_as_much_as_it_is_told_to() -> None:
    """Two ways to the same last sub-task: what it is worth may depend on them, as a bonus for an order does."""
    a, b, c = np.eye(ENV.num_propositions, dtype=bool)[:3]
    tree = on_device(
        TaskTree(
            parent=np.array([-1, 0, 0, 1, 2], np.int32),
            reach=np.stack([a & b, a, b, c, c]),
            avoid=np.zeros((5, ENV.num_propositions), bool),
            accepting=np.array([False, False, False, True, True]),
            valid=np.ones(5, bool),
            depth=np.array([0, 1, 1, 2, 2], np.int32),
        )
    )
    for memory in (0, 1):
        network = dataclasses.replace(small_config().network, roles=True, memory=memory)
        agent = small_agent(ENV, small_config(network=network))
        params = random_params(agent, 4)
        instruction, control = quick_jit(agent.low.instruct)(params, tree), quick_jit(agent.low.control)
        last = [jax.tree.map(lambda x, e=edge: x[e], instruction) for edge in (3, 4)]
        values = [float(control(params, ENV.view_at(2), some)[1]) for some in last]
        assert (abs(values[0] - values[1]) > 1e-3) == bool(memory)


def test_advice_is_the_value_of_the_best_way_and_that_way_is_handed_down() -> None:
    network = dataclasses.replace(small_config().network, roles=True, lookahead=LENGTH)
    planner = small_planner(network__advice=10.0)
    agent = small_agent(ENV, small_config(network=network), Ours(high=planner))
    params, view = random_params(agent, 2), ENV.view_at(2)
    control = quick_jit(lambda instruction: agent.low.control(params, view, instruction)[1])
    instruct = quick_jit(agent.low.instruct)
    advise = quick_jit(lambda *batch: planner.advise(agent.low, params, *batch))
    rng = np.random.default_rng(2)
    several = 0
    for _ in range(20):
        tree = on_device(random_tree(rng, num_nodes=9, num_propositions=ENV.num_propositions, distinct=True))
        labels = jnp.asarray(rng.random(ENV.num_propositions) < 0.4)
        state = follow(tree, initial(tree), labels, TaskTree.NO_NODE)
        instruction = instruct(params, tree)
        batch = jax.tree.map(lambda x: x[None], (view, tree, state, instruction))
        advice, ahead = jax.tree.map(lambda x: x[0], advise(*batch))
        for edge in np.flatnonzero(open_edges(tree, state)):
            scores = {}
            for leaf in np.flatnonzero(tree.accepting):
                way = way_to(tree, int(state.node), leaf)
                if way and way[0] == edge:
                    later = np.zeros((LENGTH, ENV.num_propositions), np.float32)
                    for i, node in enumerate(way[1 : 1 + LENGTH]):
                        later[i] = tree.reach[node]
                    mine = dataclasses.replace(
                        jax.tree.map(lambda x, e=edge: x[e], instruction), ahead=jnp.asarray(later)
                    )
                    scores[leaf] = float(control(mine)), later
            several += len(scores) > 1
            best = max(score for score, _ in scores.values())
            np.testing.assert_allclose(advice[edge], best, rtol=1e-4, atol=1e-5)
            # Ways that are valued alike are as good as each other.
            handed_down = [score for score, later in scores.values() if np.array_equal(later, ahead[edge])]
            np.testing.assert_allclose(max(handed_down), best, rtol=1e-4, atol=1e-5)
    assert several > 3
