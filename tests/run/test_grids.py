"""Grids of settings: what the flags say, and what they are refused for."""

from __future__ import annotations

import pytest

from hrlspec.run.errors import UserError
from hrlspec.run.grids import cell_name, cells_of, check_shared, flags_of, grid_of, seeds_of, short_names
from hrlspec.run.run_flags import experiments_of, parse_run


def test_all_combinations() -> None:
    grid = grid_of(["config.num-envs=64,128", "--recipe=paper,hrlspec"])
    assert [*map(dict, cells_of(grid))] == [
        {"config.num_envs": "64", "recipe": "paper"},
        {"config.num_envs": "64", "recipe": "hrlspec"},
        {"config.num_envs": "128", "recipe": "paper"},
        {"config.num_envs": "128", "recipe": "hrlspec"},
    ]
    assert cells_of({}) == [{}]


def test_seeds() -> None:
    assert seeds_of("3") == [3]
    assert seeds_of("0,2, 7-9") == [0, 2, 7, 8, 9]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "found ''"),
        ("a", "found 'a'"),
        ("-1", "found '-1'"),
        ("4-2", "found '4-2'"),
        ("0-2,2", "a seed twice"),
        ("9999999999", "expected seeds up to 2147483647"),
        ("0-9999999999", "expected seeds up to 2147483647"),
        ("0-999999999", "expected at most 10000 seeds in a range"),
    ],
)
def test_bad_seeds(text: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        seeds_of(text)


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        (["config.num_envs"], "expected SETTING=VALUE,VALUE"),
        (["=1"], "expected SETTING=VALUE,VALUE"),
        (["config num=1"], "expected SETTING=VALUE,VALUE"),
        (["seed=1,2"], "seeds are given by --seeds"),
        (["num-seeds=3"], "seeds are given by --seeds"),
        (["--out=a"], "folders by --out"),
        (["recipe=paper", "recipe=hrlspec"], "recipe is in the grid already"),
        (["recipe=paper,paper"], "a value twice"),
    ],
)
def test_bad_grids(axes: list[str], said: str) -> None:
    with pytest.raises(UserError, match=said):
        grid_of(axes)


def test_flags_of_all_runs_are_not_the_grids() -> None:
    grid = grid_of(["config.num_envs=64,128"])
    check_shared(["--env", "letter", "--config.low.clip=0.1", "seed"], grid)
    for flag in ("--config.num-envs", "--config.num_envs=64"):
        with pytest.raises(UserError, match="in the grid too"):
            check_shared([flag], grid)
    for flag in ("--seed", "--resume", "--num-seeds=3", "--out"):
        with pytest.raises(UserError, match="among the flags of all runs"):
            check_shared([flag], grid)


def test_names_are_short_where_that_is_clear() -> None:
    grid = grid_of(["config.low.optimiser.epochs=1", "config.num_envs=64", "config.shield.optimiser.epochs=1"])
    names = short_names(grid)
    assert names["config.num_envs"] == "num_envs"
    (cell,) = cells_of(grid)
    assert cell_name(cell, names) == "config.low.optimiser.epochs=1,num_envs=64,config.shield.optimiser.epochs=1"
    assert cell_name({"env": "my/module:make"}, {"env": "env"}) == "env=my_module:make"


def test_switches_and_tuples() -> None:
    cell = {"config.network.actor": "32 16", "no_shield": "true", "config.network.symmetric": "false"}
    words = flags_of(cell, ["--env", "letter"])
    assert words == [
        "--env", "letter", "--config.network.actor", "32", "16", "--no_shield", "--config.network.no-symmetric",
    ]  # fmt: skip
    ((experiment, _),) = experiments_of(parse_run(words))
    assert experiment.config.network.actor == (32, 16)
    assert not experiment.config.shield.enabled
    assert not experiment.config.network.symmetric
    # What is so already takes no flag; what is no switch is left to the parser of flags, which refuses it.
    assert flags_of({"no_shield": "false", "config.network.symmetric": "true"}, []) == []
    assert flags_of({"config.num_envs": "true"}, []) == ["--config.num_envs", "True"]
    assert flags_of({"no_such": "true"}, []) == ["--no_such", "True"]
