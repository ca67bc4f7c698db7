"""What all tests share."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import jax
import pytest

from tests import typecheck

typecheck.install()  # before anything that is to be checked is imported

from hrlspec.run.platform import with_loop_option  # noqa: E402

# Tracing makes many objects that stay; looking through them for cycles as often as is the default takes a sixth of it.
gc.set_threshold(50_000, 20, 100)

# Before the first array is made, so that tests and the processes they start run the same programs, to the bit. Most of
# the tests' time is compilation: two flags shorten it, of which 0.11.1 is the first release that does not know the
# second, and an unknown one ends the process. The caller's own come last and so prevail.
_quick = ["--xla_force_host_platform_device_count=4", "--xla_backend_optimization_level=0"]
if jax.__version_info__ < (0, 11, 1):
    _quick.append("--xla_cpu_use_fusion_emitters=false")
_given = " ".join([*_quick, os.environ.get("XLA_FLAGS", "")]).strip()
os.environ["XLA_FLAGS"] = with_loop_option(_given, jax.__version_info__)


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Lets go of compiled programs between files: each holds maps of memory, and at 65,530 of them Linux gives no more.

    XLA then ends the process.
    """
    if nextitem is not None and item.path != nextitem.path and _num_maps() > 30_000:
        jax.clear_caches()


def _num_maps() -> int:
    maps = Path("/proc/self/maps")
    return len(maps.read_bytes().splitlines()) if maps.exists() else 0
