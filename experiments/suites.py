"""Draws the test suites anew: ``python -m experiments.suites``."""

from __future__ import annotations

import sys

from hrlspec.presets.suites import main
from hrlspec.run.errors import main_guard

if __name__ == "__main__":
    sys.exit(main_guard(main))
