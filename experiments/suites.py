"""Draws the test suites anew: ``python -m experiments.suites``."""

from __future__ import annotations

import sys

from hrlspec.run.cli import call

if __name__ == "__main__":
    sys.exit(call("suites", program="python -m experiments.suites"))
