"""Agents written by hand, for Letter: what they score is known without running the library's reference agents."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from envs_jax import Environment
from envs_jax.letter.world import MOVES
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import View
from hrlspec.agent.high_level import Choice, HighLevel
from hrlspec.agent.low_level import LowLevel, Params
from hrlspec.agent.networks.controller import Instruction
from hrlspec.config import Config
from hrlspec.methods import Method
from hrlspec.spec import TaskState, TaskTree, open_edges, subtask_avoid

FAR = 1e4


def manner(*, look_ahead: bool = False, last: bool = False) -> Params:
    """How a `walker` acts.

    Args:
        look_ahead: count the way from each goal to the next sub-task's nearest one too (for sequences, where nothing
            is avoided after the first sub-task); else the nearest goal is the best.
        last: the planner takes the edge into the last open node, else that into the first.
    """
    return {"look_ahead": jnp.bool_(look_ahead), "last": jnp.bool_(last)}


@dataclasses.dataclass(frozen=True)
class ByIndex(HighLevel):
    """Takes the edge into the first or the last open node."""

    def init(self, key: jax.Array, low: LowLevel, view: View, tree: TaskTree) -> Any:
        return {}

    def choose(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instruction: Instruction
    ) -> Choice:
        index = jnp.arange(tree.num_nodes)
        wish = jnp.where(params["last"], index, -index).astype(jnp.float32)
        logits = jnp.where(jax.vmap(open_edges)(tree, state), wish, -FAR)
        nothing = jnp.zeros(logits.shape)
        return Choice(logits, nothing[:, 0], nothing, instruction.ahead, nothing.astype(jnp.int32))


@dataclasses.dataclass(frozen=True)
class Scripted(Method):
    """Nothing is learned."""

    high: ByIndex = ByIndex()

    name: ClassVar[str] = "scripted"
    about: ClassVar[str] = "an agent written by hand"


class Walking(LowLevel):
    """Walks a shortest path to what its sub-task reaches, clear of what it avoids. Act greedily."""

    def instruct(self, params: Params, tree: TaskTree) -> Instruction:
        """The sub-task of every edge and what its first child reaches, leading axis N."""
        del params
        child = tree.parent[None, :] == jnp.arange(tree.num_nodes)[:, None]
        following = jnp.where(child.any(-1)[:, None], tree.reach[child.argmax(-1)], False)
        reach, avoid, ahead = (x.astype(jnp.float32) for x in (tree.reach, subtask_avoid(tree), following[:, None]))
        nothing = jnp.zeros((tree.num_nodes, 0))
        return Instruction(
            reach=reach, avoid=avoid, forbidden=nothing, ahead=ahead, behind=ahead[:, :0], future=nothing
        )

    def control(self, params: Params, view: View, instruction: Instruction) -> tuple[jax.Array, jax.Array]:
        """Minus the steps that remain after each action."""
        planes = view[0] > 0  # bool [P, n, n], the agent in the middle cell

        def holds(wanted: jax.Array) -> jax.Array:
            return (planes & (wanted > 0)[:, None, None]).any(0)

        after = _distance(jnp.where(holds(instruction.ahead[0]), 0.0, FAR), jnp.zeros(planes.shape[1:], bool))
        counts = params["look_ahead"] & instruction.ahead[0].any()
        ahead = _distance(
            jnp.where(holds(instruction.reach), jnp.where(counts, after, 0.0), FAR), holds(instruction.avoid)
        )
        middle = planes.shape[-1] // 2
        rows, columns = (middle + np.array(MOVES)).T % planes.shape[-1]
        return -ahead[rows, columns], jnp.float32(0)


class Walker(Agent):
    """An agent whose parameters, which change how it acts without compiling anything anew, come from `manner`."""

    @functools.cached_property
    def low(self) -> Walking:
        return Walking(self.env, self.config, self.method.sees, self.high.follows_plan)


def walker(env: Environment) -> Walker:
    """The agent in an environment that looks like Letter."""
    return Walker(env, Config(), Scripted())


def _distance(cost: jax.Array, closed: jax.Array) -> jax.Array:
    """Least cost of ending up in a cell after walking there, float32 ``[n, n]``."""

    def round_(_: Any, best: jax.Array) -> jax.Array:
        around = [jnp.roll(best, shift, axis) for shift in (1, -1) for axis in (0, 1)]
        onward = jnp.minimum(jnp.minimum(around[0], around[1]), jnp.minimum(around[2], around[3])) + 1
        return jnp.where(closed, FAR, jnp.minimum(cost, onward))

    return jax.lax.fori_loop(0, cost.size, round_, jnp.where(closed, FAR, cost))
