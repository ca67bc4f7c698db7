"""Puts runs side by side: ``python -m experiments.compare``, with ``--help`` for the flags."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("compare", program="python -m experiments.compare"))
