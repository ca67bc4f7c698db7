"""The training curriculum: its levels, the promotion between them and their tasks (paper, "Training Curriculum").

Axes: **L** levels, **M** tasks per level, **S** tasks drawn, **J** sets of propositions that hold together.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float32, Int, Int32, UInt32

from envs_jax.arrays import Array
from hrlspec.config import CurriculumConfig
from hrlspec.spec import TaskTree
from hrlspec.tasks.sampling import sample_sequences, sample_trees


@struct.dataclass
class Curriculum:
    """Progress through the levels; carried in the training state, so a promotion never recompiles.

    Attributes:
        level: int32 ``[]``, the current level, 0-based: tasks of ``level + 1`` sub-tasks.
        finished: int32 ``[]``, episodes of the current level that ended in the current window.
        succeeded: int32 ``[]``, those that satisfied their task.
    """

    level: Int32[Array, ""]
    finished: Int32[Array, ""]
    succeeded: Int32[Array, ""]


def initial() -> Curriculum:
    """The first level and an empty window."""
    return Curriculum(level=jnp.int32(0), finished=jnp.int32(0), succeeded=jnp.int32(0))


def update(
    curriculum: Curriculum, finished: Int[Array, ""], succeeded: Int[Array, ""], config: CurriculumConfig
) -> Curriculum:
    """Counts finished episodes of the current level; after a full window, promotes or starts a new window."""
    finished, succeeded = curriculum.finished + finished, curriculum.succeeded + succeeded
    verdict = finished >= config.window
    passed = verdict & (succeeded >= jnp.float32(config.promotion) * finished)
    return Curriculum(
        level=jnp.minimum(curriculum.level + passed, config.levels - 1).astype(jnp.int32),
        finished=jnp.where(verdict, 0, finished),
        succeeded=jnp.where(verdict, 0, succeeded),
    )


def draw_levels(chance: Float32[Array, "2 S"], level: Int32[Array, ""], earlier: float) -> Int32[Array, " S"]:
    """Levels of the next tasks: the current one, or with probability ``earlier`` one already passed.

    Args:
        chance: float32 ``[2, S]``, uniform in [0, 1).
        level: int32 ``[]``, the current one, 0-based.
        earlier: a probability.

    Returns:
        int32 ``[S]``.
    """
    back = (chance[0] < earlier) & (level > 0)
    return jnp.where(back, (chance[1] * level).astype(jnp.int32), level)


def draw_bank(
    rng: np.random.Generator,
    config: CurriculumConfig,
    num_propositions: int,
    reserved: UInt32[np.ndarray, " _"],
    together: Bool[np.ndarray, "J P"] | None = None,
) -> TaskTree:
    """A bank of L·M training tasks, level by level; none of them has a reserved hash.

    Level k holds sequences of k sub-tasks and, for a share ``tree_share``, random trees of depth k. A share ``joint``
    of their edges reaches one of the sets in ``together``, bool ``[J, P]``.
    """
    levels = []
    num_trees = round(config.tree_share * config.tasks_per_level)
    common: dict[str, Any] = {"num_propositions": num_propositions, "max_nodes": config.max_nodes, "reserved": reserved}
    common |= {"max_avoid": config.max_avoid, "joint": config.joint, "together": together}
    for level in range(1, config.levels + 1):
        parts = []
        if num_trees < config.tasks_per_level:
            parts.append(sample_sequences(rng, level=level, num_tasks=config.tasks_per_level - num_trees, **common))
        if num_trees:
            parts.append(
                sample_trees(
                    rng,
                    num_tasks=num_trees,
                    min_depth=level,
                    max_depth=level,
                    max_branching=config.max_branching,
                    **common,
                )
            )
        levels += parts
    bank: TaskTree = jax.tree.map(lambda *x: np.concatenate(x), *levels)
    return _with_stays(rng, config, bank) if config.stay else bank


def _with_stays(rng: np.random.Generator, config: CurriculumConfig, bank: TaskTree) -> TaskTree:
    """The same tasks, a share ``stay`` of which ends with staying where they are completed.

    First p₊ must hold for ``hold_before_jump`` steps in a row, with as many tries as it takes; then for a random number
    of steps more, and whoever leaves has failed.
    """
    tree: TaskTree = jax.tree.map(np.array, bank)
    hold = np.ones(tree.parent.shape, np.int32)
    fits = tree.valid.sum(-1) + tree.accepting.sum(-1) <= tree.num_nodes
    for row in np.flatnonzero(fits & (rng.random(len(fits)) < config.stay)).tolist():
        ends = np.flatnonzero(tree.accepting[row])
        more = tree.valid[row].sum() + np.arange(len(ends))
        tree.parent[row, more], tree.valid[row, more] = ends, True
        tree.depth[row, more] = tree.depth[row, ends] + 1
        tree.reach[row, more], tree.avoid[row, more] = tree.reach[row, ends], ~tree.reach[row, ends]
        tree.accepting[row, ends], tree.accepting[row, more] = False, True
        hold[row, ends], hold[row, more] = config.hold_before_jump, rng.integers(2, config.longest_stay + 1)
    return dataclasses.replace(tree, hold=hold)  # type: ignore[arg-type]
