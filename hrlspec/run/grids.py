"""Grids of settings: what ``--grid`` and ``--seeds`` say, and the flags of ``hrlspec run`` that they stand for."""

from __future__ import annotations

import collections
import functools
import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any

from hrlspec.run.errors import UserError
from hrlspec.run.run_flags import LAST_SEED, RunFlags, parse_run

Grid = Mapping[str, Sequence[str]]
"""By setting its values, all as text."""
Cell = Mapping[str, str]
"""One value of each setting."""

_OWN = ("seed", "num_seeds", "out", "resume")
_MOST_SEEDS = 10_000  # a range with a slip of the pen would fill the memory
_NAME = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*")
_SWITCHED = {"true": True, "false": False}


def grid_of(axes: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """What ``--grid`` says.

    Args:
        axes: ``SETTING=VALUE,VALUE,...``, where a setting is a flag of ``hrlspec run`` without its dashes.

    Raises:
        UserError: one cannot be understood, or a setting or a value comes twice, or is not the grid's to say.
    """
    grid: dict[str, tuple[str, ...]] = {}
    for axis in axes:
        name, equals, text = axis.partition("=")
        name, values = _canonical(name), tuple(text.split(","))
        if not equals or not _NAME.fullmatch(name):
            raise UserError(f"--grid {axis}: expected SETTING=VALUE,VALUE,... such as config.num_envs=64,128")
        if name in _OWN:
            raise UserError(f"--grid {axis}: seeds are given by --seeds, and folders by --out")
        if name in grid:
            raise UserError(f"--grid {axis}: {name} is in the grid already")
        if len({*values}) < len(values):
            raise UserError(f"--grid {axis}: there is a value twice")
        grid[name] = values
    return grid


def seeds_of(text: str) -> list[int]:
    """What ``--seeds`` says: numbers and ranges with both ends, such as ``0-4`` or ``0,2,7-9``.

    Raises:
        UserError: it cannot be understood, or a seed comes twice.
    """
    seeds: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"(\d+)(?:-(\d+))?", part.strip())
        if found is None or int(found[2] or found[1]) < int(found[1]):
            raise UserError(f"--seeds {text}: expected numbers and ranges, such as 0-4 or 0,2,7-9, found {part!r}")
        if int(found[2] or found[1]) > LAST_SEED:
            raise UserError(f"--seeds {text}: expected seeds up to {LAST_SEED}")
        if int(found[2] or found[1]) - int(found[1]) >= _MOST_SEEDS:
            raise UserError(f"--seeds {text}: expected at most {_MOST_SEEDS} seeds in a range")
        seeds += range(int(found[1]), int(found[2] or found[1]) + 1)
    if len({*seeds}) < len(seeds):
        raise UserError(f"--seeds {text}: there is a seed twice")
    return seeds


def check_shared(shared: Sequence[str], grid: Grid) -> None:
    """Refuses flags that all runs are to share, where a sweep or its grid says them.

    Raises:
        UserError: one is such a flag.
    """
    for word in shared:
        name = _canonical(word.partition("=")[0])
        if word.startswith("--") and name in _OWN:
            raise UserError(f"{word} is among the flags of all runs: seeds are given by --seeds, and folders by --out")
        if word.startswith("--") and name in grid:
            raise UserError(f"{word} is among the flags of all runs, and in the grid too")


def cells_of(grid: Grid) -> list[Cell]:
    """All combinations of values, the last setting's changing first."""
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]


def short_names(grid: Grid) -> dict[str, str]:
    """What settings are called where there is little room: their last part, unless another's is the same."""
    last = {name: name.rpartition(".")[2] for name in grid}
    counts = collections.Counter(last.values())
    return {name: short if counts[short] == 1 else name for name, short in last.items()}


def cell_name(cell: Cell, names: Mapping[str, str]) -> str:
    """Such as ``num_envs=64,rounds=1``; what does not belong into the name of a folder becomes an underscore."""
    return ",".join(f"{names[name]}={re.sub(r'[^-+.:%@ 0-9A-Za-z_]', '_', value)}" for name, value in cell.items())


def flags_of(cell: Cell, shared: Sequence[str]) -> list[str]:
    """The flags of a cell's runs, but for seed and folder.

    Args:
        cell: its settings. ``true`` and ``false`` are the values of a switch; of several values for one setting, as
            where it is a tuple, spaces are between.
        shared: flags of all runs.

    Raises:
        UserError: there are switches, and the other flags are not allowed.
    """
    words, switches = [*shared], dict[str, bool]()
    for name, value in cell.items():
        if value in _SWITCHED:
            switches[name] = _SWITCHED[value]
        else:
            words += [f"--{name}", *value.split()]
    if switches:
        chosen = parse_run(words)
        words += [word for name, on in switches.items() for word in _switch(name, on, chosen)]
    return words


def _canonical(name: str) -> str:
    """Without dashes in front, and with underscores for others."""
    return name.lstrip("-").replace("-", "_")


def _switch(name: str, on: bool, chosen: RunFlags) -> list[str]:
    """The words that turn a switch on or off: it has a flag for what it is not by default."""
    first, *rest = name.split(".")
    parts = ["method_settings" if first == "method" and rest else first, *rest]
    found: Any = chosen
    try:
        found = functools.reduce(getattr, parts, found)
    except AttributeError:
        found = None
    if not isinstance(found, bool):
        return [f"--{name}", str(on)]
    if found == on:
        return []
    place, dot, last = name.rpartition(".")
    return [f"--{place}{dot}{'' if on else 'no-'}{last}"]
