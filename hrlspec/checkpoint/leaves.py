"""The leaves of a pytree on the host: what each is, its exact content, and hashes of both.

Checkpoints store these, and tests that demand equality bit by bit compare them.
"""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PYTHON_NUMBERS: dict[str, type] = {"bool": bool, "int": int, "float": float}


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a leaf is, without its values.

    Attributes:
        kind: ``array`` (of numpy or JAX), ``key``, or the name of a Python number's type.
        dtype: name of the dtype, ``key<fry>`` and the like for typed keys; empty for Python numbers.
        shape: shape of the array, or of the array of keys.
    """

    kind: str
    dtype: str = ""
    shape: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{self.dtype}[{','.join(map(str, self.shape))}]" if self.dtype else self.kind


@dataclasses.dataclass(frozen=True)
class Leaf:
    """A leaf on the host: an array's values, a key's uint32 words, or the exact text of a Python number."""

    kind: Kind
    value: np.ndarray | str
    implementation: str = ""  # of a key

    def digest(self) -> str:
        """SHA-256 over type, shape and bytes."""
        content = self.value.encode() if isinstance(self.value, str) else self.value.tobytes()
        return hashlib.sha256(f"{self.kind}\0{self.implementation}\0".encode() + content).hexdigest()


def state_hash(state: Any) -> str:
    """SHA-256 over the paths, types, shapes and bytes of all leaves: equal when two states are equal bit by bit.

    The containers do not count (a dataclass and a dictionary with the same fields agree) and neither does whether an
    array lives in numpy or on a device.
    """
    leaves = flatten(state)
    digest = hashlib.sha256()
    for path in sorted(leaves):
        digest.update(f"{path}\0{leaves[path].digest()}\n".encode())
    return digest.hexdigest()


def flatten(state: Any) -> dict[str, Leaf]:
    """All leaves by path, on the host."""
    with_paths = jax.tree_util.tree_flatten_with_path(state)[0]
    kinds = [kind_of(path_name(path), leaf) for path, leaf in with_paths]
    # One transfer for everything; typed keys have no form on the host and go as their words.
    values = jax.device_get([jax.random.key_data(leaf) if _is_key(leaf) else leaf for _, leaf in with_paths])
    leaves: dict[str, Leaf] = {}
    for (path, original), kind, value in zip(with_paths, kinds, values, strict=True):
        name = path_name(path)
        if name in leaves:
            raise ValueError(f"two leaves of the state have the same path {name!r}")
        if kind.kind in PYTHON_NUMBERS:
            leaves[name] = Leaf(kind, repr(value))
        else:
            implementation = str(jax.random.key_impl(original)) if _is_key(original) else ""
            leaves[name] = Leaf(kind, np.asarray(value, order="C"), implementation)
    return leaves


def kind_of(name: str, leaf: Any) -> Kind:
    """What a leaf is, concrete or abstract."""
    if type(leaf).__name__ in PYTHON_NUMBERS and type(leaf) in PYTHON_NUMBERS.values():
        return Kind(type(leaf).__name__)
    if _is_key(leaf):
        return Kind("key", str(leaf.dtype), tuple(leaf.shape))
    if isinstance(leaf, jax.Array | np.ndarray | np.generic | jax.ShapeDtypeStruct):
        dtype = np.dtype(leaf.dtype)
        if dtype.isnative and (dtype.kind in "biufc" or is_extended(dtype)):
            return Kind("array", dtype.name, tuple(leaf.shape))
        raise TypeError(f"leaf {name!r} has the dtype {dtype}; a checkpoint holds native numbers and booleans")
    raise TypeError(
        f"leaf {name!r} is a {type(leaf).__name__}; a checkpoint holds arrays, typed keys, bool, int and float"
    )


def as_target(leaf: Leaf, like: Any) -> Any:
    """The leaf as the type that the target has there, and where the target has it."""
    if isinstance(leaf.value, str):
        return leaf.value == "True" if leaf.kind.kind == "bool" else PYTHON_NUMBERS[leaf.kind.kind](leaf.value)
    if isinstance(like, np.ndarray | np.generic):
        return leaf.value[()] if isinstance(like, np.generic) else leaf.value
    value = leaf.value

    def copy(share: Any) -> jax.Array:
        return jnp.array(value[share])  # since JAX may be asked to donate it

    # Of what lies on several processes' devices each process places its own share.
    placed = isinstance(like, jax.Array) and like.committed
    array = jax.make_array_from_callback(value.shape, like.sharding, copy) if placed else copy(...)
    return jax.random.wrap_key_data(array, impl=leaf.implementation) if leaf.kind.kind == "key" else array


def is_extended(dtype: np.dtype) -> bool:
    """Whether this is bfloat16 or another of the types that JAX adds to numpy, which registers them as user types."""
    return dtype.isbuiltin == 2


def path_name(path: tuple[Any, ...]) -> str:
    """A leaf's path as text, such as ``params/encoder/kernel``."""
    return jax.tree_util.keystr(path, simple=True, separator="/")


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | jax.ShapeDtypeStruct) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
