"""Checkpoints come back bit by bit, or are refused with one clear line."""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from hrlspec.checkpoint import (
    CheckpointDamagedError,
    CheckpointMismatchError,
    CheckpointMissingError,
    load,
    save,
    state_hash,
    steps,
    store,
)


@struct.dataclass
class State:
    params: dict[str, jax.Array]
    key: jax.Array
    rest: dict[str, object]


def make_state(seed: int = 0) -> State:
    rng = np.random.default_rng(seed)
    return State(
        params={"kernel": jnp.asarray(rng.normal(size=(7, 5)), jnp.float32), "bias": jnp.zeros(5)},
        key=jax.random.split(jax.random.key(seed), 3),
        rest={
            "half": jnp.asarray(rng.normal(size=3), jnp.bfloat16),
            "empty": jnp.zeros((0, 4), jnp.int8),
            "no_keys": jax.random.split(jax.random.key(0), 1)[:0],
            "old_key": jax.random.key(seed, impl="rbg"),
            "flag": jnp.asarray(True),
            "special": np.array([np.nan, -np.nan, np.inf, -0.0, 0.0, 5e-324]),
            "steps": np.int64(2**40 + seed),
            "words": np.array([0, 2**64 - 1], np.uint64),
            "python": {"count": 2**70 + seed, "share": 0.1, "on": True, "off": False},
            "nothing": None,
        },
    )


