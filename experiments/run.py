"""Trains an agent: ``python -m experiments.run``, with ``--help`` for the flags."""

from __future__ import annotations

import sys

from hrlspec.run.cli import call

if __name__ == "__main__":
    sys.exit(call("run", program="python -m experiments.run"))
