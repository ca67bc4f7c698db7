"""Compiled programs kept from one process to the next, so that a start needs neither tracing nor compiling.

JAX's own cache keeps what XLA compiled, but has to trace a program to look it up; that takes longer than all the rest
of a start. Here a program is found by what it was made from: the sources of the packages, versions, settings, shapes.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import logging
import os
import pickle
import platform
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

import envs_jax
import hrlspec
from hrlspec.config import Effort
from hrlspec.learning.shards import first_devices
from hrlspec.run.platform import compiler_options

KEPT = 64
"""Programs in the folder; those used least recently go first."""

_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH

_log = logging.getLogger("hrlspec.run")


class Program:
    """A jitted function of fixed static arguments, for one set of shapes: loaded or compiled at the first call.

    Args:
        name: of the file.
        function: jitted, with its static arguments first.
        static: these; their ``repr`` must tell everything about them.
        effort: of the compiler; see `compiler_options`.
        kept: from one process to the next, if JAX's own cache is in use.
        devices: on how many it runs; see `first_devices`.
    """

    def __init__(
        self, name: str, function: Any, *static: Any, effort: Effort = "most", kept: bool = True, devices: int = 1
    ) -> None:
        self._name, self._function, self._static = name, function, static
        self._effort: Effort = effort
        self._kept, self._devices = kept, devices
        self._compiled: Callable[..., Any] | None = None

    def __call__(self, *args: Any) -> Any:
        """Runs it; the arguments have the same shapes and types at each call."""
        if self._compiled is None:
            self._compiled = self._find(args)
        return self._compiled(*args)

    def _find(self, args: tuple[Any, ...]) -> Callable[..., Any]:
        options = compiler_options(self._effort)
        folder = _folder() if self._kept else None
        if folder is None:
            return self._lower(args).compile(options)
        file = folder / f"{self._name}-{_digest(_fingerprint(), self._static, _described(args), options)}"
        with contextlib.suppress(Exception):  # not there, or damaged, or of another machine: it is made anew
            return _load(file, args, self._devices)
        lowered = self._lower(args)
        # What comes out of JAX's cache lacks code that storing it again would need; the loss shows at the first call.
        with _without_cache():
            compiled = lowered.compile(options)
        with contextlib.suppress(Exception):  # no space, or a backend that cannot: the next start compiles again
            _save(file, compiled)
        return compiled

    def _lower(self, args: tuple[Any, ...]) -> jax.stages.Lowered:
        lowered: jax.stages.Lowered = self._function.lower(*self._static, *args)
        return lowered


@contextlib.contextmanager
def _without_cache() -> Iterator[None]:
    """Compiling anew in spite of JAX's cache."""
    used = jax.config.values["jax_enable_compilation_cache"]
    _use_cache(False)
    try:
        yield
    finally:
        _use_cache(used)


def _use_cache(enabled: bool) -> None:
    jax.config.update("jax_enable_compilation_cache", enabled)
    compilation_cache.reset_cache()  # it reads its settings once


def _folder() -> Path | None:
    """Next to JAX's own cache, and only where that is used; ``None`` where others could put code of theirs."""
    settings = jax.config.values
    cache = settings["jax_compilation_cache_dir"] if settings["jax_enable_compilation_cache"] else None
    return _own(Path(cache) / "hrlspec-programs") if cache and "://" not in cache else None


@functools.cache
def _own(folder: Path) -> Path | None:
    """The folder, made if missing; ``None``, said once, if it is not this user's alone to write to."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        reason = _not_own(folder.lstat())
    except OSError as error:
        reason = f"{error.strerror}"
    if reason is None:
        return folder
    _log.warning("compiled programs are not kept in %s: %s; set JAX_COMPILATION_CACHE_DIR to another", folder, reason)
    return None


def _not_own(found: os.stat_result) -> str | None:
    """What is wrong if others may have written there; loading a program runs code."""
    if sys.platform == "win32" or found.st_uid != os.geteuid():
        return "it belongs to somebody else"
    return "others may write there" if found.st_mode & _OTHERS_MAY_WRITE or stat.S_ISLNK(found.st_mode) else None


def _load(file: Path, args: tuple[Any, ...], devices: int) -> Callable[..., Any]:
    with file.open("rb") as stream:
        if reason := _not_own(os.fstat(stream.fileno())):
            raise PermissionError(reason)
        payload, result = pickle.load(stream)
    os.utime(file)
    in_tree = jax.tree.structure((args, {}))
    program: Any = serialize_executable.deserialize_and_load(
        payload, in_tree, jax.tree.structure(result), execution_devices=first_devices(devices)
    )
    return program


def _save(file: Path, compiled: jax.stages.Compiled) -> None:
    payload, _, out_tree = serialize_executable.serialize(compiled)
    # Structures of trees cannot be stored, but trees can.
    content = pickle.dumps((payload, jax.tree.unflatten(out_tree, range(out_tree.num_leaves))))
    with tempfile.TemporaryDirectory(dir=file.parent, prefix=".") as scratch:
        whole = Path(scratch, file.name)
        whole.touch(mode=0o600)
        whole.write_bytes(content)
        whole.replace(file)
    known = sorted(file.parent.glob("[!.]*"), key=lambda path: path.stat().st_mtime, reverse=True)
    for old in known[KEPT:]:
        old.unlink(missing_ok=True)


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _described(args: tuple[Any, ...]) -> tuple[str, ...]:
    """Structure, shapes and types of arguments."""
    leaves, structure = jax.tree.flatten(args)
    return (str(structure), *(str(jax.typeof(leaf)) for leaf in leaves))


@functools.cache
def _fingerprint() -> tuple[Any, ...]:
    """What decides, besides settings and shapes, which machine code comes out."""
    sources = hashlib.sha256()
    for package in (hrlspec, envs_jax):
        for file in sorted(Path(str(package.__file__)).parent.rglob("*.py")):
            sources.update(file.read_bytes())
    versions = sorted(
        (str(name), found.version) for found in importlib.metadata.distributions() if (name := found.metadata["Name"])
    )
    settings = sorted((name, repr(value)) for name, value in jax.config.values.items() if "cache" not in name)
    device = jax.devices()[0]
    return (
        sources.hexdigest(),
        versions,
        settings,
        os.environ.get("XLA_FLAGS"),
        platform.python_version(),
        (device.platform, device.device_kind, jax.device_count(), _processor()),
        (jax.process_index(), jax.process_count()),
    )


def _processor() -> str:
    """What instructions the machine knows, as far as the system says so."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next((line for line in lines if line.startswith("flags")), "")
    return platform.processor()
