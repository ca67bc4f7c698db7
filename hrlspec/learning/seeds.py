"""Several seeds of one experiment as one program: whole training states, with a leading axis.

A device computes its seeds either at once, vmapped, or one after another. At once every seed waits in each loop for the
one that goes round it most often, and both sides of each condition are computed; one after another costs a CPU less.

Axes: **S** seeds, **D** devices, of which each has S/D seeds.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jaxtyping import UInt32

from envs_jax.arrays import Array
from hrlspec.learning.optimiser import Metrics
from hrlspec.learning.shards import SPREAD, WHOLE, Shards
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.spec import TaskTree
from hrlspec.tasks.rewards import RewardMachine


@dataclasses.dataclass(frozen=True)
class Seeds:
    """S training states on D devices. Static.

    Attributes:
        trainer: of each, on one device.
        number: S.
        devices: D, a divisor of S.
        at_once: whether a device computes its seeds at once instead of one after another; by default if it is no CPU.

    Raises:
        ConfigError: the devices do not share the seeds evenly, or there are not as many.
    """

    trainer: Trainer
    number: int
    devices: int = 1
    at_once: bool = dataclasses.field(default_factory=lambda: jax.default_backend() != "cpu")

    def __post_init__(self) -> None:
        self.shards  # noqa: B018  refuses what does not go together

    @functools.cached_property
    def shards(self) -> Shards:
        """How the seeds lie on the devices: as blocks of one seed each."""
        return Shards(self.number, self.number, self.devices)

    def join(self, states: Sequence[TrainState]) -> TrainState:
        """S states as one, leading axis S, each where it is computed; by way of the host, which compiles nothing."""

        def joined(*leaves: Array) -> Array:
            if _is_key(leaves[0]):
                words = joined(*map(jax.random.key_data, leaves))
                return jax.random.wrap_key_data(words, impl=jax.random.key_impl(leaves[0]))
            together = np.stack(leaves)
            # Programs give arrays without elements back as a whole.
            place = NamedSharding(self.shards.mesh, SPREAD if together.size else WHOLE)
            # Copies, since they are donated.
            return jax.make_array_from_callback(together.shape, place, lambda share: jnp.array(together[share]))

        state: TrainState = jax.tree.map(joined, *states)
        return state

    def split(self, states: TrainState) -> list[TrainState]:
        """The S states that were joined, to the bit, on any device."""

        def parted(leaf: Array) -> list[Array]:
            if _is_key(leaf):
                impl = jax.random.key_impl(leaf)
                return [jax.random.wrap_key_data(words, impl=impl) for words in parted(jax.random.key_data(leaf))]
            return [jnp.array(one) for one in jax.device_get(leaf)]

        leaves, structure = jax.tree.flatten(states)
        each = zip(*map(parted, leaves), strict=True)
        return [jax.tree.unflatten(structure, one) for one in each]

    @functools.partial(jax.jit, static_argnums=0, donate_argnums=1)
    def iterate(
        self, states: TrainState, banks: TaskTree, machine: RewardMachine, reserved: UInt32[Array, "S M"]
    ) -> tuple[TrainState, Metrics]:
        """`Trainer.iterate` for S seeds. ``states`` are donated.

        Args:
            states: where the runs stand, leading axis S.
            banks: training tasks of each, leading axes S and L·M.
            machine: the rewards.
            reserved: uint32, hashes of each seed's held-out tasks.

        Returns:
            The next states and metrics, leading axis S.
        """
        places = SPREAD, SPREAD, WHOLE, SPREAD
        on_each = self.shards.on_each(self._iterate, places, (SPREAD, SPREAD))
        new, metrics = on_each(states, banks, machine, reserved)
        return self.shards.placed(new, jax.tree.map(lambda _: SPREAD, new)), metrics

    def _iterate(
        self, states: TrainState, banks: TaskTree, machine: RewardMachine, reserved: UInt32[Array, "S_of_device M"]
    ) -> tuple[TrainState, Metrics]:
        """The iteration on one device, with its share of the seeds."""

        def one(seed: tuple[TrainState, TaskTree, Array]) -> tuple[TrainState, Metrics]:
            state, bank, held_out = seed
            return self.trainer.iterate(state, bank, machine, held_out)

        seeds = states, banks, reserved
        result: tuple[TrainState, Metrics] = jax.vmap(one)(seeds) if self.at_once else jax.lax.map(one, seeds)
        return result


def _is_key(leaf: Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
