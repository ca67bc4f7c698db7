"""Environments spread over devices, such that what is learned does not depend on how many there are.

Environments are divided into **blocks**, whose number is a setting. A block shuffles, samples and relabels its own
rows; a gradient is the mean over the blocks, added up in their order. A device has one or more blocks, one after the
other in the order of their environments.

Axes: **E** environments, **G** blocks, **D** devices; **L** blocks of one device.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float32, Int32, Shaped

from envs_jax.arrays import Array
from hrlspec.agent.groups import one_by_one
from hrlspec.config import ConfigError

T = TypeVar("T")

_AXIS = "shards"
SPREAD, WHOLE = PartitionSpec(_AXIS), PartitionSpec()
"""How an array lies: its leading axis over the devices, or all of it on each."""


def most_devices(blocks: int, available: int) -> int:
    """How many of the available devices share so many blocks evenly."""
    return max(devices for devices in range(1, min(blocks, available) + 1) if blocks % devices == 0)


def num_devices() -> int:
    """How many devices there are, as many of each process."""
    return jax.process_count() * min(len(jax.local_devices(index)) for index in range(jax.process_count()))


def first_devices(number: int) -> list[jax.Device]:
    """So many devices, the first ones of each process, and as many of each; a single one is this process's own."""
    if number == 1:
        return jax.local_devices()[:1]
    each, processes = number // jax.process_count(), range(jax.process_count())
    return [device for index in processes for device in jax.local_devices(index)[:each]]


@dataclasses.dataclass(frozen=True)
class Shards:
    """E environments in G blocks on D devices. Static.

    Attributes:
        num_envs: E.
        blocks: G.
        devices: D, of all processes together: the first ones that JAX has, as many of each process.

    Raises:
        ConfigError: the devices do not share the blocks evenly, or there are not as many, or not as many of each
            process.
    """

    num_envs: int
    blocks: int = 1
    devices: int = 1

    def __post_init__(self) -> None:
        if self.devices < 1 or self.blocks % self.devices:
            raise ConfigError(f"devices is {self.devices}, expected a divisor of {self.blocks}, the number of blocks")
        if self.devices > num_devices():
            raise ConfigError(f"devices is {self.devices}, but JAX has {num_devices()}")
        if self.devices > 1 and self.devices % jax.process_count():
            raise ConfigError(
                f"devices is {self.devices}, expected a multiple of {jax.process_count()}, the number of processes"
            )

    @functools.cached_property
    def mesh(self) -> Mesh:
        """The devices in a row, process by process."""
        return Mesh(np.array(first_devices(self.devices)), (_AXIS,))

    def placed(self, tree: T, places: T) -> T:
        """Arrays of a traced program, laid over the devices as the partition specs in ``places`` say."""
        if self.devices == 1:
            return tree
        how = jax.tree.map(lambda place: NamedSharding(self.mesh, place), places)
        laid: T = jax.lax.with_sharding_constraint(tree, how)
        return laid

    def on_each(self, function: Callable[..., Any], in_specs: Any, out_specs: Any) -> Callable[..., Any]:
        """A function of what lies on one device, as one of arrays that lie on all of them."""
        if self.devices == 1:
            return function
        spread: Callable[..., Any] = jax.shard_map(
            function, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
        )
        return spread

    # What follows is meant for functions that run on each device.

    def envs(self) -> Int32[Array, " E_of_device"]:
        """Which environments this device has: their places in the order of all."""
        here = self.num_envs // self.devices
        first = 0 if self.devices == 1 else jax.lax.axis_index(_AXIS).astype(jnp.int32) * here
        return first + jnp.arange(here, dtype=jnp.int32)

    def in_blocks(self, x: Shaped[Array, "rows ..."]) -> Shaped[Array, "L rows_of_block ..."]:
        """This device's rows by block."""
        num_blocks = self.blocks // self.devices
        return x.reshape((num_blocks, len(x) // num_blocks, *x.shape[1:]))

    def total(self, x: Shaped[Array, "L ..."]) -> Shaped[Array, "..."]:
        """The sum over all blocks, of all devices, in their order; the same to the bit on any number of devices."""
        every = x if self.devices == 1 else jax.lax.all_gather(x, _AXIS, tiled=True)
        return functools.reduce(jnp.add, list(every))

    def each_block(self, function: Callable[[Any], Any], blocks: Any) -> Any:
        """What a function makes of each block of a pytree with the leading axis L; see `one_by_one`."""
        return one_by_one(function, blocks)

    def mean(self, function: Callable[[Any], Any], blocks: Any) -> Any:
        """The mean over all blocks of what a function makes of each, float32, gathered in one transfer."""
        rows, restore = self._rows(function, blocks)
        return restore(self.total(rows) / self.blocks)

    def _rows(self, function: Callable[[Any], Any], blocks: Any) -> tuple[Float32[Array, "L _"], Callable[[Any], Any]]:
        """What a function makes of each block, as one row of numbers, and how to make of a row what it was."""
        first = jax.eval_shape(function, jax.tree.map(lambda x: x[0], blocks))
        restore = jax.flatten_util.ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), first))[1]
        return self.each_block(lambda block: jax.flatten_util.ravel_pytree(function(block))[0], blocks), restore
