"""Draws the test suites anew: ``python -m experiments.suites``."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("suites", program="python -m experiments.suites"))
