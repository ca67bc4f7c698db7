"""The paper's two motivating examples: ``python -m experiments.demo rooms|dilemma``."""

from __future__ import annotations

import sys

from hrlspec.run.commands.demo import main
from hrlspec.run.errors import main_guard

if __name__ == "__main__":
    sys.exit(main_guard(main))
