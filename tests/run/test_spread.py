"""How many devices runs get, and whether seeds train side by side: what is faster, unless something else is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hrlspec.run import spread as module
from hrlspec.run.errors import UserError
from hrlspec.run.hosts import ALONE
from hrlspec.run.run_flags import RunFlags
from hrlspec.run.spread import Spread, spread

PARALLEL, ALONE_EACH = {"parallel_seeds": True}, {"no_parallel_seeds": True}


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes this machine one of so many cores, or accelerators."""

    def of(cores: int, accelerators: int = 0) -> None:
        def prepare(host_devices: int) -> None:
            there = accelerators or host_devices
            monkeypatch.setattr(module, "num_devices", lambda: there)

        monkeypatch.setattr(module.platform, "prepare", prepare)
        monkeypatch.setattr(module.platform, "cores", lambda: list(range(cores)))
        monkeypatch.setattr(module.jax, "default_backend", lambda: "gpu" if accelerators else "cpu")

    return of


def chosen(number: int, folder: Path = Path("nowhere"), **flags: Any) -> Spread:
    """For so many seeds of a run of two blocks."""
    given = RunFlags(num_seeds=number, **flags)
    return spread(given, 2, [folder / f"seed{seed}" for seed in range(number)], ALONE)


@pytest.mark.parametrize(
    ("cores", "number", "flags", "expected"),
    [
        (2, 1, {}, Spread(False, 2)),
        (2, 4, {}, Spread(True, 2)),
        (2, 3, {}, Spread(False, 2)),  # which do not share the cores evenly
        (1, 4, {}, Spread(False, 1)),
        (16, 10, {}, Spread(True, 10)),
        (16, 3, {}, Spread(True, 3)),
        (2, 4, ALONE_EACH, Spread(False, 2)),
        (2, 3, PARALLEL, Spread(True, 1)),
        (1, 4, PARALLEL, Spread(True, 1)),
        (4, 4, {"devices": 2}, Spread(True, 2)),
        (4, 4, {"devices": 1}, Spread(False, 1)),
        (4, 4, PARALLEL | {"devices": 4}, Spread(True, 4)),
        (4, 4, PARALLEL | {"devices": 1}, Spread(True, 1)),
    ],
)
def test_on_a_processor(machine: Any, cores: int, number: int, flags: dict[str, Any], expected: Spread) -> None:
    machine(cores)
    assert chosen(number, **flags) == expected


@pytest.mark.parametrize(
    ("accelerators", "number", "flags", "expected"),
    [
        (1, 1, {}, Spread(False, 1)),
        (1, 3, {}, Spread(True, 1)),
        (2, 3, {}, Spread(True, 1)),
        (2, 4, {}, Spread(True, 2)),
        (2, 4, ALONE_EACH, Spread(False, 2)),
    ],
)
def test_on_accelerators(machine: Any, accelerators: int, number: int, flags: dict[str, Any], expected: Spread) -> None:
    machine(8, accelerators)
    assert chosen(number, **flags) == expected


def test_what_is_left_of_them_shares_what_it_can(machine: Any) -> None:
    machine(6)
    given = RunFlags(num_seeds=6, parallel_seeds=True, devices=3)
    left = [Path(f"nowhere/seed{seed}") for seed in range(4)]
    assert spread(given, 2, left, ALONE) == Spread(True, 2)
    assert spread(given, 2, left[:1], ALONE) == Spread(False, 2)
    assert not spread(given, 2, [], ALONE).side_by_side


def test_what_there_is_not_is_refused(machine: Any) -> None:
    machine(8, 1)
    with pytest.raises(UserError, match="--devices is 2, but JAX has 1"):
        chosen(2, devices=2)


def checkpoints(folder: Path, *steps: list[int]) -> None:
    for seed, some in enumerate(steps):
        for step in some:
            (folder / f"seed{seed}" / "checkpoints" / f"step_{step:012d}").mkdir(parents=True)


@pytest.mark.parametrize(
    ("steps", "common"), [(([80, 160], [80]), 80), (([80, 160], [80, 160]), 160), (([], []), None)]
)
def test_seeds_go_on_from_the_newest_checkpoint_that_all_have(
    machine: Any, tmp_path: Path, steps: Any, common: int | None
) -> None:
    machine(2)
    checkpoints(tmp_path, *steps)
    assert chosen(2, tmp_path) == Spread(True, 2, common)


@pytest.mark.parametrize(
    ("steps", "where"), [(([80], [160]), "0 at step 80, {}1 at step 160"), (([80], []), "0 at step 80, {}1 at step 0")]
)
def test_seeds_that_stand_apart_go_on_alone(machine: Any, tmp_path: Path, steps: Any, where: str) -> None:
    machine(2)
    checkpoints(tmp_path, *steps)
    assert chosen(2, tmp_path) == Spread(False, 2)
    with pytest.raises(UserError) as refused:
        chosen(2, tmp_path, **PARALLEL)
    seed = f"{tmp_path}/seed"
    said = f"no step has a checkpoint of each seed ({seed}{where.format(seed)}): "
    assert str(refused.value) == said + "--no-parallel-seeds goes on with each alone"
