"""Ours: the paper's implicit planner (paper, "High-level Module" and "Training").

Axes: **B** environments or decisions of a batch, **N** tree nodes, **L** paths to a leaf, **D** later sub-tasks,
**P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float32, Int32, Key

from envs_jax.arrays import Array
from hrlspec.agent.distributions import MASKED, Categorical
from hrlspec.agent.experience import HighBatch, View
from hrlspec.agent.groups import in_groups, take
from hrlspec.agent.high_level import Choice, HighLevel, Judgement
from hrlspec.agent.low_level import LowLevel, Params
from hrlspec.agent.method import Method
from hrlspec.agent.networks.controller import Instruction
from hrlspec.agent.networks.planner import Planner, PlannerConfig
from hrlspec.agent.networks.tree import routes
from hrlspec.config import Checked, Config, OptimiserConfig, PPOConfig, check_divides, setting
from hrlspec.learning import ppo
from hrlspec.learning.optimiser import Metrics
from hrlspec.spec import TaskState, TaskTree, open_edges

_NETWORK = PlannerConfig()
_PPO = PPOConfig(
    optimiser=OptimiserConfig(learning_rate=2e-3, epochs=2, minibatches=8), entropy=0.005, final_entropy=0.005
)


@dataclasses.dataclass(frozen=True)
class ImplicitPlanner(Checked, HighLevel):
    """Plans in the latent space: predicted latents down the task tree, messages up it, an actor and a critic."""

    network: PlannerConfig = _NETWORK
    ppo: PPOConfig = _PPO
    max_operator: bool = True
    """Whether the low level's target at a new sub-task is raised to the planner's value (eq. 6)."""
    learns_unfinished: bool = False
    """Whether sub-tasks that were assigned but not completed train the planner."""
    learns_from_copies: bool = True
    """Whether the policy learns from relabelled copies; value and transition model always do. In a copy the branch
    taken was not chosen by the planner, and always succeeded."""
    steps_per_sample: int = setting(16, least=1)
    """The planner trains on at most E x T divided by this many decisions per iteration."""
    transe: float = setting(0.01, least=0, most=1e6)
    """Lambda, the weight of the TransE loss."""
    transe_margin: float = setting(1.0, least=0, most=1e6)
    """Xi, the margin of the TransE loss."""
    advised: int = setting(12, least=1)
    """Paths to a leaf that are valued for the advice; edges without one count as the worst of these."""

    @property
    def follows_plan(self) -> bool:
        """With the low level's advice the plan is the path that it values most."""
        return self.network.advice > 0

    def num_samples(self, config: Config) -> int:
        """See :class:`HighLevel`."""
        return config.envs_per_block * config.num_steps // self.steps_per_sample

    def check(self, config: Config) -> None:
        """See :class:`HighLevel`."""
        what = "planner samples (num_envs * num_steps / steps_per_sample / blocks)"
        check_divides("ImplicitPlanner.ppo.optimiser.minibatches", self.ppo.optimiser, self.num_samples(config), what)

    def planner(self, low: LowLevel) -> Planner:
        """The networks; a subclass that gives others of the same methods plans with them."""
        return Planner(self.network, low.config.network)

    def init(self, key: Key[Array, ""], low: LowLevel, view: View, tree: TaskTree) -> Any:
        """See :class:`HighLevel`."""
        state = TaskState(jnp.int32(0), jnp.zeros(tree.num_nodes, bool), jnp.int32(0))
        return self.planner(low).init(key, view, tree, state, jnp.zeros(tree.num_nodes, jnp.float32))

    def choose(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> Choice:
        """See :class:`HighLevel`."""
        advice, ahead = self.advise(low, params, view, tree, state, instructions)
        logits, value = self._plan(low, params["high"], view, tree, state, advice)
        return Choice(logits, value, advice, ahead)

    def judge(
        self,
        low: LowLevel,
        params: Params,
        view: View,
        tree: TaskTree,
        state: TaskState,
        instructions: Instruction,
    ) -> Judgement:
        """See :class:`HighLevel`.

        A copy ends in success and its returns are known: the planner is evaluated only where its outputs are used.
        """
        if self.learns_from_copies or self.max_operator:
            return super().judge(low, params, view, tree, state, instructions)
        return Judgement(
            jnp.zeros(state.node.shape, jnp.float32), self.advise(low, params, view, tree, state, instructions)[0]
        )

    def advise(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> tuple[Float32[Array, "B N"], Float32[Array, "B N D P"]]:
        """The low level's advice in B environments: its value of each feasible edge and the best path on to a leaf.

        Zeros, and what all paths have in common, where the configuration gives advice no weight.

        Every path from the current node to a leaf is a sequence of sub-tasks, which the low level's critic values
        much better than a tree. Most tasks have few paths, so all that exist are valued side by side.

        Returns:
            Values of edges ``[B, N]``, without gradient, and what lies ahead on each edge's best path,
            ``[B, N, D, P]``.
        """
        if not self.network.advice:
            return jnp.zeros(tree.parent.shape, jnp.float32), instructions.ahead
        edge, known, paths = jax.vmap(self._paths, in_axes=(None, 0, 0, 0))(low, tree, state, instructions)
        num_paths = known.shape[1]

        def value(inputs: tuple[Int32[Array, " G"], Instruction]) -> Float32[Array, " G"]:
            env, path = inputs
            seen = take(view, env)
            return jax.vmap(low.control, in_axes=(None, 0, 0))(params, seen, path)[1]

        env = jnp.repeat(jnp.arange(known.shape[0], dtype=jnp.int32), num_paths)
        flat_paths = jax.tree.map(lambda x: x.reshape((known.size, *x.shape[2:])), paths)
        group = max(known.shape[0], 16)  # of fewer rows a matrix product costs nearly as much
        values = in_groups(value, known.reshape(-1), (env, flat_paths), jnp.zeros(env.shape, jnp.float32), group)
        advice, ahead = jax.vmap(_best_paths)(edge, known, values.reshape(known.shape), paths.ahead, instructions.ahead)
        return jax.lax.stop_gradient(advice), ahead

    def loss(
        self, low: LowLevel, params: Any, batch: HighBatch, progress: Float32[Array, ""]
    ) -> tuple[Float32[Array, ""], Metrics]:
        """PPO and TransE loss on a minibatch ``[B]`` (eqs. 4 and 5)."""
        decision = batch.decision
        logits, value = self._plan(low, params, batch.view, batch.tree, batch.state, decision.advice)
        choices = Categorical(logits.shape[-1])
        # Where only one edge is open there is nothing to learn, and the mean of the advantages is another one.
        free = batch.credit.learns & ((logits > MASKED / 2).sum(-1) > 1)
        loss, metrics = ppo.loss(
            jax.vmap(choices.log_prob)(logits, decision.edge),
            decision.log_prob,
            value,
            jax.vmap(choices.entropy)(logits),
            dataclasses.replace(batch.credit, learns=free),
            self.ppo,
            progress,
        )
        if self.transe:
            metrics["transe_loss"] = self.transe_loss(self.planner(low), params, batch)
            loss = loss + self.transe * metrics["transe_loss"]
        return loss, metrics

    def transe_loss(self, planner: Planner, params: Any, batch: HighBatch) -> Float32[Array, ""]:
        """Predicted latents near the ones reached, other states' latents at least the margin away (eq. 4)."""

        def encode(view: View) -> Float32[Array, "B latent"]:
            return jax.vmap(lambda v: cast(Array, planner.apply(params, v, method="encode")))(view)

        here, there = encode(batch.view), encode(batch.next_view)
        predict = jax.vmap(lambda h, r: cast(Array, planner.apply(params, h, r, method="predict")))
        error = _distance(predict(here, batch.reached), there)
        other = _distance(here, jnp.roll(here, 1, axis=0))
        valid = batch.credit.valid
        margin = jnp.maximum(0.0, self.transe_margin - other)
        both = valid & jnp.roll(valid, 1)
        return ppo.masked_mean(error, valid & batch.completed) + ppo.masked_mean(margin, both)

    def _plan(
        self, low: LowLevel, params: Any, view: View, tree: TaskTree, state: TaskState, advice: Float32[Array, "B N"]
    ) -> tuple[Float32[Array, "B N"], Float32[Array, " B"]]:
        """The planner's logits and values, with its own parameters."""
        plan = jax.vmap(self.planner(low).apply, in_axes=(None, 0, 0, 0, 0))
        return cast("tuple[Array, Array]", plan(params, view, tree, state, advice))

    def _paths(
        self, low: LowLevel, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> tuple[Int32[Array, " L"], Bool[Array, " L"], Instruction]:
        """The paths open in one environment: first edges ``[L]``, which of them exist ``[L]``, and instructions."""
        num_nodes = tree.num_nodes
        path = routes(tree, state.node, 1 + instructions.ahead.shape[1])
        leads = tree.accepting & (path[:, 0] >= 0) & open_edges(tree, state)[path[:, 0]]
        leaf = jnp.nonzero(leads, size=min(self.advised, num_nodes), fill_value=num_nodes)[0]
        path = path[jnp.minimum(leaf, num_nodes - 1)]
        edge, later = path[:, 0], path[:, 1:]
        ahead = tree.reach[later] & (later >= 0)[..., None] & (low.sees == "future")
        some = dataclasses.replace(take(instructions, edge), ahead=ahead.astype(jnp.float32))
        return edge, leaf < num_nodes, some


def _best_paths(
    edge: Int32[Array, " L"],
    known: Bool[Array, " L"],
    values: Float32[Array, " L"],
    path_ahead: Float32[Array, "L D P"],
    default_ahead: Float32[Array, "N D P"],
) -> tuple[Float32[Array, " N"], Float32[Array, "N D P"]]:
    """From values of paths ``[L]`` to each edge's best value ``[N]`` and what lies ahead on its best path."""
    mine = (edge == jnp.arange(default_ahead.shape[0], dtype=jnp.int32)[:, None]) & known
    score = jnp.where(mine, values, -jnp.inf)
    worst = jnp.where(known.any(), jnp.where(known, values, jnp.inf).min(), 0.0)
    advice = jnp.where(mine.any(1), score.max(1), worst)
    return advice, jnp.where(mine.any(1)[:, None, None], path_ahead[score.argmax(1)], default_ahead)


def _distance(x: Float32[Array, "B latent"], y: Float32[Array, "B latent"]) -> Float32[Array, " B"]:
    """Euclidean distance over the last axis, with a finite gradient at zero."""
    return jnp.sqrt(((x - y) ** 2).sum(-1) + 1e-8)


@dataclasses.dataclass(frozen=True)
class Ours(Method):
    """The paper's method."""

    high: ImplicitPlanner = ImplicitPlanner()

    name: ClassVar[str] = "ours"
    about: ClassVar[str] = "an implicit planner chooses sub-tasks with the later ones in mind"


OURS = Ours()
