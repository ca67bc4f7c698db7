"""Trains an agent: ``python -m experiments.run``, with ``--help`` for the flags."""

from __future__ import annotations

import sys

from hrlspec.run.commands.run import main
from hrlspec.run.errors import main_guard

if __name__ == "__main__":
    sys.exit(main_guard(main))
