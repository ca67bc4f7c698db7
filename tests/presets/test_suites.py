"""The test sets: as the sampler draws them, by the rules, distinct and reserved."""

from __future__ import annotations

import dataclasses
import itertools
import shutil

import numpy as np
import pytest

from hrlspec.evaluation import suite_from_text
from hrlspec.presets import PRESETS, Preset, preset, suites
from hrlspec.presets.demos import ROOMS
from hrlspec.presets.suites import FOLDER, SuiteError, hashes_text, packaged_suite, suite_texts
from hrlspec.run.commands import suites as command
from hrlspec.run.errors import UserError
from hrlspec.spec import task_hashes
from hrlspec.tasks.sampling import sample_trees

ALL = [(some.name, name) for some in PRESETS.values() for name in some.suites]


def propositions(some: Preset) -> tuple[str, ...]:
    return some.make().propositions


QUICK = ("letter12", "zone-nm")
"""Worlds whose suites are drawn anew by default: of sequences, of trees, and of trees where a colour vanishes."""


@pytest.mark.parametrize(
    "some",
    [pytest.param(some, id=name, marks=() if name in QUICK else pytest.mark.slow) for name, some in PRESETS.items()],
)
def test_the_files_are_what_the_generator_draws(some):
    for name, text in suite_texts(some.name, some.suites, propositions(some)).items():
        assert (FOLDER / some.name / f"{name}.txt").read_bytes() == text.encode(), name


def _tree(env_name: str, name: str, row: int) -> dict[int, tuple[int, frozenset[int], frozenset[int]]]:
    """Edges of one task: node -> (parent, reach, avoid)."""
    trees = preset(env_name).suite(name).trees
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


VANISHING = {"zone-nm": (0, 1), "zone-nm-jaxolotl": (2, 1)}
"""Worlds where green is gone after blue, or after purple: the numbers of both."""


def _asks_in_vain(edges: dict[int, tuple[int, frozenset[int], frozenset[int]]], first: int, second: int) -> list[bool]:
    """Whether the second is asked for after the first, of the ways from the root to the leaves."""

    def colours(node: int) -> list[int]:
        return [*colours(edges[node][0]), *edges[node][1]] if node else []

    ways = [colours(node) for node in edges if node not in {parent for parent, _, _ in edges.values()}]
    return [first in way and second in way[way.index(first) :] for way in ways]


def _children(edges: dict[int, tuple[int, frozenset[int], frozenset[int]]], node: int) -> int:
    return sum(parent == node for parent, _, _ in edges.values())


@pytest.mark.parametrize(("env_name", "name"), ALL)
def test_rules(env_name, name):
    suite = preset(env_name).suite(name)
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
        match name.removesuffix("_validation"):
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
        if env_name in VANISHING:
            spoilt = _asks_in_vain(edges, *VANISHING[env_name])
            assert not all(spoilt)
            assert any(spoilt) or name != "order"
    assert several >= (0 if name.startswith("reach") else 100)
    depths = dict(zip(*np.unique(suite.depths, return_counts=True), strict=True))
    if name.removesuffix("_validation") in ("dag", "order", "wider", "branches"):
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


@pytest.mark.parametrize("some", PRESETS.values(), ids=PRESETS)
def test_no_task_twice_and_all_of_them_reserved(some, monkeypatch):
    names = some.suite_names
    number = 200 * len(names)
    assert len({_canonical(_tree(some.name, name, row)) for name in names for row in range(200)}) == number
    hashes = np.concatenate([some.suite(name).hashes for name in names])
    assert len(set(hashes.tolist())) == number
    assert some.reserved.dtype == np.uint32
    # What is kept in the file is still in force, or every run would compile all formulas at its start, as done above.
    monkeypatch.setattr(suites, "suite_from_text", lambda name, *_: some.suite(name))
    assert (FOLDER / some.name / "reserved.hex").read_text() == hashes_text(some.name, names, propositions(some))
    np.testing.assert_array_equal(some.reserved, np.sort(hashes))


