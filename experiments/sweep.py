"""Trains an agent for each combination of settings and seeds: ``python -m experiments.sweep``, with ``--help``."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("sweep", program="python -m experiments.sweep"))
