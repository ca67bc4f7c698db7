"""Probe worlds, probe tasks and tiny configurations whose values are known in closed form.

Also what several tests share: a plain-Python reading of the monitor, and trees cut and written down differently.
Axes: **L** cells of a corridor, **P** propositions, **N** tree nodes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs_jax.base import Box, Discrete, Environment, EnvParams, StepResult
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import View
from hrlspec.agent.networks.planner import PlannerConfig
from hrlspec.checkpoint import state_hash
from hrlspec.config import (
    Config,
    CurriculumConfig,
    NetworkConfig,
    OptimiserConfig,
    PPOConfig,
    ShieldConfig,
    evolve,
)
from hrlspec.evaluation import suite_from_text
from hrlspec.methods import ImplicitPlanner, Method, Ours
from hrlspec.spec.tree import TaskTree
from hrlspec.tasks.bank import ITERATIONS_PER_BANK
from tests.trees import tree_of


def probe_task(name: str, *, num_propositions: int, num_nodes: int) -> TaskTree:
    """The probe specifications, as trees."""
    edges = {
        "achieve a": [(0, "a", "")],
        "a; b": [(0, "a", ""), (1, "b", "")],
        "a or b": [(0, "a", ""), (0, "b", "")],
        "b or a": [(0, "b", ""), (0, "a", "")],
        "(a or b); c": [(0, "a", ""), (0, "b", ""), (1, "c", ""), (2, "c", "")],
        "a ensuring not b": [(0, "a", "b")],
        "achieve b": [(0, "b", "")],
        "b ensuring not a": [(0, "b", "a")],
        "(achieve a); c": [(0, "a", ""), (1, "c", "")],
        "(achieve b); c": [(0, "b", ""), (1, "c", "")],
        "(a ensuring not b); c": [(0, "a", "b"), (1, "c", "")],
        "(b ensuring not a); c": [(0, "b", "a"), (1, "c", "")],
    }[name]
    return tree_of(edges, num_propositions=num_propositions, num_nodes=num_nodes)


def bank_of(tasks: Sequence[TaskTree], rows: int) -> TaskTree:
    """A bank of so many rows, the tasks in turn."""
    return jax.tree.map(lambda *x: np.stack([x[i % len(x)] for i in range(rows)]), *tasks)


@struct.dataclass
class CorridorLayout:
    """Where an episode starts."""

    start: jax.Array  # int32 []


@struct.dataclass
class CorridorState:
    position: jax.Array  # int32 []
    layout: CorridorLayout
    time: jax.Array  # int32 []


@dataclasses.dataclass(frozen=True)
class Corridor(Environment):
    """A row of cells, walls at both ends; cell i bears the letters ``cells[i]``, any number of them.

    Actions: 0 left, 1 right. Observation: float32 ``[P + 1, L]``, where each letter lies, and where the agent is.
    The layout is only the start, drawn from ``starts``: an observation tells position and letters, nothing else.
    """

    cells: tuple[str, ...] = ("a", "", "", "", "b", "c")
    starts: tuple[int, ...] = (1, 2, 3)
    horizon: int = 12
    name: str = "corridor"

    @property
    def propositions(self) -> tuple[str, ...]:
        return tuple("abcd")

    @property
    def table(self) -> np.ndarray:
        """bool ``[L, P]``, the letters of each cell."""
        return np.array([[letter in cell for letter in self.propositions] for cell in self.cells])

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return (len(self.propositions) + 1, len(self.cells))

    @property
    def observation_space(self) -> Box:
        return Box(low=0.0, high=1.0, shape=self.observation_shape)

    @property
    def action_space(self) -> Discrete:
        return Discrete(n=2)

    def sample_layout(self, key: jax.Array, params: EnvParams) -> CorridorLayout:
        drawn = jax.random.randint(key, (), 0, len(self.starts), jnp.int32)
        return CorridorLayout(jnp.asarray(self.starts, jnp.int32)[drawn])

    def resample_layout(self, key: jax.Array, layout: Any, needed: jax.Array, params: EnvParams) -> CorridorLayout:
        return jax.tree.map(lambda new, old: jnp.where(needed, new, old), self.sample_layout(key, params), layout)

    def check_layout(self, layout: Any) -> None:
        if not 0 <= layout.start < len(self.cells):
            raise ValueError(f"start is {layout.start}")

    def reset_to(self, layout: CorridorLayout, key: jax.Array, params: EnvParams) -> tuple[jax.Array, CorridorState]:
        state = CorridorState(position=layout.start, layout=layout, time=jnp.int32(0))
        return self.observation(state, params), state

    def step_env(self, key: jax.Array, state: CorridorState, action: jax.Array, params: EnvParams) -> StepResult:
        position = jnp.clip(state.position + 2 * action - 1, 0, len(self.cells) - 1).astype(jnp.int32)
        state = state.replace(position=position, time=state.time + 1)
        truncated = state.time >= params.horizon
        return self.observation(state, params), state, jnp.float32(0.0), jnp.bool_(False), truncated, {}

    def labels(self, state: CorridorState, params: EnvParams) -> jax.Array:
        return jnp.asarray(self.table)[state.position]

    def observation(self, state: CorridorState, params: EnvParams) -> jax.Array:
        here = jnp.arange(len(self.cells)) == state.position
        return jnp.concatenate([jnp.asarray(self.table).T, here[None]]).astype(jnp.float32)

    def proposition_view(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        return observation[:-1], observation[-1]

    def view_at(self, position: Any) -> View:
        """The view from given cells (int, any leading axes)."""
        position = jnp.asarray(position)
        planes = jnp.broadcast_to(jnp.asarray(self.table.T, jnp.float32), (*position.shape, *self.table.T.shape))
        return View(planes, jax.nn.one_hot(position, len(self.cells)))


_PPO = PPOConfig(
    optimiser=OptimiserConfig(learning_rate=2e-3, final_learning_rate=0.0, epochs=4, minibatches=2),
    entropy=0.05,
    final_entropy=0.01,
)


def small_config(**changes: Any) -> Config:
    """Every technique on, as small as it goes; compiled programs are shared by tests that change nothing."""
    config = Config(
        num_envs=32,
        num_steps=24,
        total_steps=200 * 32 * 24,
        discount=0.9,
        group=8,
        low=_PPO,
        network=NetworkConfig(
            latent=16,
            conv_channels=(),
            encoder_mlp=(32,),
            task_features=8,
            task_rounds=0,
            actor=(32,),
            critic=(32,),
            reach_critic=(32,),
            roles=True,
        ),
        curriculum=CurriculumConfig(levels=2, tasks_per_level=32, max_nodes=6, window=64),
        shield=ShieldConfig(optimiser=evolve(ShieldConfig.optimiser, {"minibatches": 4})),
    )
    return dataclasses.replace(config, **changes)


ITERATIONS = ITERATIONS_PER_BANK + 1
"""So many that a second bank is drawn."""
CORRIDOR_CONFIG = small_config(num_envs=16, num_steps=16, total_steps=ITERATIONS * 16 * 16)
CORRIDOR_HELD_OUT = suite_from_text(
    "held out", "achieve a\nachieve a; achieve b\nachieve b or achieve c", Corridor().propositions
)
"""What several files train the corridor with: it is compiled once for all of them."""


def small_planner(**changes: Any) -> ImplicitPlanner:
    """As `small_config`, for the planner; changes by dotted names with ``__`` for dots."""
    planner = ImplicitPlanner(
        network=PlannerConfig(features=16, hidden=16, policy=(16,), rounds=0),
        ppo=_PPO,
        learns_from_copies=False,
        steps_per_sample=4,
    )
    return evolve(planner, {name.replace("__", "."): value for name, value in changes.items()})


def small_agent(env: Environment, config: Config | None = None, method: Method | None = None, **planner: Any) -> Agent:
    """An agent of the paper's method, or of another, with small settings."""
    return Agent(env, config or small_config(), method or Ours(high=small_planner(**planner)))


