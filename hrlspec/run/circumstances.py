"""What numbers depend on beside the configuration that they are of."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax

from hrlspec.version import __version__

_CHANGES = (
    *("status", "--porcelain", "--untracked-files=no"),
    *("--", ":/", ":(top,exclude)results", ":(top,exclude)docs/results.md"),
)
_PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy", "orbax-checkpoint")


def circumstances(*, command: bool = True) -> dict[str, Any]:
    """What numbers depend on beside the configuration: versions, commit, command, time, machine, devices.

    Args:
        command: whether the command is among them; it tells where this machine keeps its files.
    """
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {
        "versions": {"hrlspec": __version__, "python": platform.python_version(), **versions},
        "commit": current_commit(),
        **({"command": [_program(), *sys.argv[1:]]} if command else {}),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} CPUs",
        "devices": [str(device) for device in jax.devices()],
    }


def _program() -> str:
    """What this process runs, wherever the checkout lies."""
    path, root = Path(sys.argv[0]), Path(__file__).parents[2]
    return str(path.relative_to(root)) if path.is_relative_to(root) else path.name


def current_commit() -> str | None:
    """The commit this code stands at, ``+changes`` if files differ from it; ``None`` where git does not know.

    Records in ``results`` and the page that is written of them are no code: commands add to them while they run.
    """
    source = Path(__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(source.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", source.name)  # an installed copy may lie in somebody else's repository
        return git("rev-parse", "HEAD") + ("+changes" if git(*_CHANGES) else "")
    except (OSError, subprocess.SubprocessError):
        return None
