"""What XLA and JAX are told before their first use. Call `prepare` when a command line knows its environment.

XLA reads its flags when the first array is made, so this must come before that; importing JAX is harmless.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import sys
from pathlib import Path

import jax

_OPTIONS = "--xla_backend_extra_options="
# The CPU backend folds the body of a small loop into one kernel, which makes rollouts several times faster. Up to JAX
# 0.11 what it calls small is too small for them; from 0.12 on its own choice is better.
_SMALL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
_SMALL_LOOPS_BYTES = 65536
# An iteration compiles in two thirds of the time and, under recipe hrlspec, runs as fast: its time is spent in matrix
# products, which are not compiled here. At level 0 it takes twice as long. Zone's physics is compiled here: at level 1
# it runs at 40 % of its speed; and so is what surrounds the products of recipe paper, which runs at 80 to 85 %.
_QUICK = {"--xla_backend_optimization_level": "1", "--xla_cpu_use_fusion_emitters": "false"}


def prepare(env_name: str, recipe: str) -> None:
    """Sets XLA's flags for this version of JAX and a compilation cache that later processes share.

    ``env_name`` and ``recipe`` name the preset that will run.

    What the user set in ``XLA_FLAGS``, ``JAX_COMPILATION_CACHE_DIR`` and JAX's other variables stays as it is.
    """
    _keep_freed_memory()
    flags = with_loop_option(os.environ.get("XLA_FLAGS", ""), jax.__version_info__)
    quickly = recipe == "hrlspec" and not env_name.startswith("zone") and not _has_accelerator()
    os.environ["XLA_FLAGS"] = compiled_quickly(flags) if quickly else flags
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _keep_freed_memory() -> None:
    """Tells glibc not to give large blocks back to the system.

    XLA takes the same ones again in every iteration, and the kernel would map and clear each page anew.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries lack it
    if mallopt:
        trim_threshold, mmap_threshold = -1, -3
        mallopt(trim_threshold, 2**31 - 1)
        mallopt(mmap_threshold, 2**30)


def with_loop_option(flags: str, version: tuple[int, ...]) -> str:
    """``XLA_FLAGS`` with the option for small loops, where this version of JAX wants it and it is not there yet."""
    if version >= (0, 12) or _SMALL_LOOPS in flags:
        return flags
    option = f"{_SMALL_LOOPS}={_SMALL_LOOPS_BYTES}"
    words = flags.split()
    for i, word in enumerate(words):
        if word.startswith(_OPTIONS):  # a second flag of this name would replace the first
            words[i] = f"{word},{option}"
            return " ".join(words)
    return " ".join([*words, _OPTIONS + option])


def compiled_quickly(flags: str) -> str:
    """``XLA_FLAGS`` with those that make XLA compile code for the CPU in less time, unless they are there."""
    return " ".join([*flags.split(), *(f"{name}={value}" for name, value in _QUICK.items() if name not in flags)])


def _has_accelerator() -> bool:
    """Whether JAX has a plugin for one: on a GPU most code is compiled here, and its speed counts."""
    if os.environ.get("JAX_PLATFORMS") == "cpu":
        return False
    return any(importlib.metadata.entry_points(group="jax_plugins"))


def cache_folder() -> Path:
    """The user's folder for compiled programs, one for each version of jaxlib."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "hrlspec" / f"jaxlib-{importlib.metadata.version('jaxlib')}"
