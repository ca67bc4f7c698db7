"""Everything a run can be told, as frozen dataclasses; the tuned values live in ``hrlspec/presets``.

All fields are static: they shape the compiled program. What may change inside a run (parameters, counters,
curriculum level) lives in :class:`hrlspec.learning.train.TrainState`.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks (paper, "High-level Architecture" and "Low-level Architecture")."""

    latent: int = 64
    """Width of both encoders' output."""
    conv_channels: tuple[int, ...] = (16, 32, 64)
    """Channels of the 2x2 convolutions for image observations; none: images are encoded as vectors."""
    encoder_mlp: tuple[int, ...] = (128, 128)
    """Hidden units of the encoder for vectors."""
    planner_features: int = 64
    """F, node features of the planner's GNN."""
    planner_hidden: int = 128
    """Hidden units of the planner's transition model and critic."""
    planner_policy: tuple[int, ...] = (128, 128, 128)
    """Hidden units of the planner's policy, which is applied to every edge."""
    planner_rounds: int = 8
    """Rounds of message passing of the planner, each normalised; look-ahead ends at this depth. 0: one sweep from the
    leaves to the root, which looks ahead without limit and costs an eighth."""
    task_features: int = 32
    """Node features of the low level's GNN over the remaining tasks."""
    task_rounds: int = 8
    """Rounds of message passing of the low level's GNN; 0 as for ``planner_rounds``."""
    actor: tuple[int, ...] = (64, 64, 64)
    critic: tuple[int, ...] = (64, 64)
    reach_critic: tuple[int, ...] = (64, 64)
    """Hidden units of the critic behind the shield."""
    roles: bool = False
    """Task-conditioned encoding: the low level sees the observation by role (the goal p₊, the forbidden p₋, what comes
    1, 2, ... sub-tasks later) instead of by name. Off encodes the observation without the task, as in the paper."""
    names: bool = False
    """Whether the low level sees the observation by role and by name: where rewards depend on propositions that have no
    role in the task."""
    symmetric: bool = False
    """Whether the low level sees the world in one of its turned or reflected forms alone: its goal in one sector, or,
    where vectors are reflected, its own motion forward; in environments that say how, seen by role. What is
    learned in one direction is then known in all."""
    task_scale: float = 4.0
    """What the low level is told of its sub-task is multiplied by this: a flag beside a hundred features of the latent
    is hardly heard at first. The embedding of what comes after it is not: as loud, it would drown the sub-task. With
    ``whole_task`` there is no sub-task, and the embedding is multiplied."""
    lookahead: int = 2
    """How many later sub-tasks have a role of their own."""
    memory: int = 0
    """How many of the sub-tasks completed last the low level remembers: where a reward depends on their order, what the
    rest of the task is worth depends on them."""
    whole_task: bool = False
    """Whether the low level is told the whole remaining task, with what each edge forbids, instead of a sub-task: one
    flat policy and no planner (the baseline LTL2Action). Then ``task_rounds`` and ``memory`` are 0, and roles and
    advice are off."""
    child_embeddings: bool = False
    """Whether the planner's logit of an edge also sees the embedding of the node it leads to."""
    advice: float = 0.0
    """Weight of the low level's value of each candidate sub-task in the planner's logits (gradient stopped); the
    planner learns a correction to it. 0: the planner judges alone, as in the paper."""
    advised: int = 12
    """Ways to a leaf that are valued for the advice; edges without one count as the worst of these."""


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation at one level."""

    learning_rate: float = 1e-3
    final_learning_rate: float = 0.0
    epochs: int = 2
    minibatches: int = 16
    clip: float = 0.2
    most_ratio: float = math.exp(10.0)
    """Largest probability ratio that counts where the advantage is negative; 1.0 + ``clip`` or more."""
    entropy: float = 0.002
    final_entropy: float = 0.002
    entropy_floor: float = 0.0
    """Mean entropy (nats) that the policy is kept near or above at first: below it the entropy's weight grows by twice
    what is missing. 0: none, as for Gaussians, whose entropy may be negative."""
    final_entropy_floor: float = 0.0
    value_coefficient: float = 0.5
    expectile: float = 0.5
    """What the critic learns of the returns: 0.5 their mean, above it an optimistic expectile, which in deterministic
    worlds approaches the best return within reach."""
    gae_lambda: float = 0.95
    relative: float = 0.0
    """r: the policy's advantages are divided by r + |V|, in units of the critic, so that tasks that pay little are
    learned like tasks that pay much. 0: as they are."""
    max_grad_norm: float = 0.5


@dataclasses.dataclass(frozen=True)
class CurriculumConfig:
    """Tasks to collect on (paper, "Training Curriculum")."""

    levels: int = 4
    """K, the longest sequence."""
    promotion: float = 0.85
    """Success rate that promotes to the next level."""
    window: int = 512
    """Finished episodes of the current level over which it is measured."""
    earlier: float = 0.2
    """Share of episodes on levels already passed."""
    tree_share: float = 0.0
    """Share of random trees, instead of sequences, in each level's tasks."""
    contested: float = 0.0
    """Share of episodes in layouts made to teach look-ahead, where nearest-first loses. Only in environments with a
    ``contested_layout``."""
    max_branching: int = 3
    max_avoid: int = 3
    tasks_per_level: int = 512
    """Rows of the bank for each level; the bank is drawn anew between chunks."""
    max_nodes: int = 16
    """N, the padded size of training tasks."""


