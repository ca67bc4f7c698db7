"""What all tests share."""

from __future__ import annotations

import os

import jax

from tests import typecheck

typecheck.install()  # before anything that is to be checked is imported

from hrlspec.run.platform import with_loop_option  # noqa: E402

# Before the first array is made, so that tests and the processes they start run the same programs, to the bit. Most of
# the tests' time is compilation: what shortens it is a flag here where every release knows it (0.11.1 is the first that
# does not know the second), since an unknown one ends the process. The caller's own come last and so prevail.
_QUICK = "--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false "
_given = (_QUICK if jax.__version_info__ < (0, 11, 1) else "") + os.environ.get("XLA_FLAGS", "")
os.environ["XLA_FLAGS"] = with_loop_option(_given.strip(), jax.__version_info__)
