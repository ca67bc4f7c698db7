"""The test sets: as the sampler draws them, by the rules, distinct and reserved."""

from __future__ import annotations

import itertools
import shutil

import numpy as np
import pytest

import envs_jax
from hrlspec.evaluation import suite_from_text
from hrlspec.presets import suites
from hrlspec.presets.suites import FOLDER, RECIPES, generate, load_suite, reserved_hashes, suite_names
from hrlspec.run.errors import UserError
from hrlspec.spec import task_hashes
from hrlspec.tasks.sampling import sample_trees

ALL = [(env_name, name) for env_name in RECIPES for name in RECIPES[env_name]]


@pytest.mark.parametrize("env_name", RECIPES)
def test_the_files_are_what_the_generator_draws(env_name):
    for name, text in generate(env_name).items():
        assert (FOLDER / env_name / f"{name}.txt").read_bytes() == text.encode(), name


def _tree(env_name: str, name: str, row: int) -> dict[int, tuple[int, frozenset[int], frozenset[int]]]:
    """Edges of one task: node -> (parent, reach, avoid)."""
    trees = load_suite(env_name, name).trees
    return {
        int(node): (
            int(trees.parent[row, node]),
            frozenset(np.flatnonzero(trees.reach[row, node]).tolist()),
            frozenset(np.flatnonzero(trees.avoid[row, node]).tolist()),
        )
        for node in np.flatnonzero(trees.valid[row] & (trees.parent[row] >= 0))
    }


def _paths(edges: dict[int, tuple[int, frozenset[int], frozenset[int]]]) -> list[int]:
    """Lengths of the ways from the root to the leaves."""

    def up(node: int) -> int:
        return 0 if node == 0 else 1 + up(edges[node][0])

    return [up(node) for node in edges if node not in {parent for parent, _, _ in edges.values()}]


def _asks_for_green_after_blue(edges: dict[int, tuple[int, frozenset[int], frozenset[int]]]) -> list[bool]:
    """Of the ways from the root to the leaves; colours are numbered in alphabetical order."""

    def colours(node: int) -> list[int]:
        return [*colours(edges[node][0]), *edges[node][1]] if node else []

    ways = [colours(node) for node in edges if node not in {parent for parent, _, _ in edges.values()}]
    return [0 in way and 1 in way[way.index(0) :] for way in ways]


def _children(edges: dict[int, tuple[int, frozenset[int], frozenset[int]]], node: int) -> int:
    return sum(parent == node for parent, _, _ in edges.values())


@pytest.mark.parametrize(("env_name", "name"), ALL)
def test_rules(env_name, name):
    suite = load_suite(env_name, name)
    assert len(suite) == 200
    fewest, most = {"reach_avoid_6": (1, 2), "reach_avoid": (1, 2), "reach_12": (0, 0), "reach": (0, 0)}.get(
        name, (0, 2)
    )
    several = 0
    for row in range(200):
        edges = _tree(env_name, name, row)
        assert len(edges) < 16
        for parent, reach, avoid in edges.values():
            before = edges[parent][1] if parent else frozenset()
            assert len(reach) == 1
            assert fewest <= len(avoid) <= most
            assert not avoid & reach
            assert not avoid & before
            assert reach != before
        for one, other in itertools.combinations(edges.values(), 2):
            assert one[0] != other[0] or one[1] != other[1], "siblings reach the same"
        paths, root = _paths(edges), _children(edges, 0)
        assert max(paths) == suite.depths[row]
        several += len(paths) > 1
        match name:
            case "dag" | "order":
                assert min(paths) >= 2
                assert max(paths) <= 4
                assert max(_children(edges, node) for node in [0, *edges]) <= 3
            case "deeper":
                assert set(paths) == {5}
                assert max(_children(edges, node) for node in [0, *edges]) <= 3
            case "wider":
                assert root == 4
                assert min(paths) >= 2
                assert max(paths) <= 4
            case "branches":
                assert root in (2, 3)
                assert 2 <= max(paths) <= 4
            case "reach_avoid_6":
                assert paths == [6]
            case "reach_12":
                assert paths == [12]
            case "reach_avoid" | "reach":
                assert len(paths) == 1
            case _:
                pytest.fail(f"no rules for {name}")
        if env_name == "zone-nm":
            spoilt = _asks_for_green_after_blue(edges)
            assert not all(spoilt)
            assert any(spoilt) or name != "order"
    assert several >= (0 if name.startswith("reach") else 100)
    depths = dict(zip(*np.unique(suite.depths, return_counts=True), strict=True))
    if name in ("dag", "order", "wider", "branches"):
        assert depths == ({2: 100, 3: 100} if env_name.startswith("zone") else {2: 66, 3: 67, 4: 67})
    if name in ("reach_avoid", "reach"):
        assert depths == dict.fromkeys(range(2, 7) if name == "reach_avoid" else range(4, 13, 2), 40)


