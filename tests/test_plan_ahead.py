"""Ways to the leaves, the low level's advice on them, and which layouts teach look-ahead."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax
from hrlspec.agent import Agent
from hrlspec.networks.tree import lookahead, routes
from hrlspec.regret import myopia_regret, opening
from hrlspec.spec import TaskTree, advance, initial, open_edges
from tests.probes import Corridor, on_device, quick_jit, random_params, small_config
from tests.tasks import random_tree, tree_of

ENV = Corridor()
LENGTH = 3


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


def test_lookahead_collects_what_each_depth_reaches() -> None:
    rng = np.random.default_rng(1)
    for _ in range(10):
        tree = random_tree(rng, num_nodes=8, num_propositions=4)
        ahead = np.asarray(lookahead(on_device(tree), 2))
        for node in np.flatnonzero(tree.valid):
            for steps in (1, 2):
                below = [k for k in np.flatnonzero(tree.valid) if len(way_to(tree, node, k)) == steps]
                np.testing.assert_array_equal(ahead[node, steps - 1], tree.reach[below].any(0))


def test_advice_is_the_value_of_the_best_way_and_that_way_is_handed_down() -> None:
    base = small_config().network
    network = dataclasses.replace(base, roles=True, lookahead=LENGTH, advice=10.0, advised=12)
    agent = Agent(ENV, small_config(network=network))
    params, view = random_params(agent, 2), ENV.view_at(2)
    control = quick_jit(lambda told: agent.control(params, view, told)[1])
    advise = quick_jit(lambda tree, state, told: agent.advise(params, view, tree, state, told))
    rng = np.random.default_rng(2)
    several = 0
    for _ in range(20):
        tree = on_device(random_tree(rng, num_nodes=9, num_propositions=ENV.num_propositions, distinct=True))
        labels = jnp.asarray(rng.random(ENV.num_propositions) < 0.4)
        state = advance(tree, initial(tree), labels, TaskTree.NO_NODE)
        told = agent.instruct(params, tree)
        advice, ahead = advise(tree, state, told)
        for edge in np.flatnonzero(open_edges(tree, state)):
            scores = {}
            for leaf in np.flatnonzero(tree.accepting):
                way = way_to(tree, int(state.node), leaf)
                if way and way[0] == edge:
                    later = np.zeros((LENGTH, ENV.num_propositions), np.float32)
                    for i, node in enumerate(way[1 : 1 + LENGTH]):
                        later[i] = tree.reach[node]
                    mine = dataclasses.replace(jax.tree.map(lambda x, e=edge: x[e], told), ahead=jnp.asarray(later))
                    scores[leaf] = float(control(mine)), later
            several += len(scores) > 1
            best, later = max(scores.values(), key=lambda score: score[0])
            np.testing.assert_allclose(advice[edge], best, rtol=1e-5)
            np.testing.assert_array_equal(ahead[edge], later)
    assert several > 3


def test_regret_is_what_nearest_first_loses() -> None:
    env = envs_jax.make("letter", size=5, num_letters=3, num_cells=6)
    params = env.default_params
    layouts = jax.vmap(env.sample_layout, (0, None))(jax.random.split(jax.random.key(0), 200), params)
    task = on_device(tree_of([(0, "a", ""), (1, "b", "")], num_propositions=3))
    first, second = opening(task)

    @jax.jit
    def regret(layout: jax.Array) -> jax.Array:
        _, labels, start = env.transition_table(layout, params)
        return myopia_regret(env.distances(), labels, start, first, second)

    def apart(x: np.ndarray, y: np.ndarray) -> int:
        gap = np.abs(x - y)
        return int(np.minimum(gap, env.size - gap).sum())

    found = np.asarray(jax.vmap(regret)(layouts))
    for layout, steps in zip(np.asarray(layouts), found, strict=True):
        ways = []
        for x in np.argwhere(layout == 0):
            near = apart(np.zeros(2, int), x)
            ways.append((near, near + min(apart(x, y) for y in np.argwhere(layout == 1))))
        nearest = min(near for near, _ in ways)
        worst = max(total for near, total in ways if near == nearest)
        assert steps == worst - min(total for _, total in ways)
    assert (found > 0).any()
    assert (found == 0).any()


def test_a_task_of_one_step_has_no_regret() -> None:
    env = envs_jax.make("letter")
    _, labels, start = env.transition_table(
        env.sample_layout(jax.random.key(1), env.default_params), env.default_params
    )
    first, second = opening(on_device(tree_of([(0, "a", ""), (0, "b", "")])))
    assert not second.any()
    assert int(myopia_regret(env.distances(), labels, start, first, second)) == 0
