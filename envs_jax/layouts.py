"""Layouts in files: a versioned npz with a checksum, refused as a whole when anything in it is wrong."""

from __future__ import annotations

import functools
import hashlib
import os
import pathlib
from typing import Any

import jax
import numpy as np

from envs_jax.base import Environment, Layout

FORMAT_VERSION = 1


def save_layouts(path: str | os.PathLike[str], env: Environment, layouts: Layout) -> None:
    """Writes layouts of an environment to a file, all or nothing.

    Args:
        path: the file; replaced if it exists.
        env: whose layouts they are.
        layouts: a layout pytree with a leading axis, one entry for each layout.

    Raises:
        ValueError: if these are not layouts of ``env``.
    """
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(layouts)]
    _check(env, leaves, "layouts to save")
    content: dict[str, Any] = {f"leaf_{i}": leaf for i, leaf in enumerate(leaves)}
    content["version"] = np.int64(FORMAT_VERSION)
    content["environment"] = np.array(env.name)
    content["digest"] = np.array(_digest(leaves))
    target = pathlib.Path(path)
    partial = target.with_name(target.name + f".{os.getpid()}.part")
    try:
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **content)
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def load_layouts(path: str | os.PathLike[str], env: Environment) -> Layout:
    """Reads layouts written by :func:`save_layouts`.

    Args:
        path: the file.
        env: the environment they are for.

    Returns:
        The layout pytree with a leading axis, as numpy arrays.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, of another version, or not for this environment.
    """
    where = f"layout file {os.fspath(path)}"
    with open(path, "rb") as file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                content = {name: archive[name] for name in archive.files}
        except Exception as error:  # A damaged archive makes zipfile raise a dozen unrelated types.
            raise ValueError(f"{where} cannot be read: it is damaged or no layout file ({error})") from error
    structure = jax.tree.structure(_expected(env))
    names = [f"leaf_{i}" for i in range(len(jax.tree.leaves(_expected(env))))]
    missing = {"version", "environment", "digest", *names} - content.keys()
    if "version" in missing:
        raise ValueError(f"{where} is no layout file: it has no version")
    if int(content["version"]) != FORMAT_VERSION:
        raise ValueError(f"{where} has format version {content['version']}, expected {FORMAT_VERSION}")
    if missing:
        raise ValueError(f"{where} lacks {', '.join(sorted(missing))}")
    leaves = [content[name] for name in names]
    if str(content["digest"]) != _digest(leaves):
        raise ValueError(f"{where} is damaged: its content does not match its checksum")
    _check(env, leaves, f"{where} (written for {content['environment']!s})")
    return jax.tree.unflatten(structure, leaves)


@functools.cache
def _expected(env: Environment) -> Any:
    """Shapes and dtypes of one layout."""
    return jax.eval_shape(env.sample_layout, jax.random.key(0), env.default_params)


def _check(env: Environment, leaves: list[np.ndarray], where: str) -> None:
    """Raises ``ValueError`` unless the leaves are a batch of layouts of ``env``."""
    expected = jax.tree.leaves(_expected(env))
    if len(leaves) != len(expected):
        raise ValueError(f"{where}: {len(leaves)} arrays were found, {env.name} expects {len(expected)}")
    for leaf, one in zip(leaves, expected, strict=True):
        if leaf.ndim < 1 or leaf.shape[1:] != one.shape or leaf.dtype != one.dtype:
            raise ValueError(
                f"{where}: an array of {leaf.dtype} {list(leaf.shape)} was found, "
                f"{env.name} expects {one.dtype} [number, {', '.join(map(str, one.shape))}]"
            )
        if leaf.shape[0] != leaves[0].shape[0]:
            raise ValueError(f"{where}: arrays for {leaf.shape[0]} and for {leaves[0].shape[0]} layouts were found")
    structure = jax.tree.structure(_expected(env))
    for i in range(leaves[0].shape[0]):
        try:
            env.check_layout(jax.tree.unflatten(structure, [leaf[i] for leaf in leaves]))
        except ValueError as error:
            raise ValueError(f"{where}, number {i}: {error}") from error


def _digest(leaves: list[np.ndarray]) -> str:
    """SHA-256 of the arrays' types, shapes and bytes, in hexadecimal."""
    digest = hashlib.sha256()
    for leaf in leaves:
        digest.update(f"{leaf.dtype.str}{leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()
