"""What XLA and JAX are told before their first use, and how programs are compiled. Command lines call `prepare`.

XLA reads its flags when the first array is made, so `prepare` must come before that; importing JAX is harmless. A flag
that XLA does not know ends the process, and versions differ in what they know; an option of a single program that it
does not know is an error that can be caught. So what can be an option is one.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import jax

from hrlspec.config import Effort
from hrlspec.run.errors import UserError, in_words

_HOST_DEVICES = "--xla_force_host_platform_device_count"
_OPTIONS = "--xla_backend_extra_options="
# The CPU backend folds the body of a small loop into one kernel, which makes rollouts several times faster. Up to JAX
# 0.11 what it calls small is too small for them; from 0.12 on its own choice is better. No option of a program says
# this; every release of JAX 0.10 and 0.11 knows the flag.
_SMALL_LOOPS = "xla_cpu_small_while_loop_byte_threshold"
_SMALL_LOOPS_BYTES = 65536
# Matrix products are not compiled here. What is around them runs at half its speed at level 0, and at level 1 as fast,
# but for Zone's physics (40 %) and recipe paper. Without the fusion emitters programs compile in three quarters of the
# time, but a hyperbolic tangent takes twice as long: Walk, whose products are small, trains at three quarters of its
# speed. Letter, measured twice, was once a tenth slower and once no slower.
_LESS_EFFORT: dict[str, dict[str, str | bool]] = {
    "little": {"xla_backend_optimization_level": "1"},
    "least": {"xla_backend_optimization_level": "1", "xla_cpu_use_fusion_emitters": False},
}


def prepare(host_devices: int = 1) -> None:
    """Sets XLA's flags for this version of JAX and a compilation cache that later processes share.

    What the user set in ``XLA_FLAGS``, ``JAX_COMPILATION_CACHE_DIR`` and JAX's other variables stays as it is, but for
    ``JAX_ENABLE_X64``: runs compute in single precision, and are the same wherever they are started.

    Args:
        host_devices: how many devices the processor is to be, unless the user's flags say it.

    Raises:
        UserError: XLA would end the process because of its flags, or there is no device to compute on.
    """
    _keep_freed_memory()
    flags = _flags_of_user(os.environ.get("XLA_FLAGS", ""))
    if host_devices > 1 and _HOST_DEVICES not in flags:
        flags = f"{flags} {_HOST_DEVICES}={host_devices}".strip()
    os.environ["XLA_FLAGS"] = with_loop_option(flags, jax.__version_info__)
    jax.config.update("jax_enable_x64", False)
    folder = cache_folder()
    if jax.config.values["jax_compilation_cache_dir"] is None and folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    # A cache that cannot be read or written costs time and nothing else.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    try:
        jax.devices()
    except Exception as error:  # what is raised differs from backend to backend
        platforms = os.environ.get("JAX_PLATFORMS")
        asked = f" with JAX_PLATFORMS={platforms}; without it JAX chooses" if platforms else ""
        raise UserError(f"JAX finds no device to compute on{asked} ({in_words(error)})") from error


@functools.cache
def _flags_of_user(given: str) -> str:
    """The flags in ``XLA_FLAGS``, or in the file that it names, once XLA has accepted them.

    XLA ends its process where it does not, so one of its own is asked.
    """
    if not given.strip():
        return ""
    flags = given
    if not given[0].isspace() and given[0] != "-":  # so XLA decides
        try:
            flags = Path(given).read_text()
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise UserError(f"XLA_FLAGS names the file {given!r}, which cannot be read: {reason}") from error
    ask = "from jaxlib import xla_client; xla_client.CompileOptions()"
    asked = subprocess.run(
        [sys.executable, "-c", ask], env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, check=False
    )
    answer = asked.stderr.decode(errors="replace")
    if asked.returncode and "Traceback" not in answer:  # it was XLA and not Python that ended the process
        said = re.search(r"Unknown flags? in XLA_FLAGS: (.*)", answer)
        raise UserError(f"XLA does not know {said[1]}" if said else f"XLA does not accept XLA_FLAGS: {given}")
    return flags


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


def compiler_options(effort: Effort) -> dict[str, str | bool]:
    """Options for ``lowered.compile``: those that the installed XLA knows and the user's ``XLA_FLAGS`` leaves open.

    Args:
        effort: what compiling for the CPU is worth. On other devices more of the code is compiled, and its speed
            counts, so this changes nothing there.
    """
    if jax.default_backend() != "cpu":
        return {}
    flags = os.environ.get("XLA_FLAGS", "")
    wanted = _LESS_EFFORT.get(effort, {})
    return {name: value for name, value in wanted.items() if name not in flags and _is_known(name, value)}


@functools.cache
def _is_known(name: str, value: str | bool) -> bool:
    try:
        jax.jit(lambda: 0).lower().compile(compiler_options={name: value})
    except jax.errors.JaxRuntimeError:  # no such option, or not with such a value
        return False
    return True


def cores() -> list[int]:
    """The numbers of the processor's cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if sys.platform == "linux" else list(range(os.cpu_count() or 1))


def cache_folder() -> Path | None:
    """The user's folder for compiled programs, one for each version of jaxlib; ``None`` for users without a home."""
    try:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(base) / "hrlspec" / f"jaxlib-{importlib.metadata.version('jaxlib')}"
