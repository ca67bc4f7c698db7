"""The low level: its instruction, its policy and value, and the reach critic of its shield.

Axes: **N** tree nodes, **P** atomic propositions, **D** later sub-tasks, **K** candidate actions, **M** tasks,
**B** environments of a batch, **V** environments and relabelled copies, **T** time steps, **S** episodes of one.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32

from envs_jax import Environment, Symmetric
from envs_jax.arrays import Array
from hrlspec.agent.distributions import Distribution, distribution_over
from hrlspec.agent.experience import Step, View
from hrlspec.agent.groups import take
from hrlspec.agent.networks.controller import Controller, Instruction, Sees, Sight
from hrlspec.agent.networks.exclusions import Exclusions, entries
from hrlspec.agent.networks.reach_critic import ReachCritic
from hrlspec.agent.networks.tree import forks
from hrlspec.config import Config
from hrlspec.spec import TaskTree
from hrlspec.spec.automata import Automata

Params = dict[str, Any]
"""Parameters by part: ``low``, ``high`` and ``reach_critic``."""


@struct.dataclass
class TaskBook:
    """M tasks and the instructions for their edges, computed once per task and parameters.

    Attributes:
        tree: the tasks, leading axis M.
        instructions: the instruction for each edge, leading axes ``[M, N]``.
        forks: bool ``[M, N]``, more than one way leads on from the node or from one below it.
        automata: where the tasks are automata, whose states are the rows; else the trees are followed.
    """

    tree: TaskTree
    instructions: Instruction
    forks: Bool[Array, "*lead N"]
    automata: Automata | None = None


@dataclasses.dataclass(frozen=True)
class LowLevel:
    """The low level's networks for one environment. Static: its parameters are an argument.

    Attributes:
        env: the environment it acts in.
        config: the run's configuration.
        sees: the part of the task that it is conditioned on.
        follows_plan: whether it is conditioned on the sequence of sub-tasks planned by the high level.
    """

    env: Environment
    config: Config
    sees: Sees
    follows_plan: bool

    @functools.cached_property
    def actions(self) -> Distribution:
        """What the policy is a distribution over."""
        return distribution_over(self.env.action_space)

    @functools.cached_property
    def controller(self) -> Controller:
        """The policy's and the value's network."""
        return Controller(
            self.config.network,
            self.actions.num_outputs,
            self.env.num_propositions,
            self.sees,
            self.follows_plan,
            self.env.symmetries if isinstance(self.env, Symmetric) else None,
        )

    @functools.cached_property
    def reach_critic(self) -> ReachCritic:
        """The critic behind the shield."""
        return ReachCritic(self.config.network.reach_critic, self.actions)

    def instruct(self, params: Params, tree: TaskTree) -> Instruction:
        """The instruction for every edge of one task, leading axis N."""
        return cast(Instruction, self.controller.apply(params["low"], tree, method="instruct"))

    def prepare(self, params: Params, tasks: TaskTree | Automata) -> TaskBook:
        """Prepares tasks for acting: trees (leading axis M), or automata, whose states are the M rows then."""
        automata = tasks if isinstance(tasks, Automata) else None
        trees = self._staying(tasks.trees) if isinstance(tasks, Automata) else tasks
        instructions = jax.vmap(self.instruct, in_axes=(None, 0))(params, trees)
        return TaskBook(tree=trees, instructions=instructions, forks=jax.vmap(forks)(trees), automata=automata)

    def _staying(self, trees: TaskTree) -> TaskTree:
        """How long p₊ holds before a jump after which it must; nothing of that for who was not trained to stay."""
        config = self.config.curriculum
        hold = None if trees.hold is None or not config.stay else jnp.where(trees.hold > 1, config.hold_before_jump, 1)
        return dataclasses.replace(trees, hold=hold)

    def instructions_at(
        self,
        params: Params,
        instructions: Instruction,
        where: tuple[Int[Array, "..."], ...],
        edge: Int32[Array, "*lead"],
        feasible: Bool[Array, "*lead _"],
        ahead: Float32[Array, "*lead D P"],
    ) -> Instruction:
        """The instructions at single time steps.

        Args:
            params: the networks' parameters.
            instructions: the instructions for every edge, as in a `TaskBook`: any leading axes, then N.
            where: indices of the tasks, one for each leading axis.
            edge: int32 ``[...]``, the edges assigned.
            feasible: bool ``[..., N]``, the open edges; used where the policy is conditioned on the whole task.
            ahead: float32 ``[..., D, P]``, the reach sets of the sub-tasks planned after them.
        """
        if self.sees != "whole task":
            return dataclasses.replace(take(instructions, *where, edge), ahead=ahead)
        future = self.controller.apply(params["low"], instructions.future[where], feasible, method="remaining")
        nothing = jnp.zeros((*edge.shape, instructions.reach.shape[-1]), jnp.float32)
        behind = jnp.zeros((*edge.shape, 0, instructions.reach.shape[-1]), jnp.float32)
        forbidden = nothing[..., : instructions.forbidden.shape[-1]]
        return Instruction(
            reach=nothing, avoid=nothing, forbidden=forbidden, ahead=ahead, behind=behind, future=cast(Array, future)
        )

    def instructions_of(
        self,
        params: Params,
        trees: TaskTree,
        slot: Int32[Array, "V T"],
        edge: Int32[Array, "V T"],
        feasible: Bool[Array, "V T _"],
        ahead: Float32[Array, "V T D P"],
    ) -> Instruction:
        """The instructions at all steps ``[V, T]`` of rollouts whose tasks are ``trees``, leading axes ``[V, S]``.

        Args:
            params: the networks' parameters.
            trees: the tasks of each environment's episodes.
            slot: int32 ``[V, T]``, which of them.
            edge, feasible, ahead: as in `instructions_at`.
        """
        instructions = jax.vmap(jax.vmap(self.instruct, in_axes=(None, 0)), in_axes=(None, 0))(params, trees)
        row = jnp.arange(slot.shape[0], dtype=jnp.int32)[:, None]
        return self.instructions_at(params, instructions, (row, slot), edge, feasible, ahead)

    def control(
        self, params: Params, view: View, instruction: Instruction
    ) -> tuple[Float32[Array, " outputs"], Float32[Array, ""]]:
        """What describes the policy on one environment (see ``actions``), and the value ``[]``."""
        return cast("tuple[Array, Array]", self.controller.apply(params["low"], view, instruction))

    def see(self, view: View, instruction: Instruction) -> Sight:
        """What `control` makes of one observation before its parameters: worth keeping between epochs."""
        return cast(Sight, self.controller.apply({}, view, instruction, method="see"))

    def respond(
        self, params: Params, sight: Sight, instruction: Instruction
    ) -> tuple[Float32[Array, " outputs"], Float32[Array, ""]]:
        """What `control` makes of what `see` gave it."""
        return cast("tuple[Array, Array]", self.controller.apply(params["low"], sight, instruction, method="respond"))

    def value_of(
        self,
        params: Params,
        view: View,
        instructions: Instruction,
        edge: Int[Array, " B"],
        feasible: Bool[Array, "B N"],
    ) -> Float32[Array, " B"]:
        """V^l of pursuing an edge in each of B environments, ``[B]``.

        Args:
            params: the networks' parameters.
            view: observations.
            instructions: the instruction for each edge, leading axes ``[B, N]``.
            edge: int32 ``[B]``.
            feasible: bool ``[B, N]``, the open edges.
        """
        rows = jnp.arange(edge.shape[0], dtype=jnp.int32)
        now = self.instructions_at(params, instructions, (rows,), edge, feasible, instructions.ahead[rows, edge])
        return jax.vmap(self.control, in_axes=(None, 0, 0))(params, view, now)[1]

    def measure(self, steps: Step) -> Any:
        """What is counted in a rollout ``[T, E]`` rather than learned by gradient: a pytree of sums for `observe`."""
        return entries(steps.outcome.labels, steps.episode) if self.config.network.exclusions else ()

    def observe(self, params: Any, measured: Any) -> Any:
        """``params["low"]`` after a rollout, from the sums of `measure`."""
        if not self.config.network.exclusions:
            return params
        name, new = Exclusions.COLLECTION, {"exclusions": {"entries": measured}}
        return {**params, name: jax.tree.map(jnp.add, params[name], new)}

    def reach_values(self, params: Params, view: View) -> Float32[Array, "P K"]:
        """Q(s, g, a) of reaching each proposition by each candidate action, float32 ``[P, K]``.

        Raises:
            ValueError: the agent has no reach critic.
        """
        if "reach_critic" not in params:
            raise ValueError("a shield needs a reach critic, and this agent, trained without a shield, has none")
        return cast(Array, self.reach_critic.apply(params["reach_critic"], view))

    def reach_values_of(
        self, params: Params, view: View, action: Int32[Array, ""] | Float32[Array, " A"]
    ) -> Float32[Array, " P"]:
        """Q(s, g, a) of reaching each proposition by one action, float32 ``[P]``."""
        return cast(Array, self.reach_critic.apply(params["reach_critic"], view, action, method="of"))
