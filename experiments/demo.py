"""The paper's two motivating examples: ``python -m experiments.demo rooms|dilemma``."""

from __future__ import annotations

from hrlspec.run.cli import call
from hrlspec.run.signals import leave

if __name__ == "__main__":
    leave(call("demo", program="python -m experiments.demo"))
