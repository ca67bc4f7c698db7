"""Agents in files: what is written is what is read, and whoever may not use it is told so."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import hrlspec
from hrlspec.agent_files import read_agent
from hrlspec.methods import METHODS, ImplicitPlanner
from hrlspec.run.commands import evaluate, export, run
from hrlspec.run.errors import main_guard
from hrlspec.run.folder import open_run
from hrlspec.run.run_flags import experiments_of, parse_run
from tests.agent_files.made import same, write_tiny
from tests.run import tiny


@pytest.mark.parametrize(("method", "recipe"), [*((name, "hrlspec") for name in METHODS), ("ours", "paper")])
def test_what_is_written_is_read(method: str, recipe: str, tmp_path: Path) -> None:
    planner = tiny.PLANNER if isinstance(METHODS[method].high, ImplicitPlanner) else []
    flags = ["--method", method, "--recipe", recipe, "--reward-set", "2", "--seed", "7"]
    ((experiment, _),) = experiments_of(parse_run([*tiny.FLAGS, *planner, *flags]))
    params = write_tiny(tmp_path / "it.safetensors", experiment)
    shielded = recipe == "paper"  # else nothing would have trained the reach critic
    assert experiment.config.shield.enabled == shielded
    trained = hrlspec.pretrained(tmp_path / "it.safetensors")
    assert trained.agent == experiment.agent
    assert trained.params.keys() == {"low", "high"} | ({"reach_critic"} if shielded else set())
    assert same(trained.params, {name: params[name] for name in trained.params})
    assert same(trained.rewards, experiment.rewards)
    file = read_agent(tmp_path / "it.safetensors")
    assert (file.preset.name, file.reward_set, file.seed) == ("letter", 2, 7)
    assert file.card.sha256 == hashlib.sha256((tmp_path / "it.safetensors").read_bytes()).hexdigest()


def test_writing_again_gives_the_same_files(tmp_path: Path) -> None:
    write_tiny(tmp_path / "it.safetensors")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    write_tiny(tmp_path / "it.safetensors")
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


REFUSED: list[tuple[Sequence[str], str]] = [
    (("--env", "letter12"), "--from it.safetensors has env = 'letter', not 'letter12'"),
    (("--method", "no-er"), "--from it.safetensors has method = 'ours', not 'no-er'"),
    (("--config.network.actor", "9"), "--from it.safetensors has config.network.actor = [8], not [9]"),
    (("--config.network.task-scale", "2"), "--from it.safetensors has config.network.task_scale = "),
    (("--method.high.network.rounds", "3"), "has method_settings.high.network.rounds = 0, not 3"),
    (("--resume",), "there is no run to resume in "),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with an agent in a file, and two run folders without any checkpoint."""
    folder = tmp_path_factory.mktemp("place")
    write_tiny(folder / "it.safetensors")
    for name, env in (("begun", "letter"), ("foreign", "envs_jax:Letter")):
        ((experiment, path),) = experiments_of(parse_run(["--env", env, "--out", str(folder / name)]))
        with open_run(path, experiment, tensorboard=False):
            pass
    return folder


def check_refused(
    main: Callable[..., None], flags: Sequence[str], message: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line that says so, status 2, nothing written."""
    before = sorted(place.rglob("*"))
    assert main_guard(lambda: main(flags)) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert sorted(place.rglob("*")) == before


@pytest.mark.parametrize(("flags", "message"), REFUSED, ids=[" ".join(flags) for flags, _ in REFUSED])
def test_what_does_not_fit_is_not_trained_on(
    flags: Sequence[str],
    message: str,
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(place)
    argv = tiny.arguments(Path("run"), "--from", "it.safetensors", *flags)
    check_refused(run.main, argv, message, place, capsys)


BAD_FLAGS: list[tuple[Sequence[str], str]] = [
    (("evaluate", "--spec", "achieve a"), "expected exactly one of --run and --pretrained, found none"),
    (("evaluate", "--run", "begun", "--pretrained", "it.safetensors", "--spec", "achieve a"), "found both"),
    (("evaluate", "--pretrained", "it.safetensors", "--step", "5", "--spec", "achieve a"), "--step goes with --run"),
    (("evaluate", "--pretrained", "it.safetensors", "--suite", "cats"), "unknown suite 'cats' of 'letter'"),
    (("evaluate", "--pretrained", "it.safetensors", "--spec", "achieve z"), "z"),
    (("evaluate", "--pretrained", "it.safetensors", "--spec", "achieve a", "--shield"), "--shield needs the reach cri"),
    (("evaluate", "--pretrained", "it.safetensors", "--ltl", "F a", "--shield"), "--shield needs the reach critic"),
    (("evaluate", "--pretrained", "chess", "--spec", "achieve a"), "expected one of the packaged agents ("),
    (("export", "--run", "nowhere"), "nowhere is not a run folder"),
    (("export", "--run", "begun"), "no checkpoint in begun"),
    (("export", "--run", "begun", "--out", "it"), "it.safetensors is there already; choose another --out"),
    (("export", "--run", "begun", "--out", "it.json"), "it.safetensors is there already; choose another --out"),
    (("export", "--run", "begun", "--out", "it.json/x"), "it.json is a file, not a folder"),
    (("export", "--run", "begun", "--tasks", "0"), "--tasks is 0"),
    (("export", "--run", "foreign"), "agents are exported whose environment and method are hrlspec's own"),
]


@pytest.mark.parametrize(("argv", "message"), BAD_FLAGS, ids=[" ".join(argv) for argv, _ in BAD_FLAGS])
def test_bad_flags(
    argv: Sequence[str], message: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    command, *flags = argv
    check_refused({"evaluate": evaluate.main, "export": export.main}[command], flags, message, place, capsys)


def test_without_the_library(place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "safetensors", None)
    monkeypatch.setitem(sys.modules, "safetensors.numpy", None)
    with pytest.raises(ImportError, match=r'pip install "hrlspec\[files\]"'):
        hrlspec.pretrained(place / "it.safetensors")
    flags = ["--pretrained", str(place / "it.safetensors"), "--spec", "achieve a"]
    assert main_guard(lambda: evaluate.main(flags)) == 2
    assert 'agents in files need the extra "files"' in capsys.readouterr().err


def test_a_card_is_json_that_says_what_the_agent_is(place: Path) -> None:
    card = json.loads((place / "it.json").read_text())
    assert (card["format"], card["file"], card["licence"]) == (1, "it.safetensors", "Apache-2.0")
    assert (card["config"]["env"], card["config"]["method"], card["config"]["recipe"]) == ("letter", "ours", "hrlspec")
    assert {"hrlspec", "jax", "python"} <= card["trained"]["versions"].keys()
