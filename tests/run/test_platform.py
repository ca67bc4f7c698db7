"""XLA's flags, its options and the compilation cache: set where nothing was, and the user's left alone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from hrlspec.run import platform
from hrlspec.run.errors import UserError
from hrlspec.run.platform import compiler_options, with_loop_option

ROOT = Path(__file__).parents[2]
OPTION = "xla_cpu_small_while_loop_byte_threshold=65536"


@pytest.mark.parametrize(
    ("flags", "version", "expected"),
    [
        ("", (0, 10, 2), f"--xla_backend_extra_options={OPTION}"),
        ("", (0, 12, 0), ""),
        ("--xla_a=1", (0, 11, 0), f"--xla_a=1 --xla_backend_extra_options={OPTION}"),
        ("--xla_backend_extra_options=x --xla_a=1", (0, 10), f"--xla_backend_extra_options=x,{OPTION} --xla_a=1"),
        (
            "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=7",
            (0, 10),
            "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=7",
        ),
        ("--xla_a=1", (0, 12, 1), "--xla_a=1"),
    ],
)
def test_the_option_for_loops(flags: str, version: tuple[int, ...], expected: str) -> None:
    assert with_loop_option(flags, version) == expected
    assert with_loop_option(expected, version) == expected


def test_options_are_those_that_xla_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "")
    options = compiler_options("least")
    assert options["xla_backend_optimization_level"] == "1"
    assert jax.jit(lambda: 2).lower().compile(options)() == 2
    unknown = {"xla_no_such_option": "1", "xla_cpu_max_isa": False}
    monkeypatch.setattr(platform, "_LESS_EFFORT", {"least": {**platform._LESS_EFFORT["least"], **unknown}})
    assert compiler_options("least") == options


def test_the_level_of_optimisation_is_the_users_to_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=true --xla_backend_optimization_level=3 --xla_a=1")
    assert compiler_options("least") == {}


def test_what_gains_from_it_is_optimised_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "")
    assert compiler_options("most") == {}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler_options("least") == {}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--xla_no_such_flag=1", "XLA does not know --xla_no_such_flag=1"),
        ("--xla_backend_optimization_level=high", "XLA does not accept XLA_FLAGS: --xla_backend_optimization_level"),
        ("nowhere.txt", "XLA_FLAGS names the file 'nowhere.txt', which cannot be read: No such file or directory"),
        ("flags.txt", "XLA does not know --xla_from_file=1"),
    ],
)
def test_flags_at_which_xla_ends_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("flags.txt").write_text("--xla_from_file=1")
    monkeypatch.setenv("XLA_FLAGS", flags)
    with pytest.raises(UserError, match=message):
        platform.prepare()
    assert os.environ["XLA_FLAGS"] == flags


def test_flags_in_a_file_are_taken_from_there(tmp_path: Path) -> None:
    file = tmp_path / "flags.txt"
    file.write_text("--xla_backend_optimization_level=1\n")
    assert platform._flags_of_user(str(file)) == "--xla_backend_optimization_level=1\n"


def test_users_without_a_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    assert platform.cache_folder() is None


SCRIPT = """
import os
from hrlspec.run import platform
import jax
platform.prepare()
import jax.numpy as jnp
assert float(jax.jit(lambda x: x + 1)(jnp.ones(()))) == 2  # XLA knows the flags
print(jax.config.jax_compilation_cache_dir)
print(jax.config.jax_persistent_cache_min_compile_time_secs)
print(os.environ["XLA_FLAGS"])
assert jnp.ones(()).dtype == "float32"  # whatever JAX_ENABLE_X64 says
"""


def prepared(**environment: str) -> list[str]:
    names = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "XLA_FLAGS")
    clean = {name: value for name, value in os.environ.items() if name not in names}
    ended = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        cwd=ROOT,
        env=clean | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return ended.stdout.splitlines()


def test_the_cache_belongs_to_user_and_version(tmp_path: Path) -> None:
    import jaxlib.version

    folder, least, flags = prepared(XDG_CACHE_HOME=str(tmp_path), JAX_PLATFORMS="cpu", JAX_ENABLE_X64="1")
    assert folder == f"{tmp_path}/hrlspec/jaxlib-{jaxlib.version.__version__}"
    assert float(least) == 0.2
    assert flags == with_loop_option("", jax.__version_info__)


def test_what_the_user_set_stays(tmp_path: Path) -> None:
    mine = str(tmp_path / "mine")
    folder, least, _ = prepared(JAX_COMPILATION_CACHE_DIR=mine, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="3")
    assert folder == mine
    assert float(least) == 3
