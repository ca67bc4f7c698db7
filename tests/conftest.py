"""What all tests share."""

from __future__ import annotations

import os

import jax

from tests import typecheck

typecheck.install()  # before anything that is to be checked is imported

from hrlspec.run.platform import compiled_quickly, with_loop_option

# Before the first array is made, so that tests and the processes they start run the same programs, to the bit.
os.environ["XLA_FLAGS"] = compiled_quickly(with_loop_option(os.environ.get("XLA_FLAGS", ""), jax.__version_info__))
