"""docs/new_environment.md and docs/other_environments.md: their code runs, and their environments keep the contract."""

from __future__ import annotations

import contextlib
import functools
import io
import re
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import hrlspec
from envs_jax import Environment
from tests.envs import test_contract as contract

DOCS = Path(__file__).parents[2] / "docs"
PAGE, OTHERS = DOCS / "new_environment.md", DOCS / "other_environments.md"
BLOCKS, (ROOMS, TRAIN_ROOMS, REACHER, TRAIN_REACHER) = (
    re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL) for page in (PAGE, OTHERS)
)


@functools.cache
def world() -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": "new_environment"}
    exec(compile(BLOCKS[0], str(PAGE), "exec", dont_inherit=True), names)
    return names


def ring() -> Environment:
    env: Environment = world()["Ring"]()
    return env


def test_forty_lines_are_enough() -> None:
    lines = BLOCKS[0][BLOCKS[0].index("class Ring(") :].splitlines()
    assert len([line for line in lines if line]) <= 40


@pytest.mark.parametrize(
    "check",
    [
        contract.test_shapes_dtypes_and_spaces,
        contract.test_truncation_is_not_termination,
        contract.test_auto_reset_keeps_the_final_observation_and_never_repeats_a_layout,
        contract.test_a_resampled_layout_differs_only_where_needed,
    ],
)
def test_it_keeps_the_contract(check: Any) -> None:
    check(ring())


def test_its_layouts_are_checked() -> None:
    ring().check_layout(np.array([1, 2, 3]))
    with pytest.raises(ValueError, match=r"cells \[1, 1, 2\]"):
        ring().check_layout(np.array([1, 1, 2]))


SMALL = {
    "num_envs": 8,
    "num_steps": 16,
    "group": 8,
    "low.optimiser.minibatches": 2,
    "network.latent": 16,
    "network.encoder_mlp": (16,),
    "curriculum.tasks_per_level": 16,
    "curriculum.max_nodes": 6,
}


@pytest.mark.slow
def test_the_rest_of_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """With fewer steps and smaller sizes."""
    names = {**world(), "SMALL": SMALL}
    for block in BLOCKS[1:]:
        short = block.replace("500_000", "1, changes=SMALL")
        exec(compile(short, str(PAGE), "exec", dont_inherit=True), names)
    subtask, success = capsys.readouterr().out.splitlines()
    assert subtask == "('achieve red',)"
    assert 0 <= float(success) <= 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Brax System", "ignore:Accessing `.*` directly from `Data`:DeprecationWarning")
@pytest.mark.parametrize(
    ("needs", "world", "train"),
    [("gymnax", ROOMS, TRAIN_ROOMS), ("brax", REACHER, TRAIN_REACHER)],
    ids=["gymnax", "brax"],
)
def test_worlds_of_others_are_trained(needs: str, world: str, train: str, capsys: pytest.CaptureFixture[str]) -> None:
    """As the page has it, with fewer steps and smaller sizes."""
    pytest.importorskip(needs)
    names: dict[str, Any] = {
        "__name__": "other_environments",
        "SMALL": {**SMALL, "num_steps": 64},
        "hrlspec": hrlspec,
        "jax": jax,
    }
    short = re.sub(r"total_steps=[\d_]+", "total_steps=1, changes=SMALL", train)
    # What brax says of what it does not find, and of what it imports.
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings(action="ignore"):
        exec(compile(world, str(OTHERS), "exec", dont_inherit=True), names)
    exec(compile(short.replace("episodes=100", "episodes=10"), str(OTHERS), "exec", dont_inherit=True), names)
    assert re.fullmatch(r"success [01]\.\d{3}", capsys.readouterr().out.splitlines()[-1])
