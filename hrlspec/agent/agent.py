"""The agent: its networks and the pure functions that act with them.

Axes: **E** environments, **B** those of a batch, **N** tree nodes, **W** ways to a leaf, **P** atomic propositions,
**F** features, **K** candidate actions, **M** tasks.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
from flax import struct

from envs_jax import Environment
from hrlspec.agent.distributions import Distribution, distribution_over
from hrlspec.agent.networks.controller import Controller, Instruction
from hrlspec.agent.networks.encoder import randomised
from hrlspec.agent.networks.planner import MASKED, Planner
from hrlspec.agent.networks.reach_critic import ReachCritic
from hrlspec.agent.networks.tree import routes
from hrlspec.config import Config
from hrlspec.methods import option as options
from hrlspec.spec import TaskState, TaskTree, initial, open_edges

View = tuple[jax.Array, jax.Array]
Params = dict[str, Any]
Estimate = tuple[jax.Array, jax.Array]  # policy outputs and value
OPTION_SHARPNESS = 100.0
"""Logits per unit of value between options: a hundredth counts as much as the noise they are sampled with."""


@struct.dataclass
class TaskBook:
    """M tasks, and what the low level is told of them, computed once per task and parameters.

    Attributes:
        tree: the tasks, leading axis M.
        told: the instruction for each edge, leading axes ``[M, N]``.
    """

    tree: TaskTree
    told: Instruction


@dataclasses.dataclass(frozen=True)
class Agent:
    """Networks for one environment and one configuration. Static: close over it, or pass it as a static argument.

    Attributes:
        env: the environment the agent acts in.
        config: the run's configuration.
    """

    env: Environment
    config: Config

    @functools.cached_property
    def actions(self) -> Distribution:
        """What the low level's policy is a distribution over."""
        return distribution_over(self.env.action_space)

    @functools.cached_property
    def planner(self) -> Planner:
        """The high level."""
        return Planner(self.config.network)

    @functools.cached_property
    def controller(self) -> Controller:
        """The low level."""
        return Controller(self.config.network, self.actions.num_outputs, self.env.symmetries)

    @functools.cached_property
    def reach_critic(self) -> ReachCritic:
        """The critic behind the shield."""
        return ReachCritic(self.config.network.reach_critic, self.actions)

    def init(self, key: jax.Array) -> Params:
        """Fresh parameters: ``planner``, ``controller``, ``reach_critic``, and for the baseline Option ``options``.

        The key is consumed.
        """
        view = self.env.proposition_view(jnp.zeros(self.env.observation_shape))
        tree = _blank_tree(self.env.num_propositions)
        no_advice = jnp.zeros(tree.num_nodes)
        deviations = {
            "planner": self.planner.init(key, view, tree, initial(tree), no_advice),
            "controller": self.controller.init(key, view, tree, method="everything"),
            "reach_critic": self.reach_critic.init(key, view),
        }
        params = cast(Params, randomised(key, deviations))
        if self.config.options:
            params["options"] = options.unmeasured(self.env.num_propositions)
        return params

    def instruct(self, params: Params, tree: TaskTree) -> Instruction:
        """The instruction for every edge of one task, leading axis N; it says nothing of the future for Myopic-low."""
        told: Any = self.controller.apply(params["controller"], tree, method="instruct")
        if not self.config.future_embedding:
            told = dataclasses.replace(told, ahead=jnp.zeros_like(told.ahead), future=jnp.zeros_like(told.future))
        return cast(Instruction, told)

    def open_book(self, params: Params, trees: TaskTree) -> TaskBook:
        """Prepares tasks (leading axis M) for acting."""
        return TaskBook(tree=trees, told=jax.vmap(self.instruct, in_axes=(None, 0))(params, trees))

    def told_now(
        self,
        params: Params,
        told: Instruction,
        where: tuple[Any, ...],
        edge: jax.Array,
        feasible: jax.Array,
        ahead: jax.Array,
    ) -> Instruction:
        """What the low level is told at single moments.

        Args:
            params: the networks' parameters.
            told: the instructions for whole tasks, as a book has them: any leading axes, then N.
            where: indices of the moments' tasks, one for each leading axis.
            edge: int32 ``[...]``, the assigned edges.
            feasible: bool ``[..., N]``, the open ones; read where the whole task is told.
            ahead: float32 ``[..., D, P]``, what the planner means to reach afterwards.
        """
        if not self.config.network.whole_task:
            return dataclasses.replace(jax.tree.map(lambda x: x[(*where, edge)], told), ahead=ahead)
        future: Any = self.controller.apply(params["controller"], told.future[where], feasible, method="remaining")
        nothing = jnp.zeros((*edge.shape, told.reach.shape[-1]))
        behind = jnp.zeros((*edge.shape, 0, told.reach.shape[-1]))
        return Instruction(reach=nothing, avoid=nothing, ahead=ahead, behind=behind, future=future)

    def plan(self, params: Params, view: View, tree: TaskTree, state: TaskState, told: Instruction) -> Estimate:
        """The planner on one environment: logits over edges ``[N]`` and the value of the remaining task ``[]``."""
        batch = jax.tree.map(lambda x: x[None], (view, tree, state, told))
        logits, value, _, _ = self.plan_ahead(params, *batch)
        return logits[0], value[0]

    def plan_ahead(
        self, params: Params, view: View, tree: TaskTree, state: TaskState, told: Instruction
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """The planner on B environments, or what stands in its place, and what the low level says and is told.

        Returns:
            Logits over edges ``[B, N]``, values ``[B]``, the low level's advice on each edge ``[B, N]``, and what lies
            ahead after it, ``[B, N, D, P]``.
        """
        if not self.config.plans:
            return self._stand_in(params, view, tree, state, told)
        advice, ahead = self.advise(params, view, tree, state, told)
        plan: Any = jax.vmap(self.planner.apply, in_axes=(None, 0, 0, 0, 0))
        return (*plan(params["planner"], view, tree, state, advice), advice, ahead)

    def _stand_in(
        self, params: Params, view: View, tree: TaskTree, state: TaskState, told: Instruction
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """As `plan_ahead` for the baselines: options are chosen by their measurements, a flat policy needs no choice.

        The value is the low level's, of what is chosen.
        """
        feasible = jax.vmap(open_edges)(tree, state)
        if self.config.options:
            value = jax.vmap(options.values, in_axes=(None, 0, 0))(params["options"], tree, state)
            best = jnp.where(feasible.any(-1), value.max(-1), 0.0)
            logits = jnp.where(feasible, OPTION_SHARPNESS * (value - best[:, None]), MASKED)
        else:
            logits = jnp.where(jnp.arange(tree.parent.shape[-1]) == TaskTree.ROOT, jnp.zeros(feasible.shape), MASKED)
        edge = logits.argmax(-1)
        rows = jnp.arange(edge.shape[0])
        now = self.told_now(params, told, (rows,), edge, feasible, told.ahead[rows, edge])
        value = jax.vmap(self.control, in_axes=(None, 0, 0))(params, view, now)[1]
        return logits, value, jnp.zeros(logits.shape), told.ahead

    def advise(
        self, params: Params, view: View, tree: TaskTree, state: TaskState, told: Instruction
    ) -> tuple[jax.Array, jax.Array]:
        """The low level's advice in B environments: its value of each feasible edge and the best way on to a leaf.

        Zeros, and what all ways have in common, where the configuration gives advice no weight.

        Every way from the current node to a leaf is a sequence of sub-tasks, which the low level's critic values
        much better than a tree. Most tasks have few ways, so all that exist are valued side by side.

        Returns:
            Values of edges ``[B, N]``, without gradient, and what lies ahead on each edge's best way,
            ``[B, N, D, P]``.
        """
        if not self.config.network.advice:
            return jnp.zeros(tree.parent.shape), told.ahead
        edge, known, ways = jax.vmap(self._ways)(tree, state, told)
        num_ways = known.shape[1]

        def value(inputs: tuple[jax.Array, Instruction]) -> jax.Array:
            env, way = inputs
            seen = jax.tree.map(lambda x: x[env], view)
            return jax.vmap(self.control, in_axes=(None, 0, 0))(params, seen, way)[1]

        env = jnp.repeat(jnp.arange(known.shape[0]), num_ways)
        flat_ways = jax.tree.map(lambda x: x.reshape((known.size, *x.shape[2:])), ways)
        group = 2 * self.config.group
        values = in_groups(value, known.reshape(-1), (env, flat_ways), jnp.zeros(env.shape), group)
        advice, ahead = jax.vmap(_weigh)(edge, known, values.reshape(known.shape), ways.ahead, told.ahead)
        return jax.lax.stop_gradient(advice), ahead

    def _ways(self, tree: TaskTree, state: TaskState, told: Instruction) -> tuple[jax.Array, jax.Array, Instruction]:
        """The ways open in one environment: first edges ``[W]``, which of them exist ``[W]``, and instructions."""
        num_nodes = tree.num_nodes
        way = routes(tree, state.node, 1 + told.ahead.shape[1])
        leads = tree.accepting & (way[:, 0] >= 0) & open_edges(tree, state)[way[:, 0]]
        leaf = jnp.nonzero(leads, size=min(self.config.network.advised, num_nodes), fill_value=num_nodes)[0]
        way = way[jnp.minimum(leaf, num_nodes - 1)]
        edge, later = way[:, 0], way[:, 1:]
        ahead = tree.reach[later] & (later >= 0)[..., None] & self.config.future_embedding
        some = dataclasses.replace(jax.tree.map(lambda x: x[edge], told), ahead=ahead.astype(jnp.float32))
        return edge, leaf < num_nodes, some

    def control(self, params: Params, view: View, told: Instruction) -> tuple[jax.Array, jax.Array]:
        """The low level on one environment: what describes its policy (``actions``) and the value ``[]``."""
        return cast(Estimate, self.controller.apply(params["controller"], view, told))

    def reach_values(self, params: Params, view: View) -> jax.Array:
        """Q(s, g, a) of reaching each proposition by each candidate action, float32 ``[P, K]``."""
        return cast(jax.Array, self.reach_critic.apply(params["reach_critic"], view))

    def reach_values_of(self, params: Params, view: View, action: jax.Array) -> jax.Array:
        """Q(s, g, a) of reaching each proposition by one action, float32 ``[P]``."""
        return cast(jax.Array, self.reach_critic.apply(params["reach_critic"], view, action, method="of"))


def _weigh(
    edge: jax.Array, known: jax.Array, values: jax.Array, way_ahead: jax.Array, told_ahead: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """From values of ways ``[W]`` to each edge's best value ``[N]`` and what lies ahead on its best way."""
    mine = (edge == jnp.arange(told_ahead.shape[0])[:, None]) & known
    score = jnp.where(mine, values, -jnp.inf)
    worst = jnp.where(known.any(), jnp.where(known, values, jnp.inf).min(), 0.0)
    advice = jnp.where(mine.any(1), score.max(1), worst)
    return advice, jnp.where(mine.any(1)[:, None, None], way_ahead[score.argmax(1)], told_ahead)


def shielded_action(agent: Agent, params: Params, view: View, avoid: jax.Array, action: jax.Array) -> jax.Array:
    """Replaces an action that would step on a forbidden proposition (paper, "Avoiding Propositions").

    With k = argmax over p₋ of V(s, g_k): if V(s, g_k) > ν, the action becomes argmin_a Q(s, g_k, a). In mode
    ``action`` this happens only where the chosen action itself has some Q(s, g, action) > ν. Maxima and minima are over
    the candidates: exact for discrete actions.
    """
    shield = agent.config.shield
    if shield.mode == "off":
        return action
    values = jnp.where(avoid[:, None], agent.reach_values(params, view), 0.0)
    if shield.mode == "state":
        danger = values.max(-1)
    else:
        danger = jnp.where(avoid, agent.reach_values_of(params, view, action), 0.0)
    nearest = jnp.argmax(danger)
    away = values[nearest] if shield.mode == "state" else values.max(0)
    safest = agent.actions.candidates()[jnp.argmin(away)]
    return jnp.where(danger[nearest] > shield.threshold, safest, action)


def in_groups(function: Callable[[Any], Any], needed: jax.Array, inputs: Any, outputs: Any, group: int) -> Any:
    """Applies a costly function only to the environments that need it.

    A vmapped ``cond`` would compute it for all of them at every step. Instead the waiting ones are gathered
    in groups of fixed size, computed, and scattered back, until none waits.

    Args:
        function: maps gathered inputs (leading axis ``group``) to outputs of the same leading axis.
        needed: bool ``[E]``.
        inputs: pytree, leading axis E.
        outputs: pytree, leading axis E: what the others keep.
        group: how many at a time.
    """
    num_envs = needed.shape[0]
    group = min(group, num_envs)

    def body(carry: tuple[jax.Array, Any]) -> tuple[jax.Array, Any]:
        waiting, outputs = carry
        index = jnp.nonzero(waiting, size=group, fill_value=num_envs)[0]
        results = function(jax.tree.map(lambda x: x[jnp.minimum(index, num_envs - 1)], inputs))
        outputs = jax.tree.map(lambda out, new: out.at[index].set(new, mode="drop"), outputs, results)
        return waiting.at[index].set(False, mode="drop"), outputs

    return jax.lax.while_loop(lambda carry: carry[0].any(), body, (needed, outputs))[1]


def _blank_tree(num_propositions: int) -> TaskTree:
    """Two nodes and no edge, to initialise the networks with; no parameter's shape depends on N."""
    return TaskTree(
        parent=jnp.full(2, TaskTree.NO_NODE, jnp.int32),
        reach=jnp.zeros((2, num_propositions), bool),
        avoid=jnp.zeros((2, num_propositions), bool),
        accepting=jnp.zeros(2, bool),
        valid=jnp.array([True, False]),
        depth=jnp.zeros(2, jnp.int32),
    )
