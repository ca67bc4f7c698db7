"""Formulas of published evaluations, by who published them: text files with their sources."""

from __future__ import annotations

from pathlib import Path

from hrlspec.presets.suites import SuiteError

FOLDER = Path(__file__).parent


def peer_suites() -> tuple[str, ...]:
    """Their names, such as ``jaxolotl/letter_finite``."""
    return tuple(f"{file.parent.name}/{file.stem}" for file in sorted(FOLDER.glob("*/*.txt")))


def go_on_for_ever(name: str) -> bool:
    """Whether the formulas of a published suite are meant for ever, and not to be satisfied by an episode's end."""
    return name.endswith(("_infinite", "_stay"))


def peer_formulas(name: str) -> str:
    """Text with one formula a line.

    Raises:
        SuiteError: there is no such suite; the message lists those there are.
    """
    if name not in peer_suites():
        raise SuiteError(f"unknown suite {name!r}; published ones are: {', '.join(peer_suites())}")
    return (FOLDER / f"{name}.txt").read_text(encoding="utf-8")
