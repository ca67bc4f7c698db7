"""Applying a function to some environments at a time: only to those that need it, or block by block.

Axes: **E** environments, **L** parts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Int32, Shaped

from envs_jax.arrays import Array

AT_ONCE = 4096
"""Environments that an accelerator computes at a time at least."""

Inputs = TypeVar("Inputs")
Outputs = TypeVar("Outputs")


def take(tree: Inputs, *index: Any) -> Inputs:
    """What a pytree holds at some places of its leading axes, none of which is negative or beyond the end.

    Told so, JAX makes a sixth of the operations that it makes of ``x[index]``, and a program compiles the sooner.

    Args:
        tree: leaves ``[A, B, ...]``.
        index: int32 arrays or slices, for the axes A, B, ...
    """
    taken: Inputs = jax.tree.map(lambda x: x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False), tree)
    return taken


def where(condition: Bool[Array, " E"], new: Inputs, old: Inputs) -> Inputs:
    """Leaves of ``new`` in the environments where ``condition`` (bool ``[E]``), of ``old`` in the others."""

    def pick(new: Shaped[Array, "E ..."], old: Shaped[Array, "E ..."]) -> Array:
        return jnp.where(condition.reshape(condition.shape + (1,) * (new.ndim - 1)), new, old)

    picked: Inputs = jax.tree.map(pick, new, old)
    return picked


def if_any(function: Callable[[], Outputs], needed: Bool[Array, " E"], outputs: Outputs) -> Outputs:
    """What ``function`` makes of all environments where it is needed, and ``outputs`` in the others.

    A CPU does not compute it unless some environment needs it; an accelerator would have to wait to be told.

    Args:
        function: gives a pytree of leading axis E.
        needed: bool ``[E]``.
        outputs: pytree, leading axis E: what the others keep.
    """
    if jax.default_backend() != "cpu":
        return where(needed, function(), outputs)
    kept: Outputs = jax.lax.cond(needed.any(), lambda: where(needed, function(), outputs), lambda: outputs)
    return kept


def in_groups(
    function: Callable[[Inputs], Outputs], needed: Bool[Array, " E"], inputs: Inputs, outputs: Outputs, group: int
) -> Outputs:
    """Computes ``function`` where it is needed, ``group`` environments at a time.

    A vmapped ``cond`` would compute it for all of them at every step. Instead the waiting ones are gathered
    in groups of fixed size, computed, and scattered back, until none waits. An accelerator, which small groups would
    leave idle and loops would stop for, computes all of them, or `AT_ONCE` at a time.

    Args:
        function: maps gathered inputs (leading axis ``group``) to outputs of the same leading axis.
        needed: bool ``[E]``.
        inputs: pytree, leading axis E.
        outputs: pytree, leading axis E: what the others keep.
        group: how many at a time.
    """
    num_envs = needed.shape[0]
    if jax.default_backend() != "cpu":
        group = max(group, AT_ONCE)
        if group >= num_envs:
            return where(needed, function(inputs), outputs)
    group = min(group, num_envs)

    def body(carry: tuple[Bool[Array, " E"], Outputs]) -> tuple[Bool[Array, " E"], Outputs]:
        waiting, outputs = carry
        index = jnp.nonzero(waiting, size=group, fill_value=num_envs)[0]
        results = function(take(inputs, jnp.minimum(index, num_envs - 1)))
        outputs = jax.tree.map(lambda out, new: out.at[index].set(new, mode="drop"), outputs, results)
        return waiting.at[index].set(False, mode="drop"), outputs

    return jax.lax.while_loop(lambda carry: carry[0].any(), body, (needed, outputs))[1]


def one_by_one(function: Callable[[Any], Any], parts: Any) -> Any:
    """What a function makes of each part of a pytree, leading axis L in and out, one part after the other.

    Each part is computed by the same code, whatever L is, and so comes out the same to the bit. Vectorised, a matrix
    product would have the rows of all parts and add up in another order; and of a loop that is known to end after one
    round XLA would make other code than of a longer one.
    """

    def step(i: Int32[Array, ""], results: Any) -> Any:
        # With the counter in the barrier, what is made of a single part does not leave the loop either.
        i, part = jax.lax.optimization_barrier((i, jax.tree.map(functools.partial(pick, index=i), parts)))
        return jax.tree.map(functools.partial(put, index=i), results, function(part))

    pick = functools.partial(jax.lax.dynamic_index_in_dim, axis=0, keepdims=False, allow_negative_indices=False)
    put = functools.partial(jax.lax.dynamic_update_index_in_dim, axis=0, allow_negative_indices=False)
    num_parts = jax.tree.leaves(parts)[0].shape[0]
    shapes = jax.eval_shape(function, jax.tree.map(lambda x: x[0], parts))
    empty = jax.tree.map(lambda x: jnp.zeros((num_parts, *x.shape), x.dtype), shapes)
    return jax.lax.fori_loop(0, jax.lax.optimization_barrier(jnp.int32(num_parts)), step, empty)
