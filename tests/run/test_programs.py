"""Compiled programs that outlive the process: found again, told apart, and made anew where damaged."""

from __future__ import annotations

import functools
import os
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from hrlspec.config import Effort
from hrlspec.run import programs
from hrlspec.run.programs import Program

traced: list[int] = []


@functools.partial(jax.jit, static_argnums=0)
def scaled(factor: int, x: dict[str, jax.Array], key: jax.Array) -> dict[str, jax.Array]:
    traced.append(factor)
    return {"y": factor * x["x"], "noise": jax.random.normal(key, (2,))}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> Iterator[Path]:
    """The place where programs are kept, empty; nothing is traced yet."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    jax.clear_caches()
    programs._own.cache_clear()
    traced.clear()
    yield tmp_path / "hrlspec-programs"
    jax.config.update("jax_compilation_cache_dir", before)


def run(factor: int = 3, size: int = 4, *, effort: Effort = "most") -> float:
    """As a new process would; jit's own memory is emptied first."""
    jax.clear_caches()
    result = Program("scaled", scaled, factor, effort=effort)({"x": jnp.ones(size)}, jax.random.key(0))
    np.testing.assert_array_equal(result["noise"], jax.random.normal(jax.random.key(0), (2,)))
    return float(result["y"].sum())


def test_found_again_without_tracing(folder: Path) -> None:
    assert (run(), run(), run()) == (12, 12, 12)
    assert traced == [3]
    assert len(list(folder.iterdir())) == 1


def test_told_apart_by_settings_and_shapes(folder: Path) -> None:
    assert (run(), run(factor=2), run(size=5), run(factor=2, size=5)) == (12, 8, 15, 10)
    assert (run(), run(factor=2), run(size=5), run(factor=2, size=5)) == (12, 8, 15, 10)
    assert traced == [3, 2, 3, 2]
    assert len(list(folder.iterdir())) == 4


def test_told_apart_by_options(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "")
    assert (run(effort="least"), run(), run(effort="least"), run()) == (12, 12, 12, 12)
    assert traced == [3, 3]
    assert len(list(folder.iterdir())) == 2


def test_told_apart_by_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    run()
    monkeypatch.setattr(programs, "_fingerprint", lambda: ("other sources",))
    run()
    assert traced == [3, 3]


@pytest.mark.parametrize("damage", ["cut", "empty", "noise"])
def test_damaged_files_are_replaced(folder: Path, damage: str) -> None:
    run()
    (file,) = folder.iterdir()
    content = file.read_bytes()
    file.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "noise": b"\x80\x04" + bytes(1000)}[damage])
    assert (run(), run()) == (12, 12)
    assert traced == [3, 3]


def test_the_oldest_go_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "KEPT", 2)
    for size in (1, 2, 3):
        run(size=size)
    assert len(list(folder.iterdir())) == 2
    run(size=3)
    assert traced == [3, 3, 3]


def test_without_a_place_everything_works_as_before(folder: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", None)
    assert run() == 12
    assert not folder.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no such permissions")
@pytest.mark.parametrize("mode", [0o775, 0o757])
def test_a_folder_that_others_may_write_to_is_not_used(
    folder: Path, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    run()
    (file,) = folder.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    assert file.stat().st_mode & 0o777 == 0o600
    programs._own.cache_clear()
    folder.chmod(mode)
    assert (run(), run(size=5)) == (12, 15)
    assert traced == [3, 3, 3]
    assert list(folder.iterdir()) == [file]
    (line,) = caplog.messages
    assert line.startswith(f"compiled programs are not kept in {folder}: others may write there")


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_belongs_to_somebody_else_is_not_loaded(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, kind: str
) -> None:
    run()
    if kind == "folder":
        programs._own.cache_clear()
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    monkeypatch.setattr(pickle, "load", lambda stream: pytest.fail("unpickled"))
    assert run() == 12
    assert traced == [3, 3]
    assert ["it belongs to somebody else" in line for line in caplog.messages] == [True] * (kind == "folder")


def test_a_link_to_a_folder_is_not_used(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    (folder.parent / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(folder.parent / "elsewhere", target_is_directory=True)
    assert run() == 12
    assert not list(folder.iterdir())
    assert "others may write there" in caplog.text


def test_a_file_that_others_may_write_to_is_made_anew(folder: Path) -> None:
    run()
    (file,) = folder.iterdir()
    file.chmod(0o660)
    assert (run(), run()) == (12, 12)
    assert traced == [3, 3]
    assert file.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("place", ["gs://bucket/cache", "file"])
def test_no_place_for_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    jax.config.update("jax_compilation_cache_dir", place)
    assert programs._folder() is None
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
    assert len(caplog.messages) == (place == "file")


def test_kept_only_if_it_may_be(folder: Path) -> None:
    for _ in range(2):
        jax.clear_caches()
        result = Program("scaled", scaled, 3, kept=False)({"x": jnp.ones(4)}, jax.random.key(0))
        assert float(result["y"].sum()) == 12
    assert traced == [3, 3]
    assert not folder.exists()


def test_calls_after_the_first_do_not_look_for_it(folder: Path) -> None:
    program = Program("scaled", scaled, 3)
    arguments = {"x": jnp.ones(4)}, jax.random.key(0)
    program(*arguments)
    for file in folder.iterdir():
        file.unlink()
    program(*arguments)
    assert traced == [3]


def test_what_the_cache_of_jax_holds_is_compiled_anew(folder: Path) -> None:
    """An executable that JAX took from its own cache lacks its machine code when it is stored again."""
    least = jax.config.values["jax_persistent_cache_min_compile_time_secs"]
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()
    try:
        scaled(3, {"x": jnp.ones(4)}, jax.random.key(0))
        assert any(file.name.startswith("jit_scaled") for file in folder.parent.iterdir())
        assert (run(), run()) == (12, 12)
    finally:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
        compilation_cache.reset_cache()
