"""Two rollouts in a row of a small agent, made once in a process, and how to look at them."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import HighBatch, LowBatch, Step
from hrlspec.agent.interaction import assign, start
from hrlspec.agent.low_level import TaskBook
from hrlspec.config import CurriculumConfig, RelabelConfig, evolve
from hrlspec.learning.batch import high_batch, low_batch
from hrlspec.learning.experience import gather
from hrlspec.learning.rollout import Collector, Setting, collect, fill_pool
from hrlspec.methods import Ours
from hrlspec.spec import TaskState, TaskTree
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine
from tests.probes import Corridor, quick_jit, random_params, small_config, small_planner

# Letters everywhere, two of them together, and a short horizon: many episodes that end in every way.
ENV = Corridor(cells=("a", "", "bc", "", "d", "", ""), starts=(1, 3, 5), horizon=9)
CONFIG = small_config(
    num_steps=48,
    curriculum=CurriculumConfig(levels=3, tasks_per_level=32, max_nodes=8, tree_share=0.5),
    shield=evolve(small_config().shield, {"threshold": 0.6}),
    relabel=RelabelConfig(share=1.0),
)
PLANNER = small_planner(network__advice=1.0, advised=3, learns_unfinished=True)
AGENT = Agent(ENV, CONFIG, Ours(high=PLANNER))
E, T = CONFIG.num_envs, CONFIG.num_steps
RULES = [Bonus("a", "d", 5.0), Bonus("b", "d", 10.0, ("a",))]
LEVEL = 2


class Rollout(NamedTuple):
    """One rollout, what is learned from it, and where it leaves the environments."""

    trajectory: Step
    low: LowBatch
    plan: HighBatch
    after: Collector


@quick_jit
def prepare(params: Any, bank: TaskTree, key: jax.Array) -> tuple[TaskBook, Collector]:
    tasks = jax.tree.map(lambda x: x[:E], bank)
    book = AGENT.low.prepare(params, jax.tree.map(lambda *x: jnp.concatenate(x), tasks, bank))
    layouts = jax.vmap(ENV.sample_layout, (0, None))(jax.random.split(key, E), ENV.default_params)
    worker = start(jax.random.split(key, E), ENV, machine(), book, layouts, jnp.arange(E))
    worker = assign(AGENT, params, book, worker, jnp.zeros((E, 8)))
    zeros = jnp.zeros(E, jnp.int32)
    return book, Collector(worker=worker, level=zeros, started=zeros, since=zeros, layout=None)


def batches(agent: Agent, key: jax.Array, params: Any, book: TaskBook, steps: Step) -> tuple[LowBatch, HighBatch]:
    """What an iteration learns from."""
    relabel_key, pick_key = jax.random.split(key)
    blocks = gather(relabel_key, agent, params, machine(), book, steps, jnp.zeros(1, jnp.uint32), jnp.arange(E))
    experience = jax.tree.map(lambda x: x[0], blocks)
    assert agent.high.ppo is not None
    return low_batch(agent, params, experience), high_batch(pick_key, agent, experience, agent.high.ppo)


@quick_jit
@chex.assert_max_traces(n=1)
def roll(params: Any, book: TaskBook, collector: Collector, key: jax.Array) -> Rollout:
    keys = jax.random.split(key, 3)
    envs = jnp.arange(E, dtype=jnp.int32)
    pool = fill_pool(keys[0], AGENT, book, jnp.int32(LEVEL), envs, size=12)
    after, trajectory = collect(keys[1], Setting(AGENT, params, machine(), book, pool, envs), collector, 0.0)
    return Rollout(trajectory, *batches(AGENT, keys[2], params, book, trajectory), after)


def machine() -> RewardMachine:
    return reward_machine(ENV.propositions, subtask=0.5, bonuses=RULES)


@functools.cache
def params() -> Any:
    return random_params(AGENT, 3)


@functools.cache
def rollouts() -> tuple[TaskBook, Rollout, Rollout]:
    """Two in a row; the tests look at the second, which begins and ends in the middle of episodes."""
    bank = draw_bank(np.random.default_rng(0), CONFIG.curriculum, 4, np.zeros(0, np.uint32))
    book, collector = prepare(params(), bank, jax.random.key(0))
    first = roll(params(), book, collector, jax.random.key(1))
    second = roll(params(), book, first.after, jax.random.key(2))
    return jax.tree.map(np.asarray, (book, first, second))


def ways(tree: TaskTree, node: int, lost: Any = None) -> int:
    """How many paths to a leaf are open; those that begin with a lost edge are not."""
    children = [i for i in np.flatnonzero(tree.parent == node) if tree.valid[i] and (lost is None or not lost[i])]
    return sum(ways(tree, i) for i in children) or int(tree.accepting[node])


def tree_of_row(book: TaskBook, row: int) -> TaskTree:
    return jax.tree.map(lambda x: x[row], book.tree)


def position(view: Any) -> np.ndarray:
    return view[1].argmax(-1)


def flat(x: Any) -> Any:
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), x)


@quick_jit
def plan_all(params: Any, view: Any, tree: TaskTree, state: TaskState) -> Any:
    instruction = jax.vmap(AGENT.low.instruct, (None, 0))(params, tree)
    choice = AGENT.high.choose(AGENT.low, params, view, tree, state, instruction)
    return choice.logits, choice.value


def log_probs(logits: Any, choice: np.ndarray) -> np.ndarray:
    return np.take_along_axis(np.asarray(jax.nn.log_softmax(logits)), choice[:, None], 1)[:, 0]
