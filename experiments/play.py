"""A page for trying an agent by hand: ``python -m experiments.play --run DIR``, with ``--help`` for the flags."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("play", program="python -m experiments.play"))
