"""Ours: the paper's implicit planner (paper, "High-level Module" and "Training").

Axes: **B** environments or decisions of a batch, **N** tree nodes, **L** paths to a leaf, **D** later sub-tasks,
**P** atomic propositions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
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
from hrlspec.methods.paths import Paths, best_of_edges, open_paths, sequence
from hrlspec.spec import TaskState, TaskTree, initial, open_edges

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
    """Paths to a leaf that are valued side by side; edges without one count as the worst of these."""
    values_paths: bool = False
    """Whether V^h is asked about every path to a leaf, all other edges being blocked, and the choice follows these
    values. Off: it is asked about the tree, and a policy of its own chooses, as in the paper."""
    inverse_temperature: float = setting(400.0, least=0, most=1e6)
    """Weight of these values in the logits."""
    tells_path: bool = False
    """Where paths are valued: whether the low level is told the best path through the edge that it is given, instead of
    the tree that remains."""

    @property
    def follows_plan(self) -> bool:
        """The plan is the path that V^h values most, or, with the low level's advice, that it values most itself."""
        return self.tells_path if self.values_paths else self.network.advice > 0

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
        if self.values_paths:
            return self.planner(low).init(key, view, tree, method="worth_of_view")
        return self.planner(low).init(key, view, tree, initial(tree), jnp.zeros(tree.num_nodes, jnp.float32))

    def choose(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> Choice:
        """See :class:`HighLevel`."""
        if self.values_paths:
            return self._choose_path(low, params, view, tree, state, instructions)
        advice, ahead = self.advise(low, params, view, tree, state, instructions)
        logits, value = self._plan(low, params["high"], view, tree, state, advice)
        return Choice(logits, value, advice, ahead, jnp.zeros(logits.shape, jnp.int32))

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
        nothing = jnp.zeros(state.node.shape, jnp.float32)
        advice = jnp.zeros(tree.parent.shape, jnp.float32)
        if not self.values_paths:
            advice, _ = self.advise(low, params, view, tree, state, instructions)
        return Judgement(nothing, advice, nothing.astype(jnp.int32))

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
        length = 1 + instructions.ahead.shape[2]
        paths = jax.vmap(lambda tree, state: open_paths(tree, state, self.advised, length))(tree, state)
        each = jax.vmap(self._instructions, in_axes=(None, 0, 0, 0))(low, tree, paths, instructions)

        def value(inputs: tuple[Int32[Array, " G"], Instruction]) -> Float32[Array, " G"]:
            env, path = inputs
            return jax.vmap(low.control, in_axes=(None, 0, 0))(params, take(view, env), path)[1]

        values = self._value_of_paths(value, paths.known, each)
        advice, row, has_one = jax.vmap(best_of_edges, in_axes=(0, 0, None))(paths, values, tree.parent.shape[1])
        return jax.lax.stop_gradient(advice), _ahead_on(each.ahead, row, has_one, instructions)

    def loss(
        self, low: LowLevel, params: Any, batch: HighBatch, progress: Float32[Array, ""]
    ) -> tuple[Float32[Array, ""], Metrics]:
        """PPO and TransE loss on a minibatch ``[B]`` (eqs. 4 and 5)."""
        if self.values_paths:
            return self._loss_of_paths(low, params, batch)
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
        return self._with_transe(low, params, batch, loss, metrics)

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

    def _with_transe(
        self, low: LowLevel, params: Any, batch: HighBatch, loss: Float32[Array, ""], metrics: Metrics
    ) -> tuple[Float32[Array, ""], Metrics]:
        """A loss and its parts, the TransE loss added where it has a weight."""
        if not self.transe:
            return loss, metrics
        error = self.transe_loss(self.planner(low), params, batch)
        return loss + self.transe * error, {**metrics, "transe_loss": error}

    def _instructions(self, low: LowLevel, tree: TaskTree, paths: Paths, instructions: Instruction) -> Instruction:
        """The instructions for the first sub-tasks of one environment's paths, ``[L]``."""
        later = paths.nodes[:, 1 : 1 + instructions.ahead.shape[1]]
        ahead = tree.reach[later] & (later >= 0)[..., None] & (low.sees == "future")
        return dataclasses.replace(take(instructions, paths.edge), ahead=ahead.astype(jnp.float32))

    def _value_of_paths(
        self,
        value: Callable[[tuple[Int32[Array, " G"], Any]], Float32[Array, " G"]],
        known: Bool[Array, "B L"],
        inputs: Any,
    ) -> Float32[Array, "B L"]:
        """``value`` of (environment, inputs) where there is a path, many at a time; zeros elsewhere."""
        num_envs, num_paths = known.shape
        env = jnp.repeat(jnp.arange(num_envs, dtype=jnp.int32), num_paths)
        inputs = jax.tree.map(lambda x: x.reshape((known.size, *x.shape[2:])), inputs)
        group = max(num_envs, 16)  # of fewer rows a matrix product costs nearly as much
        nothing = jnp.zeros(env.shape, jnp.float32)
        return in_groups(value, known.reshape(-1), (env, inputs), nothing, group).reshape(known.shape)

    def _choose_path(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> Choice:
        """Edges by V^h of the best path through each, all edges beside the path being blocked."""
        planner, own, num_nodes = self.planner(low), params["high"], tree.parent.shape[1]
        length = max(self._length(num_nodes), 1 + instructions.ahead.shape[2])
        paths = jax.vmap(lambda tree, state: open_paths(tree, state, self.advised, length))(tree, state)
        each = jax.vmap(jax.vmap(sequence, in_axes=(None, None, 0)))(tree, state.node, paths.nodes)
        latent = jax.vmap(lambda view: planner.apply(own, view, method="encode"))(view)

        def value(inputs: tuple[Int32[Array, " G"], TaskTree]) -> Float32[Array, " G"]:
            env, path = inputs
            worth = jax.vmap(lambda latent, path: planner.apply(own, latent, path, method="worth"))
            return cast(Array, worth(take(latent, env), path))

        values = self._value_of_paths(value, paths.known, each)
        of_edges, row, has_one = jax.vmap(best_of_edges, in_axes=(0, 0, None))(paths, values, num_nodes)
        feasible = jax.vmap(open_edges)(tree, state)
        best = jnp.where(feasible.any(1), jnp.where(feasible, of_edges, -jnp.inf).max(1), 0.0)
        logits = jnp.where(feasible, self.inverse_temperature * (of_edges - best[:, None]), MASKED)
        leaf, ahead = jnp.take_along_axis(paths.leaf, row, 1), instructions.ahead
        if self.tells_path:
            told = jax.vmap(self._instructions, in_axes=(None, 0, 0, 0))(low, tree, paths, instructions).ahead
            ahead = _ahead_on(told, row, has_one, instructions)
        return Choice(logits, best, jnp.zeros_like(of_edges), ahead, leaf)

    def _loss_of_paths(self, low: LowLevel, params: Any, batch: HighBatch) -> tuple[Float32[Array, ""], Metrics]:
        """The error of V^h of the paths that were meant to be taken, and the TransE loss."""
        planner, num_nodes = self.planner(low), batch.tree.parent.shape[1]

        def worth(view: View, tree: TaskTree, node: Int32[Array, ""], leaf: Int32[Array, ""]) -> Float32[Array, ""]:
            path = sequence(tree, node, routes(tree, node, self._length(num_nodes))[leaf])
            return cast(Array, planner.apply(params, view, path, method="worth_of_view"))

        value = jax.vmap(worth)(batch.view, batch.tree, batch.state.node, batch.decision.leaf)
        error = ppo.value_loss(value, batch.credit.target, batch.credit.valid)
        return self._with_transe(low, params, batch, self.ppo.value_coefficient * error, {"value_loss": error})

    def _length(self, num_nodes: int) -> int:
        """Sub-tasks of a path that are seen: as many as there are rounds of message passing, if these have a limit."""
        return min(self.network.rounds or num_nodes, num_nodes - 1)


def _ahead_on(
    ahead: Float32[Array, "B L D P"],
    row: Int32[Array, "B N"],
    has_one: Bool[Array, "B N"],
    instructions: Instruction,
) -> Float32[Array, "B N D P"]:
    """What lies ahead on the best path through each edge, which is in the given row if it has one."""
    best = jax.vmap(lambda ahead, row: ahead[row])(ahead, row)
    return jnp.where(has_one[..., None, None], best, instructions.ahead)


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
