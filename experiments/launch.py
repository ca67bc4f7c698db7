"""Trains with several processes of this machine: ``python -m experiments.launch -n 2 -- FLAGS OF experiments.run``."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("launch", program="python -m experiments.launch"))
