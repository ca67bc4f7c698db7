"""Evaluates a trained agent: ``python -m experiments.evaluate --run DIR``, with ``--help`` for the flags."""

from __future__ import annotations

import sys

from hrlspec.run.cli import call

if __name__ == "__main__":
    sys.exit(call("evaluate", program="python -m experiments.evaluate"))