def quick_jit(function: Any, **options: Any) -> Any:
    """``jax.jit`` for programs that run a few times: compiled in a fraction of the time, without optimisation."""
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 0}, **options)


def random_params(agent: Agent, seed: int) -> Any:
    """Parameters of the right shapes, biases included, without compiling the initialisers."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(agent.init, jax.random.key(0))

    def draw(x: Any) -> jax.Array:
        inputs = x.shape[0] if x.shape else 1
        return jnp.asarray(rng.normal(size=x.shape) / np.sqrt(max(inputs, 4)), x.dtype)

    return jax.tree.map(draw, shapes)


def on_device(tree: Any) -> Any:
    """A pytree's arrays as JAX arrays."""
    return jax.tree.map(jnp.asarray, tree)


def assert_agree(one: Any, other: Any) -> None:
    """Equal, but for the last digits of floats."""
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(x.dtype, jnp.floating):
            np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-5)
        else:
            assert state_hash(x) == state_hash(y)


def pairs(flags: Any) -> set[int]:
    """The indices of the propositions that are true."""
    return set(np.flatnonzero(np.asarray(flags)).tolist())


def read_monitor(
    tree: TaskTree, node: int, blocked: set[int], labels: set[int], assigned: int
) -> tuple[int, set[int], str]:
    """One step of the committed reading, in plain Python: new node, blocked edges, and how the task stands."""
    edges = [k for k in range(tree.num_nodes) if tree.valid[k] and tree.parent[k] == node and k not in blocked]
    blocked = blocked | {k for k in edges if pairs(tree.avoid[k]) & labels}
    edges = [k for k in edges if k not in blocked]
    met = [k for k in edges if pairs(tree.reach[k]) <= labels]
    if met:
        best = assigned if assigned in met else min(met, key=lambda k: (-len(pairs(tree.reach[k])), k))
        return best, set(), "satisfied" if tree.accepting[best] else "running"
    return node, blocked, "running" if edges else "violated"


