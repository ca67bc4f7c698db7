"""Writes an agent as a file: ``python -m experiments.export --run DIR``, with ``--help`` for the flags."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("export", program="python -m experiments.export"))
