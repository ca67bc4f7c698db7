"""How others evaluate, as their programs have it."""

from __future__ import annotations

import pytest

import envs_jax
from hrlspec.presets.peers.protocols import Protocol, manner


@pytest.mark.parametrize(
    ("protocol", "world", "forever", "expected"),
    [
        ("jaxolotl", "letter12", False, (512, False)),
        ("jaxolotl", "zone-jaxolotl", False, (512, False)),
        ("deepltl", "letter12", False, (500, False)),
        ("deepltl", "flatworld", False, (500, False)),
        ("deepltl", "zone", False, (500, True)),
        ("deepltl", "zone", True, (500, False)),
    ],
)
def test_manner(protocol: Protocol, world: str, forever: bool, expected: tuple[int, bool]) -> None:
    assert manner(protocol, envs_jax.make(world), forever) == expected
