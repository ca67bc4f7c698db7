"""The paper's two motivating examples: ``python -m experiments.demo rooms|dilemma``."""

from __future__ import annotations

import sys

from hrlspec.run.cli import call

if __name__ == "__main__":
    sys.exit(call("demo", program="python -m experiments.demo"))
