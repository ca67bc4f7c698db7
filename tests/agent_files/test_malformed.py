"""Files of agents that are damaged, forged, or of another version: refused in one line, and nothing is executed."""

from __future__ import annotations

import json
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hrlspec.agent_files import AgentFileError, read_agent, read_params
from hrlspec.config import Config
from hrlspec.run.commands import evaluate, run
from hrlspec.run.errors import main_guard
from tests.agent_files.made import Draft, write_tiny
from tests.run import tiny

Change = Callable[[Draft], object]


def card(**entries: Any) -> Change:
    """Entries of the card replaced; ``...`` takes one away."""

    def change(draft: Draft) -> None:
        draft.card = {name: value for name, value in (draft.card | entries).items() if value is not ...}
        draft.write()

    return change


def setting(name: str, value: Any) -> Change:
    """A setting replaced, by its dotted name; ``...`` takes it away."""

    def change(draft: Draft) -> None:
        *place, last = name.split(".")
        settings = draft.card["config"]
        for part in place:
            settings = settings[part]
        if value is ...:
            del settings[last]
        else:
            settings[last] = value
        draft.write()

    return change


def card_text(text: Callable[[Draft], str | bytes]) -> Change:
    return lambda draft: draft.write(card=text(draft))


def content(make: Callable[[Draft], bytes]) -> Change:
    """Another file of parameters, whose SHA-256 is in the card."""
    return lambda draft: draft.write(make(draft))


def leaf(make: Callable[[np.ndarray], np.ndarray]) -> Change:
    """One leaf replaced."""

    def change(draft: Draft) -> None:
        draft.leaves[draft.some] = np.ascontiguousarray(make(draft.leaves[draft.some]))
        draft.write()

    return change


def header(entry: Any, body: bytes = b"0000") -> Change:
    """A file of one leaf, described in any way."""
    return content(lambda draft: draft.with_header({draft.some: entry}, body))


def without_a_leaf(draft: Draft) -> None:
    del draft.leaves[draft.some]
    draft.write()


def with_one_more(draft: Draft) -> None:
    draft.leaves["low/params/back/door"] = np.zeros(3, np.float32)
    draft.write()


def a_folder(draft: Draft, file: Path) -> None:
    file.unlink()
    file.mkdir()


def of_a_gigabyte(draft: Draft) -> None:
    with draft.file.open("ab") as file:
        file.truncate(2**30)  # which takes no room


def one_bit(file: Path) -> None:
    bits = bytearray(file.read_bytes())
    bits[-5] ^= 1
    file.write_bytes(bits)


class Command:
    """Prints when it is unpickled."""

    def __reduce__(self) -> Any:
        return print, ("executed",)