@dataclasses.dataclass(frozen=True)
class RelabelConfig:
    """Experience relabelling into random trees (paper, "Experience Replay")."""

    share: float = 0.5
    """Share of the environments whose trajectories are trained on a second time, relabelled. 0 switches it off."""
    planner_policy: bool = True
    """Whether the planner's policy learns from the copies; its value and transition model always do. In a copy the
    branch taken was not chosen by the planner, and always succeeded."""
    corrected: bool = True
    """Whether a copied action counts by how likely the policy makes it under the new task, relative to the probability
    that it was drawn with under the old one; a copied choice of the planner relative to 1, for the path was no choice.
    Off, relative to the new task's own probability before the update."""
    visits: bool = False
    """Whether every proposition visited counts as a completed sub-task, in hindsight, and not only those assigned."""
    branch: float = 0.7
    """Probability of a random branch at each node of the completed path."""


@dataclasses.dataclass(frozen=True)
class ShieldConfig:
    """Proposition avoidance (paper, "Avoiding Propositions")."""

    mode: Literal["off", "state", "action"] = "state"
    """``state`` replaces the action wherever a forbidden proposition is near, as in the paper; ``action`` only where
    the chosen action itself leads to it."""
    threshold: float = 0.9
    """ν: V(s, g) above it counts as near."""
    discount: float = 0.85
    """Discount of the reach critic: its value is discount^(steps to g - 1)."""
    learning_rate: float = 1e-3
    minibatches: int = 8


@dataclasses.dataclass(frozen=True)
class Config:
    """A whole training run, less its environment."""

    num_envs: int = 128
    """E, environments stepped side by side."""
    num_steps: int = 64
    """T, steps of a rollout."""
    total_steps: int = 3_000_000
    discount: float = 0.94
    """γ, per environment step, at both levels."""
    max_operator: bool = True
    """Whether the target at a new sub-task is raised to the planner's value (eq. 6)."""
    future_embedding: bool = True
    """Whether the low level sees what remains after its sub-task; off is the ablation Myopic-low."""
    options: bool = False
    """Whether sub-tasks are options that know nothing of each other, chosen by value iteration over what they were
    measured to take (the baseline Option), instead of by the planner."""
    unfinished: bool = False
    """Whether sub-tasks that were assigned but not completed train the planner."""
    transe: float = 0.01
    """λ, the weight of the TransE loss."""
    transe_margin: float = 1.0
    """ξ, the margin of the TransE loss."""
    noise_correlation: float = 0.0
    """Correlation of the noise of successive steps while collecting, for continuous actions: coloured noise explores
    farther than white noise, whose steps cancel out."""
    final_noise_correlation: float = 0.0
    """What it comes to in the end, linearly. A policy trained with coloured noise to the end leaves it to the noise to
    get it out of where it hesitates, and stands still without."""
    steps_per_slot: int = 5
    """A rollout tells T divided by this many episodes of an environment apart, two at least."""
    planner_share: int = 16
    """The planner trains on at most E·T divided by this many decisions per iteration."""
    group: int = 32
    """Environments the planner decides for at a time."""
    low: PPOConfig = PPOConfig()
    high: PPOConfig = PPOConfig(learning_rate=2e-3, epochs=2, minibatches=8, entropy=0.005, final_entropy=0.005)
    network: NetworkConfig = NetworkConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    relabel: RelabelConfig = RelabelConfig()
    shield: ShieldConfig = ShieldConfig()

    @property
    def plans(self) -> bool:
        """Whether the planner's networks choose the sub-tasks."""
        return not (self.options or self.network.whole_task)

    @property
    def steps_per_iteration(self) -> int:
        """E·T, environment steps of one iteration."""
        return self.num_envs * self.num_steps

    @property
    def episode_slots(self) -> int:
        """Episodes of one environment that a rollout tells apart; what comes after them is left out of the update."""
        return max(2, self.num_steps // self.steps_per_slot)

    @property
    def num_iterations(self) -> int:
        """Iterations that make up ``total_steps``, rounded up."""
        return -(-self.total_steps // self.steps_per_iteration)