def _canonical(edges: dict[int, tuple[int, frozenset[int], frozenset[int]]], node: int = 0) -> tuple:
    below = [
        (tuple(sorted(reach)), tuple(sorted(avoid)), _canonical(edges, child))
        for child, (parent, reach, avoid) in edges.items()
        if parent == node
    ]
    return tuple(sorted(below))


@pytest.mark.parametrize("env_name", RECIPES)
def test_no_task_twice_and_all_of_them_reserved(env_name):
    names = suite_names(env_name)
    assert len({_canonical(_tree(env_name, name, row)) for name in names for row in range(200)}) == 200 * len(names)
    hashes = np.concatenate([load_suite(env_name, name).hashes for name in names])
    assert len(set(hashes.tolist())) == 200 * len(names)
    reserved = reserved_hashes(env_name)
    assert reserved.dtype == np.uint32
    # What is kept in the file is still in force, or every run would compile all formulas at its start.
    assert (FOLDER / env_name / "reserved.hex").read_text().split()[0] == suites._fingerprint(env_name)
    np.testing.assert_array_equal(reserved, np.sort(hashes))


def test_samplers_reject_what_is_reserved():
    drawn = sample_trees(
        np.random.default_rng(0),
        num_tasks=20_000,
        num_propositions=5,
        max_nodes=16,
        min_depth=2,
        max_depth=2,
        max_branching=1,
        max_avoid=1,
    )
    reserved = np.sort(task_hashes(drawn)[:40])
    again = sample_trees(
        np.random.default_rng(0),
        num_tasks=2_000,
        num_propositions=5,
        max_nodes=16,
        min_depth=2,
        max_depth=2,
        max_branching=1,
        max_avoid=1,
        reserved=reserved,
    )
    assert np.isin(task_hashes(drawn), reserved).sum() > 40
    assert not np.isin(task_hashes(again), reserved).any()


def test_reserved_hashes_follow_the_files(tmp_path, monkeypatch):
    shutil.copytree(FOLDER, tmp_path / "suites")
    monkeypatch.setattr(suites, "FOLDER", tmp_path / "suites")
    path = tmp_path / "suites" / "letter" / "dag.txt"
    path.write_text("achieve a; achieve b; achieve a; achieve b\n")
    load_suite.cache_clear()
    reserved_hashes.cache_clear()
    try:
        added = suite_from_text("one", path.read_text(), envs_jax.make("letter").propositions).hashes
        reserved = reserved_hashes("letter")
        assert np.isin(added, reserved).all()
        assert len(reserved) == 601
        path.unlink()
        reserved_hashes.cache_clear()
        with pytest.raises(UserError, match=r"cannot read .*dag\.txt.*python -m experiments\.suites"):
            reserved_hashes("letter")
    finally:
        load_suite.cache_clear()
        reserved_hashes.cache_clear()


def test_unknown_suites():
    with pytest.raises(UserError, match=r"unknown suite 'dga' of 'letter'; expected one of: dag, deeper"):
        load_suite("letter", "dga")
    with pytest.raises(UserError, match="there is none for this environment"):
        load_suite("desert", "dag")
    assert reserved_hashes("desert").shape == (0,)
    assert suite_names("desert") == ()


def test_check_says_what_is_not_as_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(suites, "FOLDER", tmp_path)
    monkeypatch.setattr(suites, "RECIPES", {"letter12": {"reach_12": RECIPES["letter12"]["reach_12"]}})
    monkeypatch.setattr("sys.argv", ["suites"])
    suites.main()
    assert "written: " in capsys.readouterr().out
    path = tmp_path / "letter12" / "reach_12.txt"
    assert path.read_bytes() == (FOLDER / "letter12" / "reach_12.txt").read_bytes()
    monkeypatch.setattr("sys.argv", ["suites", "--check"])
    suites.main()
    assert "as drawn: " in capsys.readouterr().out
    path.write_text("achieve a\n")
    with pytest.raises(UserError, match=r"reach_12\.txt is not what the sampler draws"):
        suites.main()
