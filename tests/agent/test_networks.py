"""What the networks may and may not depend on.

Parameters are random, biases too: a property that holds here holds by construction.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.agent.agent import Agent
from hrlspec.agent.distributions import MASKED
from hrlspec.agent.experience import View
from hrlspec.agent.networks.controller import Instruction, with_waves
from hrlspec.agent.networks.encoder import convolve
from hrlspec.agent.networks.planner import Planner
from hrlspec.agent.networks.symmetry import TURNS, turned
from hrlspec.config import NetworkConfig
from hrlspec.methods import LTL2ACTION, ImplicitPlanner, Ours
from hrlspec.spec import TaskState, TaskTree, initial, open_edges
from tests.probes import (
    Corridor,
    on_device,
    padded,
    quick_jit,
    random_order,
    random_params,
    reordered,
    small_agent,
    small_config,
    small_planner,
    subtree,
)
from tests.trees import random_tree, tree_of

ENV = Corridor()
N, WIDE = 8, 12
ROUNDS = (0, 3)
VIEW = ENV.view_at(2)


@functools.cache
def setup(rounds: int, extras: bool = False) -> tuple[Agent, Any]:
    network = dataclasses.replace(small_config().network, task_rounds=rounds)
    planner = {"network__rounds": rounds, "network__advice": float(extras), "network__child_embeddings": extras}
    agent = small_agent(ENV, small_config(network=network), **planner)
    # Draws differ in how soon what comes later fades; in this one the planner still hears the sixth sub-task.
    return agent, random_params(agent, 5)


def planner_of(agent: Agent) -> Planner:
    assert isinstance(agent.high, ImplicitPlanner)
    return agent.high.planner(agent.low)


@functools.cache
def compiled(rounds: int) -> tuple[Any, Any]:
    agent, params = setup(rounds)

    def plan(view: Any, tree: TaskTree, state: TaskState) -> Any:
        return planner_of(agent).apply(params["high"], view, tree, state, jnp.zeros(tree.num_nodes))

    return quick_jit(plan), quick_jit(functools.partial(agent.low.instruct, params))


def plan(rounds: int, tree: TaskTree, *, node: int = 0, blocked: tuple[int, ...] = (), view: Any = VIEW) -> Any:
    tree = on_device(tree)
    state = initial(tree)
    state = state.replace(node=jnp.int32(node), blocked=state.blocked.at[np.array(blocked, int)].set(True))
    logits, value = compiled(rounds)[0](view, tree, state)
    return np.asarray(logits), float(value)


def embed(rounds: int, tree: TaskTree) -> np.ndarray:
    return np.asarray(compiled(rounds)[1](on_device(tree)).future)


def some_trees(number: int) -> list[TaskTree]:
    rng = np.random.default_rng(0)
    trees = (random_tree(rng, num_nodes=N, num_propositions=4, most_together=2, distinct=True) for _ in range(1000))
    return [tree for tree in trees if tree.valid.sum() >= 5][:number]


@pytest.fixture(params=ROUNDS, ids=["sweep", "3 rounds"])
def rounds(request: pytest.FixtureRequest) -> int:
    return request.param


def test_only_open_edges_have_logits(rounds: int) -> None:
    for tree in some_trees(8):
        for node in np.flatnonzero(tree.valid & ~tree.accepting):
            logits, value = plan(rounds, tree, node=node)
            np.testing.assert_array_equal(logits > MASKED, tree.valid & (tree.parent == node))
            assert np.isfinite(value)


def test_the_order_of_children_does_not_matter(rounds: int) -> None:
    rng = np.random.default_rng(1)
    for tree in some_trees(8):
        order = random_order(rng, tree)
        moved = reordered(tree, order)
        logits, value = plan(rounds, tree)
        new_logits, new_value = plan(rounds, moved)
        np.testing.assert_allclose(new_logits, logits[order], rtol=1e-4, atol=1e-5)
        assert new_value == pytest.approx(value, rel=1e-4, abs=1e-5)
        np.testing.assert_allclose(embed(rounds, moved), embed(rounds, tree)[order], atol=1e-5)


def test_padding_does_not_matter(rounds: int) -> None:
    for tree in some_trees(4):
        logits, value = plan(rounds, tree)
        wide_logits, wide_value = plan(rounds, padded(tree, WIDE))
        np.testing.assert_allclose(
            wide_logits, np.pad(logits, (0, WIDE - N), constant_values=MASKED), rtol=1e-4, atol=1e-5
        )
        assert wide_value == pytest.approx(value, rel=1e-4, abs=1e-5)
        np.testing.assert_allclose(embed(rounds, padded(tree, WIDE))[:N], embed(rounds, tree), atol=1e-5)


def test_the_planner_sees_the_subtree_alone(rounds: int) -> None:
    """At node k it says what it says of the progression written as a tree of its own, last goal given."""
    checked = 0
    for tree in some_trees(10):
        for node in np.flatnonzero(tree.valid & ~tree.accepting)[1:]:
            logits, value = plan(rounds, tree, node=node)
            alone, rows = subtree(tree, node, N)
            alone.reach[0] = tree.reach[node]  # the root's one-hot is the sub-goal that was just met
            new_logits, new_value = plan(rounds, alone)
            np.testing.assert_allclose(new_logits[: len(rows)][1:], logits[rows][1:], rtol=1e-4, atol=1e-5)
            assert new_value == pytest.approx(value, rel=1e-4, abs=1e-5)
            checked += 1
    assert checked >= 10


def test_the_low_level_sees_what_remains_alone(rounds: int) -> None:
    """Row k of one pass over the whole task is the embedding of the subtree at k."""
    for tree in some_trees(6):
        whole = compiled(rounds)[1](on_device(tree))
        for node in np.flatnonzero(tree.valid):
            alone = compiled(rounds)[1](on_device(subtree(tree, node, N)[0]))
            np.testing.assert_allclose(alone.future[0], whole.future[node], atol=1e-5)
            np.testing.assert_array_equal(alone.ahead[0], whole.ahead[node])


def test_roles_tell_what_comes_next() -> None:
    for tree in some_trees(6):
        ahead = np.asarray(compiled(0)[1](on_device(tree)).ahead)
        assert ahead.shape == (N, 2, 4)
        for node in range(N):
            children = [k for k in range(N) if tree.valid[k] and tree.parent[k] == node]
            grandchildren = [k for k in range(N) if tree.valid[k] and tree.parent[k] in children]
            for place, nodes in enumerate((children, grandchildren)):
                np.testing.assert_array_equal(ahead[node, place], tree.reach[nodes].any(0))


def test_the_low_level_ignores_what_later_sub_tasks_avoid(rounds: int) -> None:
    tree = some_trees(1)[0]
    np.testing.assert_array_equal(embed(rounds, tree), embed(rounds, tree.replace(avoid=~tree.avoid)))


def test_a_blocked_edge_is_masked_and_silent(rounds: int) -> None:
    """What lies behind it, and its own avoid set, change nothing; unblocked, they do."""
    edges = [(0, "a", ""), (0, "b", ""), (1, "c", ""), (1, "d", ""), (2, "d", "")]
    one = tree_of(edges, num_propositions=4, num_nodes=N)
    other = tree_of(
        [(0, "a", "d"), *edges[1:2], (1, "d", "b"), (1, "b", ""), edges[4]], num_propositions=4, num_nodes=N
    )
    logits, value = plan(rounds, one, blocked=(1,))
    other_logits, other_value = plan(rounds, other, blocked=(1,))
    assert np.flatnonzero(logits > MASKED).tolist() == [2]
    np.testing.assert_allclose(logits, other_logits, rtol=1e-5)
    assert value == pytest.approx(other_value, rel=1e-5)
    assert abs(plan(rounds, one)[1] - plan(rounds, other)[1]) > 1e-4
    assert abs(plan(rounds, one)[1] - value) > 1e-4


def chain(goals: str) -> TaskTree:
    return tree_of([(i, goal, "") for i, goal in enumerate(goals)], num_propositions=4, num_nodes=WIDE)


def test_the_sweep_looks_ahead_without_limit_and_rounds_as_far_as_they_reach() -> None:
    near, far = "abcdabcda", "abcdabcdb"  # they differ at the ninth sub-task
    assert np.abs(embed(0, chain(near))[0] - embed(0, chain(far))[0]).max() > 1e-3
    # What the planner hears of it fades with the distance: here at the sixth, further than three rounds reach.
    near, far = "abcdab", "abcdac"
    assert abs(plan(0, chain(near))[1] - plan(0, chain(far))[1]) > 1e-5
    # With 3 rounds the message of the fourth edge does not get to the root.
    near, far = "abca", "abcd"
    np.testing.assert_allclose(embed(3, chain(near))[0], embed(3, chain(far))[0], atol=1e-6)
    assert np.abs(embed(3, chain(near))[1] - embed(3, chain(far))[1]).max() > 1e-3
    # The planner's nodes know their own sub-goal and their predicted latent, so only what they send ends there.
    near, far = "abcda", "abcdb"
    assert plan(3, chain(near))[1] == pytest.approx(plan(3, chain(far))[1], abs=1e-6)
    assert abs(plan(3, chain(near), node=2)[1] - plan(3, chain(far), node=2)[1]) > 1e-4


def test_what_the_rounds_hand_on_does_not_grow_with_the_weights() -> None:
    agent, params = setup(3)
    large = jax.tree.map(lambda weights: 30 * weights, params["high"])
    tree = on_device(some_trees(1)[0])
    latents = jax.random.normal(jax.random.key(0), (tree.num_nodes, agent.config.network.latent))
    nodes = np.asarray(planner_of(agent).apply(large, latents, tree, initial(tree), method="embed"))
    np.testing.assert_allclose(np.sqrt((nodes**2).mean(-1)), 1.0, atol=1e-2)
    np.testing.assert_allclose(nodes.mean(-1), 0.0, atol=1e-5)


def test_one_round_equals_the_sweep_where_nothing_is_below() -> None:
    """Rounds update a node from itself again and again, the sweep once: they agree on leaves after one round."""
    agent, params = setup(0)
    network = dataclasses.replace(agent.config.network, task_rounds=1)
    one = small_agent(ENV, dataclasses.replace(agent.config, network=network))
    tree = on_device(some_trees(1)[0])
    leaves = np.asarray(tree.accepting)
    swept, once = agent.low.instruct(params, tree).future, one.low.instruct(params, tree).future
    np.testing.assert_allclose(np.asarray(swept)[leaves], np.asarray(once)[leaves], atol=1e-6)


@pytest.mark.parametrize(("rounds", "extras"), [(2, False), (0, True)])
def test_gradients_are_finite(rounds: int, extras: bool) -> None:
    """Also where nothing is open, and through everything an agent does with a task."""
    agent, params = setup(rounds, extras)
    trees = jax.tree.map(lambda *x: jnp.stack(x), *map(on_device, some_trees(4)))
    accepting = jnp.argmax(trees.accepting, -1)

    def loss(params: Any) -> jax.Array:
        book = agent.low.prepare(params, trees)
        total = jnp.float32(0)
        for node in (jnp.zeros(4, jnp.int32), accepting):
            state = jax.vmap(initial)(trees).replace(node=node)

            views = jax.tree.map(lambda x: jnp.stack([x] * 4), VIEW)
            choice = agent.high.choose(agent.low, params, views, trees, state, book.instructions)
            scores = jax.nn.log_softmax(choice.logits)
            total += jnp.where(jax.vmap(open_edges)(trees, state), scores, 0.0).sum() + choice.value.sum()

            def one(instruction: Instruction) -> jax.Array:
                actions, own = agent.low.control(params, VIEW, jax.tree.map(lambda x: x[1], instruction))
                return jax.nn.log_softmax(actions)[0] + own

            total += jax.vmap(one)(book.instructions).sum()
        return total + agent.low.reach_values(params, VIEW).sum()

    value, gradient = quick_jit(jax.value_and_grad(loss))(params)
    assert np.isfinite(value)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient["reach_critic"]))


def convolution(image: np.ndarray, weights: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """A 2x2 convolution with ReLU, place by place; images are ``[C, H, W]``."""
    channels, height, width = image.shape
    # The weights' rows come corner by corner: (0, 0), (1, 0), (0, 1), (1, 1).
    kernel = weights.reshape(2, 2, channels, -1)
    result = np.zeros((weights.shape[1], height - 1, width - 1))
    for row, column in np.ndindex(height - 1, width - 1):
        patch = image[:, row : row + 2, column : column + 2].transpose(2, 1, 0)
        result[:, row, column] = np.tensordot(patch, kernel, 3) + bias
    return np.maximum(result, 0.0)


def test_convolutions_and_their_batches() -> None:
    """Against a convolution written out; with many images, many networks, and both."""
    rng = np.random.default_rng(0)
    shapes = ((12, 7), (28, 5))
    nets = [[(rng.normal(size=shape), rng.normal(size=shape[1:])) for shape in shapes] for _ in range(2)]
    images = rng.normal(size=(4, 3, 5, 6))
    expected = np.zeros((2, 4, 5 * 3 * 4))
    for which, image in np.ndindex(2, 4):
        x = images[image]
        for layer in nets[which]:
            x = convolution(x, *layer)
        expected[which, image] = x.reshape(-1)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *nets)
    single = [[convolve(image, net) for image in jnp.asarray(images)] for net in jax.tree.map(jnp.asarray, nets)]
    over_images = [jax.vmap(convolve, in_axes=(0, None))(images, net) for net in nets]
    over_nets = jnp.stack([jax.vmap(convolve, in_axes=(None, 0))(image, stacked) for image in images], axis=1)
    over_both = jax.vmap(jax.vmap(convolve, in_axes=(0, None)), in_axes=(None, 0))(images, stacked)
    for name, found in {"one": single, "images": over_images, "nets": over_nets, "both": over_both}.items():
        np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-4, atol=1e-4, err_msg=name)


def test_the_reach_critic_answers_in_the_unit_interval_for_each_goal() -> None:
    agent, params = setup(0)
    values = np.asarray(agent.low.reach_values(params, VIEW))
    assert values.shape == (4, 2)
    assert ((values > 0) & (values < 1)).all()


def instruction(rows: np.ndarray, network: NetworkConfig) -> Instruction:
    """To reach the first of the propositions (rows ``[R, P]``), avoid the second, and go on with the others."""
    future = np.zeros(network.task_features, np.float32)
    forbidden = rows[1] if network.forbidden else rows[1, :0]
    return Instruction(
        reach=rows[0], avoid=rows[1], forbidden=forbidden, ahead=rows[2:], behind=rows[:0], future=future
    )


@pytest.mark.parametrize("whole_task", [False, True])
def test_a_scaled_task_is_a_task_with_larger_weights(whole_task: bool) -> None:
    """What is scaled is the sub-task, and the whole task where there is no sub-task, but not what comes later."""
    network = dataclasses.replace(small_config().network, roles=False)
    plain, scaled = (
        small_agent(
            ENV,
            small_config(network=dataclasses.replace(network, task_scale=scale)),
            LTL2ACTION if whole_task else Ours(high=small_planner()),
        )
        for scale in (1.0, 4.0)
    )
    params = random_params(plain, 3)
    rows = slice(network.latent, None if whole_task else -network.task_features)

    def louder(path: Any, x: jax.Array) -> jax.Array:
        first = jax.tree_util.keystr(path) in {f"['params']['{part}']['Dense_0']['kernel']" for part in heads}
        return x.at[rows].multiply(4.0) if first else x

    heads = ("actor", "critic")
    assigned = instruction(np.eye(ENV.num_propositions, dtype=np.float32)[:2], network)
    assigned = assigned.replace(future=np.linspace(-1, 1, network.task_features, dtype=np.float32))
    heard = {**params, "low": jax.tree_util.tree_map_with_path(louder, params["low"])}
    before, after = plain.low.control(params, VIEW, assigned), scaled.low.control(params, VIEW, assigned)
    for a, b, old in zip(after, plain.low.control(heard, VIEW, assigned), before, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
        assert np.abs(np.asarray(a - old)).max() > 1e-3


@pytest.mark.parametrize("waves", [0, 2])
def test_what_is_charted_of_a_proposition_is_seen_by_its_role(waves: int) -> None:
    """Propositions that change places in the chart, and in the weights that know them by name, do so in the task."""
    network = dataclasses.replace(small_config().network, roles=True, chart=(8, 3), waves=waves, memory=0)
    agent, order = small_agent(ENV, small_config(network=network)), np.array([2, 0, 3, 1])
    params = random_params(agent, 3)

    def renamed(path: Any, x: jax.Array) -> jax.Array:
        name = jax.tree_util.keystr(path)
        if "['chart']['Dense_1']" in name:
            return x.reshape(*x.shape[:-1], len(order), -1)[..., order, :].reshape(x.shape)
        if name.endswith(("['actor']['Dense_0']['kernel']", "['critic']['Dense_0']['kernel']")):
            rows = np.concatenate([network.latent + order, network.latent + len(order) + order])
            return x.at[network.latent + np.arange(len(rows))].set(x[rows])
        return x[order] if name.endswith("['task_embedding']['edge']['kernel']") else x

    task = instruction(np.eye(len(order), dtype=np.float32)[: 2 + network.lookahead], network)
    other = instruction(np.eye(len(order), dtype=np.float32)[: 2 + network.lookahead, order], network)
    blind = VIEW._replace(propositions=jnp.zeros_like(VIEW.propositions))
    there = {**params, "low": jax.tree_util.tree_map_with_path(renamed, params["low"])}
    for before, after, unknown in zip(
        agent.low.control(params, blind, task),
        agent.low.control(there, blind, other),
        agent.low.control(params, blind, other),
        strict=True,
    ):
        np.testing.assert_allclose(after, before, rtol=1e-5, atol=1e-6)
        assert np.abs(np.asarray(unknown - before)).max() > 1e-3


def test_waves_are_sines_and_cosines_of_lengths_four_and_two() -> None:
    np.testing.assert_allclose(with_waves(jnp.array([1.0]), 2), [1, 1, 0, 0, -1], atol=1e-6)
    x = jnp.array([0.3, -1.2])
    seen, a_length_on, half_a_length_on = (with_waves(x + shift, 2)[2:] for shift in (0.0, 4.0, 2.0))
    np.testing.assert_allclose(a_length_on, seen, atol=1e-5)
    np.testing.assert_allclose(half_a_length_on, seen * np.tile(np.repeat([-1, 1], 2), 2), atol=1e-5)
    np.testing.assert_array_equal(with_waves(x, 0), x)


def test_an_encoder_of_its_own_learns_for_the_value_alone() -> None:
    """Nothing that the actor sees through learns for the critic, and nothing the other way round."""
    network = dataclasses.replace(small_config().network, roles=True, chart=(8, 3), critic_encoder=True)
    agent = small_agent(ENV, small_config(network=network))
    params = random_params(agent, 3)
    task = instruction(np.eye(ENV.num_propositions, dtype=np.float32)[: 2 + network.lookahead], network)

    def learning(loss: Callable[[tuple[jax.Array, jax.Array]], jax.Array]) -> set[str]:
        grads = jax.grad(lambda low: loss(agent.low.control({**params, "low": low}, VIEW, task)))(params["low"])
        return {name for name, part in grads["params"].items() if any(np.any(x) for x in jax.tree.leaves(part))}

    assert learning(lambda both: both[0].sum()) == {"encoder", "chart", "actor"}
    assert learning(lambda both: both[1]) == {"critic_encoder", "critic_chart", "critic"}


def test_what_is_near_is_seen_by_role_with_a_steeper_reading() -> None:
    """Of the goal, of p₋ and of what is forbidden, after what is seen of all roles as it is."""
    env = envs_jax.make("zone", physics="closed-form")
    lidar, shared = np.random.default_rng(0).random((4, 16)).astype(np.float32), np.zeros(16, np.float32)
    network = dataclasses.replace(small_config().network, roles=True, lookahead=2, forbidden=True, near=0.8)
    agent = small_agent(env, small_config(network=network))
    task = instruction(np.eye(4, dtype=np.float32), network).replace(forbidden=np.array([0, 0, 1, 1], np.float32))
    steep = (lidar / 0.8) ** 8
    roles = [*lidar, lidar[2] + lidar[3], steep[0], steep[1], steep[2] + steep[3]]
    np.testing.assert_allclose(agent.low.see(View(lidar, shared), task).planes, np.stack(roles), rtol=1e-5)
    by_name = small_agent(env, small_config(network=dataclasses.replace(network, roles=False)))
    np.testing.assert_allclose(by_name.low.see(View(lidar, shared), task).planes, [*lidar, *steep], rtol=1e-5)


def test_the_low_level_turns_with_the_world() -> None:
    """Seen through any of the eight turns, it acts as before, turned, and values what it sees alike."""
    env = envs_jax.make("letter")
    network = dataclasses.replace(small_config().network, lookahead=3, symmetric=True)
    agent, turns = small_agent(env, small_config(network=network)), env.symmetries
    assert turns is not None
    params = random_params(agent, 3)
    letters = np.eye(env.num_propositions, dtype=np.float32)
    assigned = instruction(letters, network)
    control = quick_jit(lambda view: agent.low.control(params, View(*view), assigned))
    straight = 0
    for seed in range(10):
        observation, _ = env.reset(jax.random.key(seed), env.default_params)
        planes, shared = env.proposition_view(observation)
        outputs, value = control((planes, shared))
        for bits, actions in zip(TURNS, turns.actions, strict=True):
            again, same = control((turned(planes, *bits), shared))
            np.testing.assert_allclose(np.asarray(again)[np.array(actions)], outputs, rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(same, value, rtol=1e-4, atol=1e-4)
        straight += len(np.unique(np.round(np.asarray(outputs), 3)))
    assert straight > 20  # the outputs do tell the actions apart


@pytest.mark.parametrize("more", [{}, {"forbidden": True, "near": 0.8}])
def test_the_low_level_is_reflected_with_the_world(more: dict[str, Any]) -> None:
    """Seen in any of the four mirrors, its actions are reflected likewise, and it values what it sees alike."""
    env = envs_jax.make("zone", physics="closed-form")
    network = dataclasses.replace(small_config().network, lookahead=2, symmetric=True, **more)
    agent, mirrors = small_agent(env, small_config(network=network)), env.symmetries
    params = random_params(agent, 3)
    colours = np.eye(4, dtype=np.float32)
    assigned = instruction(colours, network)
    control = quick_jit(lambda view: agent.low.control(params, View(*view), assigned))
    rng = np.random.default_rng(0)
    actions = set()
    for _ in range(10):
        lidar, shared = rng.random((4, 16)).astype(np.float32), rng.normal(size=16).astype(np.float32)
        outputs, value = control((lidar, shared))
        actions.add(tuple(np.sign(outputs[:2]).tolist()))
        for k in range(4):
            reflected = lidar[:, np.array(mirrors.features[k])], shared[np.array(mirrors.shared[k])] * mirrors.signs[k]
            again, same = control(reflected)
            np.testing.assert_allclose(again[:2] * np.array(mirrors.actions[k]), outputs[:2], rtol=1e-3, atol=1e-4)
            np.testing.assert_allclose(again[2:], outputs[2:], rtol=1e-3, atol=1e-4)
            np.testing.assert_allclose(same, value, rtol=1e-3, atol=1e-4)
    assert len(actions) > 1
