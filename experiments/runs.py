"""Lists run folders: ``python -m experiments.runs``, with ``--help`` for the flags."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("runs", program="python -m experiments.runs"))