def empty_like(state: State) -> State:
    """A state of the same structure and types, with other values."""

    def blank(leaf: object) -> object:
        if isinstance(leaf, bool | int | float):
            return type(leaf)()
        if isinstance(leaf, np.generic):
            return type(leaf)(0)
        if isinstance(leaf, np.ndarray):
            return np.zeros_like(leaf)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(jnp.zeros_like(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        return jnp.zeros_like(leaf)

    return jax.tree.map(blank, state)


def test_a_state_comes_back_bit_by_bit(tmp_path: Path) -> None:
    state = make_state()
    path = save(tmp_path, 2**33, state, metadata={"config": "abc"})
    target = empty_like(state)
    assert state_hash(target) != state_hash(state)
    restored = load(tmp_path, target)
    assert state_hash(restored.state) == state_hash(state)
    assert (restored.step, restored.path, restored.skipped) == (2**33, path, ())
    assert restored.metadata["config"] == "abc"
    assert restored.metadata["versions"]["jax"] == jax.__version__
    chex.assert_trees_all_equal_structs(restored.state, state)
    for new, old in zip(jax.tree.leaves(restored.state), jax.tree.leaves(state), strict=True):
        assert isinstance(new, jax.Array) if isinstance(old, jax.Array) else type(new) is type(old)
    np.testing.assert_array_equal(
        jax.random.bits(restored.state.key[1], (4,)), jax.random.bits(state.key[1], (4,)), strict=True
    )
    assert restored.state.rest["steps"] == 2**40
    assert restored.state.rest["python"] == {"count": 2**70, "share": 0.1, "on": True, "off": False}


def test_a_relative_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    state = make_state()
    for folder in (Path("."), Path("runs") / "checkpoints"):
        save(folder, 1, state)
        assert state_hash(load(folder, empty_like(state)).state) == state_hash(state)


@pytest.mark.parametrize(
    "name",
    ["lr[0.1]", "[!a]", "**", "back\\slash", "gs:", "file://x", "%41", "a?b#c", "{a,b}", "~", "two\nlines", "\udcff"],
)
def test_every_path_works(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / name
    try:
        folder.mkdir(parents=True)
    except (OSError, UnicodeError):
        pytest.skip("no name for this file system")
    state = {"w": np.arange(3.0)}
    save(folder, 1, state)
    save(folder, 2, {"w": np.ones(3)})
    assert state_hash(load(folder, state, step=1).state) == state_hash(state)
    monkeypatch.chdir(folder)
    save("here", 1, state)
    restored = load("here", state)
    assert state_hash(restored.state) == state_hash(state)
    assert restored.skipped == ()


def test_an_abstract_target_and_a_part_of_the_state(tmp_path: Path) -> None:
    state = make_state()
    save(tmp_path, 1, state)
    abstract = jax.eval_shape(lambda: {"params": state.params, "key": state.key})
    restored = load(tmp_path, abstract, partial=True).state
    assert state_hash(restored) == state_hash({"params": state.params, "key": state.key})
    with pytest.raises(CheckpointMismatchError, match="missing here"):
        load(tmp_path, abstract)


def test_a_state_without_arrays(tmp_path: Path) -> None:
    state = {"count": 3, "empty": jnp.zeros(0)}
    save(tmp_path, 0, state)
    assert load(tmp_path, {"count": 0, "empty": jnp.ones(0)}).state["count"] == 3


def test_the_placement_of_the_target_is_kept(tmp_path: Path) -> None:
    device = jax.devices()[0]
    placed = jax.device_put(jnp.arange(4), device)
    save(tmp_path, 1, {"placed": placed, "free": jnp.arange(4)})
    restored = load(tmp_path, {"placed": placed, "free": jnp.arange(4)}).state
    assert restored["placed"].committed
    assert not restored["free"].committed


def test_every_bit_flip_in_every_file_is_noticed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    older, newer = make_state(1), make_state(2)
    save(tmp_path, 10, older)
    newest = save(tmp_path, 20, newer)
    rng = np.random.default_rng(0)
    files = sorted(path for path in newest.rglob("*") if path.is_file())
    assert {"manifest.json", "manifest.sha256", "_METADATA", "manifest.ocdbt"} <= {file.name for file in files}
    target = empty_like(newer)
    for file in files:
        content = file.read_bytes()
        positions = {0, len(content) - 1, *rng.integers(len(content), size=4).tolist()}
        for position in sorted(positions) if content else []:
            flipped = bytearray(content)
            flipped[position] ^= 1 << int(rng.integers(8))
            file.write_bytes(flipped)
            with pytest.raises(CheckpointDamagedError):
                load(tmp_path, target, step=20)
        restored = load(tmp_path, target)
        assert restored.step == 10
        assert state_hash(restored.state) == state_hash(older)
        assert len(restored.skipped) == 1
        file.write_bytes(content)
    assert state_hash(load(tmp_path, target).state) == state_hash(newer)
    assert all("is damaged" in line and "falling back to step 10" in line for line in caplog.messages)
    assert all("\n" not in line for line in caplog.messages)
    assert len(caplog.messages) == len(files)


@pytest.mark.parametrize("name", ["manifest.json", "manifest.sha256", "arrays", "arrays/_METADATA"])
def test_missing_and_truncated_parts_are_noticed(tmp_path: Path, name: str) -> None:
    state = make_state()
    save(tmp_path, 1, state)
    newest = save(tmp_path, 2, state)
    part = newest / name
    shutil.rmtree(part) if part.is_dir() else part.write_bytes(part.read_bytes()[:-1])
    assert load(tmp_path, empty_like(state)).step == 1
    if part.exists():
        part.unlink()
        assert load(tmp_path, empty_like(state)).step == 1


def test_a_wrong_number_from_orbax_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = make_state()
    save(tmp_path, 1, state)
    read = store._read_arrays

    def misread(folder: Path) -> dict[str, np.ndarray]:
        values = read(folder)
        first = min(values)
        values[first] = values[first].copy()
        values[first].view(np.uint8).flat[0] ^= 1
        return values

    monkeypatch.setattr(store, "_read_arrays", misread)
    with pytest.raises(CheckpointDamagedError, match=r"leaf '.*' does not match its SHA-256"):
        load(tmp_path, state)


def test_all_damaged_and_nothing_there(tmp_path: Path) -> None:
    state = make_state()
    with pytest.raises(CheckpointMissingError, match="no checkpoint in"):
        load(tmp_path / "nowhere", state)
    for step in (1, 2):
        (save(tmp_path, step, state) / "manifest.json").write_text("{}")
    with pytest.raises(CheckpointDamagedError, match="no intact checkpoint") as error:
        load(tmp_path, state)
    assert "step_000000000001" in str(error.value)
    assert "step_000000000002" in str(error.value)
    with pytest.raises(CheckpointMissingError, match=r"no checkpoint of step 3 in .*; there are 1, 2"):
        load(tmp_path, state, step=3)


def test_a_checkpoint_under_another_name_is_refused(tmp_path: Path) -> None:
    state = make_state()
    path = save(tmp_path, 1, state)
    shutil.copytree(path, path.with_name("step_000000000007"))
    assert load(tmp_path, state).step == 1
    with pytest.raises(CheckpointDamagedError, match="that of step 1"):
        load(tmp_path, state, step=7)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("bias", jnp.zeros(6), r"'params/bias' is float32\[6\] here and float32\[5\] there"),
        ("bias", jnp.zeros(5, jnp.bfloat16), r"'params/bias' is bfloat16\[5\] here and float32\[5\] there"),
        ("bias", 3, r"'params/bias' is int here and float32\[5\] there"),
        ("bias", None, r"'params/bias' is missing here and float32\[5\] there"),
        ("extra", jax.random.key(0), r"'params/extra' is key<fry>\[\] here and missing there"),
    ],
)
def test_another_structure_is_refused_with_one_line(tmp_path: Path, name: str, value: object, message: str) -> None:
    state = make_state()
    save(tmp_path, 1, state)
    save(tmp_path, 2, state)
    other = state.replace(params={**state.params, name: value})
    with pytest.raises(CheckpointMismatchError, match=message) as error:
        load(tmp_path, other)
    assert "\n" not in str(error.value)


def test_several_differences_are_counted(tmp_path: Path) -> None:
    save(tmp_path, 1, {"a": jnp.zeros(1), "b": jnp.zeros(2)})
    with pytest.raises(CheckpointMismatchError, match=r"'a' is .* \(1 more leaves differ\)"):
        load(tmp_path, {"a": jnp.zeros(3), "b": jnp.zeros(3)})


def test_another_format_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path, 1, {"a": 1})
    manifest = json.loads((path / "manifest.json").read_text()) | {"format": 99}
    text = json.dumps(manifest).encode()
    (path / "manifest.json").write_bytes(text)
    (path / "manifest.sha256").write_bytes(store._seal(text))
    with pytest.raises(CheckpointMismatchError, match="format 99"):
        load(tmp_path, {"a": 1})