def reordered(tree: TaskTree, order: Sequence[int]) -> TaskTree:
    """The same task with node ``order[i]`` written in row i; ``order`` must keep parents before children."""
    order = np.asarray(order)
    row = np.argsort(order)
    moved = jax.tree.map(lambda x: np.asarray(x)[order], tree)
    return moved.replace(parent=np.where(moved.parent >= 0, row[moved.parent], TaskTree.NO_NODE).astype(np.int32))


def random_order(rng: np.random.Generator, tree: TaskTree) -> np.ndarray:
    """A random order of the nodes in which parents come before children; padding anywhere but first."""
    waiting, order = list(range(1, tree.num_nodes)), [0]
    while waiting:
        ready = [k for k in waiting if tree.parent[k] < 0 or tree.parent[k] in order]
        order.append(int(rng.choice(ready)))
        waiting.remove(order[-1])
    return np.array(order)


def subtree(tree: TaskTree, node: int, num_nodes: int) -> tuple[TaskTree, list[int]]:
    """The progression at a node as a tree of its own, and which of the original rows became its rows."""
    rows = [node]
    for k in range(tree.num_nodes):
        if tree.valid[k] and tree.parent[k] in rows:
            rows.append(k)
    cut = jax.tree.map(
        lambda x: np.concatenate([x[rows], np.zeros((num_nodes - len(rows), *x.shape[1:]), x.dtype)]), tree
    )
    parent = np.full(num_nodes, TaskTree.NO_NODE, np.int32)
    parent[1 : len(rows)] = [rows.index(int(p)) for p in tree.parent[rows[1:]]]
    used = np.arange(num_nodes) > 0
    return cut.replace(
        parent=parent,
        reach=cut.reach & used[:, None],
        avoid=cut.avoid & used[:, None],
        accepting=cut.accepting & used,
        depth=np.where(parent >= 0, cut.depth - tree.depth[node], 0).astype(np.int32),
    ), rows


def padded(tree: TaskTree, num_nodes: int) -> TaskTree:
    """The same task with more padding."""
    extra = num_nodes - tree.num_nodes
    wide = jax.tree.map(
        lambda x: np.concatenate([x, np.zeros((extra, *x.shape[1:]), x.dtype)]), jax.tree.map(np.asarray, tree)
    )
    return wide.replace(parent=np.where(wide.valid & (np.arange(num_nodes) > 0), wide.parent, TaskTree.NO_NODE))
