"""Banks of training tasks, drawn anew as training goes on.

Axes: **L** levels, **M** tasks per level, **J** sets of propositions that hold together.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Key, UInt32

from envs_jax import Environment
from envs_jax.arrays import Array
from hrlspec.config import CurriculumConfig
from hrlspec.spec import TaskTree
from hrlspec.tasks.curriculum import draw_bank

ITERATIONS_PER_BANK = 16
"""Iterations after which a new bank is drawn."""


class TaskBanks:
    """The banks of a run. A bank depends on the seed and its number alone, so that a resumed run draws the same ones.

    Args:
        seed: 0 or more.
        config: of the curriculum.
        num_propositions: P.
        reserved: uint32, hashes of held-out tasks, which are never drawn.
        given: tasks that are collected on, at all levels alike, instead of random ones; leading axis M.
        together: bool ``[J, P]``, sets of propositions that goals may be, see `joint_labels`.

    Raises:
        ValueError: no such task can be drawn.
    """

    def __init__(
        self,
        seed: int,
        config: CurriculumConfig,
        num_propositions: int,
        reserved: UInt32[np.ndarray, " _"],
        given: TaskTree | None = None,
        together: Bool[np.ndarray, "J P"] | None = None,
    ) -> None:
        self._seed, self._config, self._num_propositions = seed, config, num_propositions
        self._reserved, self._given, self._together = reserved, given, together
        self._latest = 0, self._draw(0)

    def at(self, iteration: int) -> TaskTree:
        """The bank of an iteration, on the device: L·M tasks, level by level."""
        number = iteration // ITERATIONS_PER_BANK
        if self._latest[0] != number:
            self._latest = number, self._draw(number)
        return self._latest[1]

    def _draw(self, number: int) -> TaskTree:
        if self._given is not None:
            rows = np.arange(self._config.levels * self._config.tasks_per_level) % len(self._given.parent)
            given: TaskTree = jax.tree.map(lambda x: jnp.asarray(x[rows]), self._given)
            return given
        rng = np.random.default_rng([self._seed, number])
        drawn = draw_bank(rng, self._config, self._num_propositions, self._reserved, self._together)
        bank: TaskTree = jax.tree.map(jnp.asarray, drawn)
        return bank


def joint_labels(env: Environment, config: CurriculumConfig) -> Bool[np.ndarray, "J P"] | None:
    """The sets of two propositions or more that can hold together in a world; ``None`` if no goal is to be one."""
    if not config.joint:
        return None
    sets = [[name in label for name in env.propositions] for label in env.possible_labels if len(label) > 1]
    return np.array(sets, bool).reshape(-1, env.num_propositions)


def seed_of(key: Key[Array, ""]) -> int:
    """The seed of a key, ``seed_of(jax.random.key(7)) == 7``; of a derived key, its words as one integer."""
    return int.from_bytes(np.asarray(jax.random.key_data(key)).astype(">u4").tobytes(), "big")
