"""The README's Python runs as it stands, but that training is of few steps and of a smaller program."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import jax
import pytest

from tests.test_quickstart import SHORTER

README = Path(__file__).parents[1] / "README.md"


def blocks() -> tuple[str, str, str]:
    """Training and evaluating, with one short iteration; the parts that training is made of; Gymnasium."""
    first, more, gymnasium = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    shorter, count = re.subn(r"total_steps=2_500_000", f"total_steps=1_024, changes={SHORTER}", first)
    assert count == 1
    return shorter, more, gymnasium


def run(*code: str) -> dict[str, Any]:
    """The names that code leaves."""
    names: dict[str, Any] = {}
    for block in code:
        exec(compile(block, str(README), "exec", dont_inherit=True), names)
    return names


def test_a_stranger_trains_within_a_screen() -> None:
    text = README.read_text()
    assert text.index("import hrlspec") < len("".join(text.splitlines(keepends=True)[:30]))
    assert len(text.splitlines()) <= 120


def test_gymnasium(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(blocks()[2])["info"]["status"] == "running"
    assert "achieve " in capsys.readouterr().out  # the sampled action may have reached a


def test_the_first_agent() -> None:
    names = run(blocks()[0])
    assert 0 <= names["result"].total.success_rate.estimate <= 1


@pytest.mark.slow
def test_what_training_is_made_of() -> None:
    names = run("import jax, hrlspec", blocks()[1])
    assert {len(x) for x in jax.tree.leaves(names["agents"].params)} == {2}
    assert int(names["state"].iteration) == 1