@pytest.mark.parametrize("some", PRESETS.values(), ids=PRESETS)
def test_what_is_validated_on_is_not_what_is_tested_on(some):
    """And nothing is in both: see above."""
    assert some.suite_for("test").name == "dag"
    assert some.suite_for("validation").name == "dag_validation"
    foreign = dataclasses.replace(some, suites={}, texts={"dag": "achieve a; achieve b"})
    assert foreign.suite_names == ("dag",)
    if "a" in propositions(some):
        assert foreign.suite_for("validation").formulas == foreign.suite_for("test").formulas


def test_samplers_reject_what_is_reserved():
    drawn = sample_trees(
        np.random.default_rng(0),
        num_tasks=2_000,
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


@pytest.fixture
def no_memory():
    """Suites are read again, before and after."""
    for known in (suites.packaged_suite, suites.packaged_hashes):
        known.cache_clear()
    yield
    for known in (suites.packaged_suite, suites.packaged_hashes):
        known.cache_clear()


@pytest.mark.usefixtures("no_memory")
def test_reserved_hashes_follow_the_files(tmp_path, monkeypatch):
    shutil.copytree(FOLDER, tmp_path / "suites")
    monkeypatch.setattr(suites, "FOLDER", tmp_path / "suites")
    path = tmp_path / "suites" / "zone-ltl2action" / "dag.txt"
    path.write_text("achieve blue; achieve red; achieve blue; achieve red\n")
    zone = dataclasses.replace(preset("zone-ltl2action"))  # which remembers nothing
    added = suite_from_text("one", path.read_text(), propositions(zone)).hashes
    assert np.isin(added, zone.reserved).all()
    assert len(zone.reserved) == 201
    path.unlink()
    suites.packaged_hashes.cache_clear()
    with pytest.raises(SuiteError, match=r"cannot read .*dag\.txt.*hrlspec suites"):
        _ = dataclasses.replace(zone).reserved


def test_unknown_suites():
    with pytest.raises(SuiteError, match=r"unknown suite 'dga' of 'letter'; expected one of: dag, deeper"):
        preset("letter").suite("dga")
    with pytest.raises(SuiteError, match="there is none for it"):
        ROOMS.suite("dag")
    assert ROOMS.reserved.shape == (0,)
    assert ROOMS.suite_names == ()


def test_suites_that_a_preset_brings_along():
    text = "achieve blue; achieve red # a comment\nachieve red\n"
    rooms = dataclasses.replace(ROOMS, texts={"mine": text})
    assert rooms.suite_names == ("mine",)
    assert rooms.suite("mine").formulas == ("achieve blue; achieve red", "achieve red")
    # A task of one sub-task can be trained on all the same.
    np.testing.assert_array_equal(rooms.reserved, rooms.suite("mine").hashes[:1])


@pytest.mark.usefixtures("no_memory")
def test_the_command_writes_and_checks(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(suites, "FOLDER", tmp_path)
    twelve = preset("letter12")
    short = dataclasses.replace(twelve, suites={"reach_12": twelve.suites["reach_12"]})
    monkeypatch.setattr(command, "PRESETS", {"letter12": short})
    command.main([])
    assert "written: " in capsys.readouterr().out
    path = tmp_path / "letter12" / "reach_12.txt"
    # Without the suites before it nothing else is drawn: their tasks are only left out.
    assert path.read_bytes() == (FOLDER / "letter12" / "reach_12.txt").read_bytes()
    packaged = packaged_suite("letter12", "reach_12", propositions(twelve))
    np.testing.assert_array_equal(short.reserved, np.sort(packaged.hashes))
    command.main(["--check"])
    assert "as drawn: " in capsys.readouterr().out
    path.write_text("achieve a\n")
    with pytest.raises(UserError, match=r"reach_12\.txt is not what the sampler draws.*`hrlspec suites`"):
        command.main(["--check"])
