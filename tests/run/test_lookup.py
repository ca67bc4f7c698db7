"""Environments and methods by name, or anybody's as ``module:attribute``."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest

from envs_jax import Walk
from hrlspec.methods import METHODS
from hrlspec.presets import PRESETS
from hrlspec.run.errors import UserError
from hrlspec.run.lookup import method_named, preset_named

MODULE = """
import dataclasses
from typing import Any
from envs_jax import Walk
from envs_jax.rooms.world import Rooms
from hrlspec.methods import OURS
from hrlspec.presets import Preset

VALUE = Walk(horizon=7)

class Group:
    inner = Walk

def make():
    return Walk(horizon=8)

def wrong():
    return {}

def broken():
    raise RuntimeError("the file\\n  is gone")

@dataclasses.dataclass(frozen=True)
class Unhashable(Walk):
    sizes: Any = dataclasses.field(default_factory=list)

@dataclasses.dataclass(frozen=True)
class Odd(Rooms):
    propositions = ("blue", "red ball")

METHOD = OURS.replace(transe=0.5)

PRESET = Preset("mine", make, texts={"dag": "achieve a; achieve b"})

MAKES_NOTHING = Preset("nothing", dict)

FAILS = Preset("fails", broken)

LISTS = Preset("lists", Unhashable)
"""


@pytest.fixture(scope="module")
def name(tmp_path_factory: pytest.TempPathFactory) -> str:
    return f"module_{tmp_path_factory.mktemp('lookup').name.replace('-', '_')}"


@pytest.fixture(autouse=True)
def here(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A current directory that Python does not search by itself, with a module."""
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])


def test_the_library_s_own() -> None:
    assert {name: preset_named(name) for name in PRESETS} == PRESETS
    assert {name: method_named(name) for name in METHODS} == METHODS


def test_a_value_a_class_and_a_function(name: str) -> None:
    assert preset_named(f"{name}:VALUE").make() == Walk(horizon=7)
    assert preset_named(f"{name}:make").make() == Walk(horizon=8)
    assert preset_named(f"{name}:Group.inner").make() == Walk()
    assert preset_named(f"{name}:make") is preset_named(f"{name}:make")  # made once, so compiled once
    assert dataclasses.asdict(method_named(f"{name}:METHOD"))["high"]["transe"] == 0.5


def test_a_preset(name: str) -> None:
    mine = preset_named(f"{name}:PRESET")
    assert mine.make() == Walk(horizon=8)
    assert (mine.name, mine.suite_names) == ("mine", ("dag",))


@pytest.mark.parametrize(
    ("attribute", "message"),
    [
        ("nothing", "cannot be used: AttributeError: module '.*' has no attribute 'nothing'"),
        ("wrong", "is of type dict, expected an environment that keeps the contract"),
        ("broken", "cannot be used: RuntimeError: the file is gone"),
        ("METHOD", "is of type Ours, expected an environment"),
        ("Unhashable", "cannot be used: TypeError: unhashable type"),
        ("MAKES_NOTHING", "makes a value of type dict, expected an environment"),
        ("FAILS", "cannot be used: RuntimeError: the file is gone"),
        ("LISTS", "cannot be used: TypeError: unhashable type"),
        ("Odd", "tasks cannot name the proposition 'red ball': line 1, column 13"),
    ],
)
def test_what_is_no_environment(name: str, attribute: str, message: str) -> None:
    with pytest.raises(UserError, match=message) as error:
        preset_named(f"{name}:{attribute}")
    assert str(error.value).startswith(f"{name}:{attribute}")


def test_what_is_no_method(name: str) -> None:
    with pytest.raises(UserError, match="is of type Walk, expected a value of a subclass of"):
        method_named(f"{name}:VALUE")


def test_a_module_that_fails(tmp_path: Path) -> None:
    (tmp_path / "needs_more.py").write_text("import more_than_there_is\n")
    with pytest.raises(UserError, match="needs_more:x cannot be used: ModuleNotFoundError: No module named 'more_than"):
        preset_named("needs_more:x")