def test_only_the_last_ones_are_kept(tmp_path: Path) -> None:
    for step in range(5):
        save(tmp_path, step, {"a": step}, keep=2)
    assert steps(tmp_path) == [3, 4]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["step_000000000003", "step_000000000004"]
    # An earlier step means that the run was restarted from before the later ones.
    save(tmp_path, 3, {"a": 33}, keep=2)
    assert steps(tmp_path) == [3]
    assert load(tmp_path, {"a": 0}).state == {"a": 33}


def test_an_identical_checkpoint_is_not_written_again(tmp_path: Path) -> None:
    state = make_state()
    path = save(tmp_path, 1, state, metadata={"x": (1, 2)})
    before = (path / "manifest.json").stat().st_ino
    assert save(tmp_path, 1, state, metadata={"x": (1, 2)}) == path
    assert (path / "manifest.json").stat().st_ino == before
    (path / "arrays" / "_METADATA").write_bytes(b"damaged")
    save(tmp_path, 1, state, metadata={"x": (1, 2)})
    assert state_hash(load(tmp_path, state).state) == state_hash(state)


def test_a_failed_save_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = make_state()
    save(tmp_path, 1, state)
    (tmp_path / ".saving_2").mkdir()  # what a killed process leaves behind
    save(tmp_path, 2, state)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(TypeError):
        save(tmp_path, 3, state, metadata={"not json": object()})
    real = Path.rename

    def interrupted(self: Path, target: Path) -> Path:
        if self.name.startswith(".saving"):
            raise KeyboardInterrupt
        return real(self, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    for step in (2, 3):
        with pytest.raises(KeyboardInterrupt):
            save(tmp_path, step, make_state(5))
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert state_hash(load(tmp_path, state).state) == state_hash(state)


@pytest.mark.parametrize("read", [{}, {"0": np.zeros(4)}])
def test_what_cannot_be_read_back_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: dict[str, np.ndarray]
) -> None:
    state = {"w": jnp.arange(4.0)}
    save(tmp_path, 1, state, keep=1)
    monkeypatch.setattr(store, "_read_arrays", lambda folder: read)
    with pytest.raises(CheckpointDamagedError, match="what was written is not what is read"):
        save(tmp_path, 2, state, keep=1)
    monkeypatch.undo()
    assert load(tmp_path, state).step == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["step_000000000001"]