F32 = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
RATE, LATENT = "config.low.optimiser.learning_rate", "config.network.latent"
MALFORMED: dict[str, tuple[Change, str]] = {
    # The card as a file.
    "no card": (lambda draft: draft.card_file.unlink(), "No such file"),
    "card is a folder": (lambda draft: a_folder(draft, draft.card_file), "Is a directory"),
    "card is empty": (card_text(lambda _: ""), "it is not JSON"),
    "card is no JSON": (card_text(lambda _: "format: 1"), "it is not JSON"),
    "card is cut off": (card_text(lambda draft: json.dumps(draft.card)[:-20]), "it is not JSON"),
    "card is no text": (card_text(lambda _: b"\xff\xfe{}"), "it is not JSON"),
    "card is a list": (card_text(lambda draft: json.dumps([draft.card])), "it is not an object"),
    "card is nested deeply": (card_text(lambda _: '{"a":' * 100_000), "it is not JSON"),
    "card is large": (card_text(lambda _: " " * 1_000_001), "larger than 1000000 bytes"),
    "a name twice": (
        card_text(lambda draft: json.dumps(draft.card)[:-1] + ', "format": 1}'),
        "'format' is given twice",
    ),
    "NaN in the card": (card_text(lambda draft: json.dumps(draft.card | {"env_steps": float("nan")})), "NaN is no"),
    "infinity in the card": (card_text(lambda draft: json.dumps(draft.card)[:-1] + ', "x": 1e999}'), "1e999 is no"),
    "a number of 5,000 digits": (card_text(lambda _: '{"format": ' + "9" * 5000 + "}"), "it is not JSON"),
    # Its entries.
    "another format": (card(format=2), "its format is 2, this version of hrlspec reads 1"),
    "format as text": (card(format="1"), "its format is '1'"),
    "format as truth": (card(format=True), "format is True, expected a whole number"),
    "no format": (card(format=...), "its format is None"),
    "an entry is missing": (card(licence=...), "'licence' is missing"),
    "an entry too many": (card(run="rm -r"), "'run' is no entry of a card"),
    "config is a list": (card(config=[]), "config is [], expected an object"),
    "steps as text": (card(env_steps="many"), "env_steps is 'many', expected a whole number"),
    "a bound above 1": (card(success_at_least={"dag": 1.5}), "success_at_least of 'dag' is 1.5"),
    "a bound as text": (card(success_at_least={"dag": "all"}), "success_at_least of 'dag' is 'all'"),
    "a path out of the folder": (card(file="../../etc/passwd"), "it is the card of '../../etc/passwd'"),
    "an absolute path": (card(file="/etc/passwd"), "it is the card of '/etc/passwd'"),
    "another agent's card": (card(file="walk.safetensors"), "it is the card of 'walk.safetensors'"),
    "control characters": (card(file="\x1b[2J\nbell\x07"), "it is the card of '\\x1b[2J\\nbell\\x07'"),
    # What the agent is of.
    "unknown environment": (setting("env", "chess"), "it is of the environment 'chess', which is none of hrlspec's"),
    "environment of a module": (setting("env", "this:that"), "it is of the environment 'this:that'"),
    "environment of no text": (setting("env", ["letter"]), "it is of the environment ['letter']"),
    "environment out of range": (setting("env", "conveyor-999999999"), "environment 'conveyor-999999999': "),
    "another environment": (setting("env", "letter12"), "it does not fit its settings"),
    "unknown method": (setting("method", "best"), "it is of the method 'best', which is none of hrlspec's"),
    "method of a module": (setting("method", "this:that"), "it is of the method 'this:that'"),
    "another method": (setting("method", "option"), "the setting 'method_settings.high."),
    "unknown recipe": (setting("recipe", "secret"), "recipe is 'secret'"),
    "unknown reward set": (setting("reward_set", 3), "reward_set is 3"),
    "unknown setting": (setting("config.network.magic", 1), "the setting 'config.network.magic' is not in both"),
    "a setting is missing": (setting(LATENT, ...), f"the setting {LATENT!r} is not in both"),
    "settings are a number": (setting("config.network", 7), "config.network is 7"),
    "a setting as text": (setting(LATENT, "8"), f"{LATENT} is '8'"),
    "a setting as truth": (setting(LATENT, True), f"{LATENT} is True"),
    "a setting out of range": (setting(LATENT, -1), "latent is -1, expected at least 1"),
    "more parameters than atoms": (setting(LATENT, 10**80), f"{LATENT} asks for 1"),
    "features without number": (setting("config.network.task_features", 10**30), "task_features asks for 1"),
    "a rate too large for a float": (setting(RATE, 10**400), f"{RATE} is too large"),
    "a thousand million rounds": (setting("config.network.task_rounds", 10**9), "task_rounds asks for 1000000000"),
    "a hundred thousand layers": (setting("config.network.actor", [8] * 100_000), "actor asks for 100000"),
    "settings that contradict": (setting("config.num_envs", 7), "blocks is 2, expected a divisor of 7"),
    # The parameters as a file.
    "no parameters": (lambda draft: draft.file.unlink(), "No such file"),
    "parameters are a folder": (lambda draft: a_folder(draft, draft.file), "Is a directory"),
    "parameters are large": (of_a_gigabyte, "larger than 268435456 bytes"),
    "a bit flipped": (lambda draft: one_bit(draft.file), "does not match the SHA-256"),
    "cut off": (lambda draft: draft.file.write_bytes(draft.content[:-100]), "does not match the SHA-256"),
    "another hash": (card_text(lambda draft: json.dumps(draft.card | {"sha256": "0" * 64})), "does not match the SHA"),
    # As safetensors, with their hash in the card.
    "empty": (content(lambda _: b""), "it holds no parameters"),
    "cut off and signed": (content(lambda draft: draft.content[:-100]), "it holds no parameters"),
    "more than it says": (content(lambda draft: draft.content + b"more"), "it holds no parameters"),
    "a pickle": (content(lambda _: pickle.dumps(Command())), "it holds no parameters"),
    "a header longer than the file": (content(lambda _: b"\xff" * 7 + b"\x0f{}"), "it holds no parameters"),
    "a header nested deeply": (content(lambda draft: draft.with_header(b"[" * 100_000)), "it holds no parameters"),
    "unknown type": (header(F32 | {"dtype": "Q7"}), "it holds no parameters"),
    "negative shape": (header(F32 | {"shape": [-1]}), "it holds no parameters"),
    "a shape that overflows": (header(F32 | {"shape": [2**62, 2**62]}), "it holds no parameters"),
    "a shape larger than its bytes": (header(F32 | {"shape": [2]}), "it holds no parameters"),
    "bytes that are not there": (header(F32 | {"data_offsets": [0, 8]}), "it holds no parameters"),
    "bytes of another leaf": (
        content(lambda draft: draft.with_header({"a": F32, "b": F32}, b"0000")),
        "it holds no parameters",
    ),
    "bfloat16": (header({"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}), "it holds no parameters"),
    # As parameters.
    "half precision": (leaf(lambda x: x.astype(np.float16)), "float16["),
    "double precision": (leaf(lambda x: x.astype(np.float64)), "float64["),
    "whole numbers": (leaf(lambda x: x.astype(np.int32)), "int32["),
    "transposed": (leaf(lambda x: x.T), "it does not fit its settings"),
    "one row less": (leaf(lambda x: x[1:]), "it does not fit its settings"),
    "flat": (leaf(np.ravel), "it does not fit its settings"),
    "a leaf is missing": (without_a_leaf, "is missing, expected float32["),
    "a leaf too many": (with_one_more, "'low/params/back/door' is float32[3], expected nothing"),
    "NaN": (leaf(lambda x: x * np.nan), "holds values that are not finite"),
    "infinity": (leaf(lambda x: x + np.inf), "holds values that are not finite"),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("good")
    write_tiny(folder / "agent.safetensors")
    read_params(read_agent(folder / "agent.safetensors"))
    return {file.name: file.read_bytes() for file in folder.iterdir()}


@pytest.fixture
def draft(good: dict[str, bytes], tmp_path: Path) -> Draft:
    for name, bits in good.items():
        (tmp_path / name).write_bytes(bits)
    return Draft(tmp_path / "agent.safetensors")


def contents(folder: Path) -> dict[str, tuple[int, int]]:
    return {path.name: (path.stat().st_size, path.stat().st_mtime_ns) for path in folder.rglob("*")}


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_malformed_is_refused(name: str, draft: Draft, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "this", raising=False)
    change, message = MALFORMED[name]
    change(draft)
    with pytest.raises(AgentFileError) as refused:
        read_params(read_agent(draft.file))
    said = str(refused.value)
    assert said.startswith(f"cannot use {draft.file.with_suffix('')}.")
    assert message in said
    assert said.isprintable()
    assert len(said) < 1000
    assert "this" not in sys.modules


@pytest.mark.parametrize("name", ["no card", "control characters", "environment of a module", "a bit flipped", "NaN"])
def test_commands_say_so_in_one_line(name: str, draft: Draft, capsys: pytest.CaptureFixture[str]) -> None:
    MALFORMED[name][0](draft)
    before = contents(draft.file.parent)
    out = draft.file.parent / "run"
    for main, flags in (
        (evaluate.main, ["--pretrained", str(draft.file), "--spec", "achieve a"]),
        (run.main, tiny.arguments(out, "--from", str(draft.file))),
    ):
        assert main_guard(lambda main=main, flags=flags: main(flags)) == 2
        said, err = capsys.readouterr()
        assert said == ""
        assert err.startswith("error: cannot use ")
        assert err.count("\n") == 1
        assert MALFORMED[name][1] in err
        assert contents(draft.file.parent) == before


def test_a_draft_that_is_not_changed_is_accepted(draft: Draft) -> None:
    """So each of the above is refused for its change alone."""
    draft.write()
    file = read_agent(draft.card_file)
    assert read_params(file).keys() == {"low", "high"}
    assert read_agent(draft.file) == file


def test_settings_of_training_may_be_missing(draft: Draft) -> None:
    """As where they came later: they do not tell how the agent acts."""
    before = read_agent(draft.file).agent
    setting(RATE, ...)(draft)
    agent = read_agent(draft.file).agent
    assert agent.config.low.optimiser.learning_rate == Config().low.optimiser.learning_rate
    assert agent.config.network == before.config.network
    assert read_params(read_agent(draft.file)).keys() == {"low", "high"}


@pytest.mark.parametrize("name", ["chess", "letter/../letter", "agent.pkl", ""])
def test_there_is_no_such_agent(name: str) -> None:
    with pytest.raises(AgentFileError, match=r"expected one of the packaged agents \(.*\), or a file in \.safetensors"):
        read_agent(name)
