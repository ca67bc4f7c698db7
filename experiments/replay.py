"""A page that plays episodes: ``python -m experiments.replay --run DIR``, with ``--help`` for the flags."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("replay", program="python -m experiments.replay"))