@pytest.mark.skipif(sys.platform == "win32", reason="no such limits")
@pytest.mark.parametrize("noticed", ["before", "while writing"])
def test_a_disk_that_is_full_is_an_error_of_the_system(tmp_path: Path, noticed: str) -> None:
    """A limit on the size of files stands for the disk; it is for good, so it is set in a process of its own."""
    script = (
        "import resource, sys, numpy as np\n"
        "from hrlspec.checkpoint import load, save, store\n"
        "if sys.argv[2] != 'before':\n"
        "    store._check_room = lambda folder, size: None\n"
        "small, large = {'w': np.zeros(10)}, {'w': np.random.default_rng(0).random(100_000)}\n"
        "save(sys.argv[1], 1, small)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try:\n"
        "    save(sys.argv[1], 2, large)\n"
        "except OSError as error:\n"
        "    print(load(sys.argv[1], small).step, error.strerror)\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path), noticed],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=dict(os.environ, JAX_PLATFORMS="cpu"),
        cwd=Path(__file__).parents[2],
    )
    assert (ended.stdout, ended.stderr, ended.returncode) == (f"1 {os.strerror(errno.EFBIG)}\n", "", 0)
    assert [entry.name for entry in tmp_path.iterdir()] == ["step_000000000001"]


def test_what_cannot_be_stored_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"leaf 'name' is a str"):
        save(tmp_path, 1, {"name": "text"})
    with pytest.raises(TypeError, match=r"leaf 'x' has the dtype object"):
        save(tmp_path, 1, {"x": np.array([None])})
    with pytest.raises(ValueError, match="same path 'a/b'"):
        save(tmp_path, 1, {"a": {"b": 1}, "a/b": 2})
    for step, keep in ((-1, 3), (1, 0)):
        with pytest.raises(ValueError, match="step >= 0 and keep >= 1"):
            save(tmp_path, step, {}, keep=keep)
    assert steps(tmp_path) == []


def test_the_hash_sees_bits_types_shapes_and_paths() -> None:
    base = {"a": jnp.zeros(4), "b": jax.random.key(0)}
    assert state_hash(base) == state_hash({"b": jax.random.key(0), "a": np.zeros(4, np.float32)})
    others = [
        base | {"a": -jnp.zeros(4)},
        base | {"a": jnp.zeros((2, 2))},
        base | {"a": jnp.zeros(4, jnp.int32)},
        base | {"b": jax.random.key(1)},
        base | {"b": jax.random.key_data(jax.random.key(0))},
        {"c": base["a"], "b": base["b"]},
        {"a": base["a"]},
    ]
    assert len({state_hash(state) for state in (base, *others)}) == len(others) + 1


def test_nothing_is_printed_and_kill_9_loses_nothing(tmp_path: Path) -> None:
    """A process that saves without pause is killed: what it said it had saved is there and intact."""
    script = (
        "import sys, numpy as np\n"
        "from hrlspec.checkpoint import load, save\n"
        "state = {str(i): np.full(5000, 0.0, np.float32) for i in range(20)}\n"
        "for step in range(1, 1000):\n"
        "    save(sys.argv[1], step, {k: v + step for k, v in state.items()})\n"
        "    load(sys.argv[1], state)\n"
        "    print(step, flush=True)\n"
    )
    target = {str(index): np.zeros(5000, np.float32) for index in range(20)}
    environment = dict(os.environ, JAX_PLATFORMS="cpu")
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=Path(__file__).parents[2],
    )
    assert process.stdout is not None
    seen = [process.stdout.readline() for _ in range(3)]
    time.sleep(0.05)
    process.kill()
    rest, errors = process.communicate()
    printed = [*seen, *rest.splitlines(keepends=True)]
    assert [line.strip() for line in printed] == [str(step) for step in range(1, len(printed) + 1)]
    assert errors == ""
    restored = load(tmp_path, target)
    assert restored.step >= len(printed)
    assert restored.skipped == ()
    assert all((leaf == restored.step).all() for leaf in restored.state.values())
    save(tmp_path, restored.step + 1, target)
    assert not list(tmp_path.glob(".*"))


def test_the_logger_says_nothing_of_orbax(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG):
        save(tmp_path, 1, make_state())
        load(tmp_path, make_state())
    assert [record for record in caplog.records if "absl" in record.name or "orbax" in record.name] == []
