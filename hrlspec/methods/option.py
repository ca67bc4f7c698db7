"""The baseline Option: value iteration over measured durations of options (Araki et al., 2021).

An option reaches one sub-goal and knows nothing of what comes after it. What it takes to reach one sub-goal from
another is measured while collecting, and what each sub-goal earns, whatever came before it ("estimated empirically for
each individual subgoal separately"; paper, "Baseline-2"). A sequence is chosen by dynamic programming over the task
tree with that.

Axes: **O** origins, the P propositions reached before and, last, the start of an episode; **P** goals; **N** nodes;
**B** environments of a batch; **T** time steps; **E** environments.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32, Key

from envs_jax.arrays import Array
from hrlspec.agent.distributions import MASKED
from hrlspec.agent.experience import Experience, Step, View
from hrlspec.agent.high_level import Choice, HighLevel, Rewards
from hrlspec.agent.low_level import LowLevel, Params, TaskBook
from hrlspec.agent.method import Method
from hrlspec.agent.networks.controller import Instruction, Sees
from hrlspec.config import Checked, Config, evolve, setting
from hrlspec.spec import TaskState, TaskTree, open_edges

_LEAST = 1e-9


@struct.dataclass
class Measurements:
    """Sums over attempts to reach a goal, with exponential decay.

    Attributes:
        attempts: float32 ``[O, P]``.
        discounted: float32 ``[O, P]``, of γ^duration, and 0 where the goal was not reached.
        successes: float32 ``[2, P]``, by whether the sub-task was the last of its task.
        rewards: float32 ``[2, P]``, of what they earned.
    """

    attempts: Float32[Array, "O P"]
    discounted: Float32[Array, "O P"]
    successes: Float32[Array, "2 P"]
    rewards: Float32[Array, "2 P"]


def unmeasured(num_propositions: int) -> Measurements:
    """One imagined attempt for each, which succeeded at once and earned nothing, so that all are tried."""
    ones = jnp.ones((num_propositions + 1, num_propositions), jnp.float32)
    both = jnp.ones((2, num_propositions), jnp.float32)
    return Measurements(attempts=ones, discounted=ones, successes=both, rewards=0 * both)


def sums(
    origin: Bool[Array, "T E O"],
    goal: Bool[Array, "T E P"],
    ended: Bool[Array, "T E"],
    reached: Bool[Array, "T E"],
    last: Bool[Array, "T E"],
    duration: Int[Array, "T E"],
    reward: Float32[Array, "T E"],
    *,
    discount: float,
) -> Measurements:
    """The attempts that ended in a rollout; leading axes of all arrays ``[T, E]``.

    Args:
        origin: bool ``[..., O]``, where each step's sub-task began.
        goal: bool ``[..., P]``, what it was to reach.
        ended: bool, the attempt ended with this step.
        reached: bool, successfully.
        last: bool, and the task was satisfied by it.
        duration: int32, steps since the sub-task was assigned, this one included.
        reward: float32, of this step.
        discount: γ.
    """
    origin, goal = origin.astype(jnp.float32), goal.astype(jnp.float32)
    success = ended & reached
    kinds = jnp.stack([success & ~last, success & last]).astype(jnp.float32)

    def pairs(weight: Float32[Array, "T E"]) -> Float32[Array, "O P"]:
        return jnp.einsum("te,teo,teg->og", weight, origin, goal)

    def goals(weight: Float32[Array, "2 T E"]) -> Float32[Array, "2 P"]:
        return jnp.einsum("kte,teg->kg", weight, goal)

    return Measurements(
        attempts=pairs(ended.astype(jnp.float32)),
        discounted=pairs(success * discount ** duration.astype(jnp.float32)),
        successes=goals(kinds),
        rewards=goals(kinds * reward),
    )


def origins(tree: TaskTree) -> Bool[Array, "N O"]:
    """Where a sub-task out of each node begins, bool ``[N, O]``: at what the node reached, or at the start."""
    start = jnp.arange(tree.num_nodes, dtype=jnp.int32) == TaskTree.ROOT
    return jnp.concatenate([tree.reach, start[:, None]], -1)


def values(known: Measurements, tree: TaskTree, state: TaskState) -> Float32[Array, " N"]:
    """Logic value iteration: the discounted reward expected of each open edge and the best way on, float32 ``[N]``.

    ``Q(q, e) = D_e (R_e + max_e' Q(q', e'))`` with the measured E[γ^duration] D_e and reward R_e; -inf on other nodes.
    A conjunction takes as long as the longest of its goals.
    """
    # Goals never attempted keep the prior, also when its weight has decayed to zero.
    per_attempt = (known.discounted + _LEAST) / (known.attempts + _LEAST)
    per_success = known.rewards / (known.successes + _LEAST)
    origin = origins(tree)[tree.parent].astype(jnp.float32)
    origin = origin / jnp.maximum(origin.sum(-1, keepdims=True), 1.0)
    reach = jnp.where(tree.reach, origin @ per_attempt, jnp.inf).min(-1)
    reward = jnp.where(tree.reach, per_success[:, None], -jnp.inf).max(-1)
    reward = jnp.where(tree.accepting, reward[1], reward[0])

    def visit(best: Float32[Array, " N"], node: Int32[Array, ""]) -> tuple[Float32[Array, " N"], Float32[Array, ""]]:
        ahead = jnp.where(tree.accepting[node], 0.0, best[node])
        value = jnp.where(tree.edges[node], reach[node] * (reward[node] + ahead), -jnp.inf)
        return best.at[tree.parent[node]].max(value), value

    # Children come after their parents, so the last node is visited first.
    value = jax.lax.scan(
        visit,
        jnp.full(tree.num_nodes, -jnp.inf, jnp.float32),
        jnp.arange(tree.num_nodes, dtype=jnp.int32),
        reverse=True,
    )[1]
    return jnp.where(open_edges(tree, state), value, -jnp.inf)


@dataclasses.dataclass(frozen=True)
class LogicValueIteration(Checked, HighLevel):
    """Chooses options by value iteration over the task tree, with what each was measured to take and to earn."""

    sharpness: float = setting(100.0, least=0, most=1e6)
    """Logits per unit of value, the inverse temperature of the choice among options."""
    decay: float = setting(0.98, least=0, most=1)
    """Decay of a measurement's weight per iteration: options change while they are learned."""

    def init(self, key: Key[Array, ""], low: LowLevel, view: View, tree: TaskTree) -> Measurements:
        """See :class:`HighLevel`."""
        del key, low, view
        return unmeasured(tree.num_propositions)

    def choose(
        self, low: LowLevel, params: Params, view: View, tree: TaskTree, state: TaskState, instructions: Instruction
    ) -> Choice:
        """See :class:`HighLevel`; V^h is the low level's value of the best option."""
        feasible = jax.vmap(open_edges)(tree, state)
        value = jax.vmap(values, in_axes=(None, 0, 0))(params["high"], tree, state)
        best = jnp.where(feasible.any(-1), value.max(-1), 0.0)
        logits = jnp.where(feasible, self.sharpness * (value - best[:, None]), MASKED)
        value = low.value_of(params, view, instructions, logits.argmax(-1).astype(jnp.int32), feasible)
        nothing = jnp.zeros(logits.shape, jnp.float32)
        return Choice(logits, value, nothing, instructions.ahead, jnp.zeros(logits.shape, jnp.int32))

    def low_level_rewards(self, experience: Experience) -> Rewards:
        """Each option is over when its sub-task is, and earns 1 if it reached its goal, whatever the task pays."""
        x = experience
        reached = x.outcome.edge_taken & (x.reached == x.goal).all(-1)
        next_decided = jnp.roll(x.high.made, -1, 1).at[:, -1].set(False)
        over = x.outcome.edge_taken | x.outcome.terminated | next_decided
        return Rewards(reached.astype(jnp.float32), over, x.outcome.truncated)

    def measure(self, book: TaskBook, steps: Step, config: Config) -> Measurements:
        """What the options of a rollout took and earned."""
        outcome, edge = steps.outcome, steps.high.edge
        following = jnp.roll(steps.high.made, -1, 0).at[-1].set(False)
        return sums(
            jax.vmap(origins)(book.tree)[steps.task, steps.state.node],
            book.tree.reach[steps.task, edge],
            outcome.edge_taken | outcome.terminated | outcome.truncated | following,
            outcome.edge_taken & (outcome.node == edge),
            outcome.satisfied,
            steps.since + 1,
            outcome.reward,
            discount=config.discount,
        )

    def observe(self, params: Measurements, measured: Measurements) -> Measurements:
        """Adds it to what was measured before, whose weight decays."""
        return jax.tree.map(lambda known, new: self.decay * known + new, params, measured)


@dataclasses.dataclass(frozen=True)
class Option(Method):
    """Options know their own sub-goal, and value iteration over what they take chooses them; the shield stays."""

    high: LogicValueIteration = LogicValueIteration()

    name: ClassVar[str] = "option"
    about: ClassVar[str] = "value iteration chooses options that know nothing of each other"
    sees: ClassVar[Sees] = "sub-task"

    def configure(self, config: Config) -> Config:
        """Nothing of other sub-tasks, before or after."""
        return evolve(
            config, {"network.lookahead": 0, "network.names": False, "network.memory": 0, "curriculum.stay": 0.0}
        )


OPTION = Option()
