"""Layout files: what was saved comes back, and nothing damaged does."""

from __future__ import annotations

import pathlib

import jax
import numpy as np
import pytest

import envs_jax
from envs_jax.layouts import FORMAT_VERSION, load_layouts, save_layouts


@pytest.fixture(scope="module")
def env() -> envs_jax.Environment:
    return envs_jax.make("letter")


@pytest.fixture(scope="module")
def layouts(env: envs_jax.Environment) -> np.ndarray:
    keys = jax.random.split(jax.random.key(0), 5)
    return np.asarray(jax.vmap(lambda key: env.sample_layout(key, env.default_params))(keys))


def test_round_trip(env: envs_jax.Environment, layouts: np.ndarray, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "some layouts"
    for _ in range(2):  # A file that exists is replaced.
        save_layouts(path, env, layouts)
    loaded = load_layouts(path, env)
    assert loaded.dtype == layouts.dtype
    np.testing.assert_array_equal(loaded, layouts)
    assert [entry.name for entry in tmp_path.iterdir()] == ["some layouts"]
    _, state = env.reset_to(loaded[3], jax.random.key(0), env.default_params)
    np.testing.assert_array_equal(state.layout, layouts[3])


def test_any_flipped_byte_is_noticed_or_harmless(
    env: envs_jax.Environment, layouts: np.ndarray, tmp_path: pathlib.Path
) -> None:
    path = tmp_path / "layouts.npz"
    save_layouts(path, env, layouts)
    good, refused = path.read_bytes(), 0
    for position in range(0, len(good), 7):
        path.write_bytes(good[:position] + bytes([good[position] ^ 0x15]) + good[position + 1 :])
        try:
            loaded = load_layouts(path, env)
        except ValueError:
            refused += 1
        else:  # Padding and file times are not content.
            np.testing.assert_array_equal(loaded, layouts)
    assert refused > len(good) // 14


@pytest.mark.parametrize("keep", [0, 1, 100, -1])
def test_cut_files(env: envs_jax.Environment, layouts: np.ndarray, tmp_path: pathlib.Path, keep: int) -> None:
    path = tmp_path / "layouts.npz"
    save_layouts(path, env, layouts)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match="damaged or no layout file"):
        load_layouts(path, env)


def test_missing_file(env: envs_jax.Environment, tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_layouts(tmp_path / "none.npz", env)


def _rewrite(path: pathlib.Path, **changes: object) -> None:
    with np.load(path) as archive:
        content = {**archive, **changes}
    with path.open("wb") as file:
        np.savez(file, **{name: value for name, value in content.items() if value is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": np.int64(FORMAT_VERSION + 1)}, f"format version {FORMAT_VERSION + 1}"),
        ({"version": None}, "no version"),
        ({"leaf_0": None}, "lacks leaf_0"),
        ({"leaf_0": np.zeros((5, 7, 7), np.int8)}, "checksum"),
        ({"digest": np.array("0" * 64)}, "checksum"),
    ],
)
def test_wrong_content(
    env: envs_jax.Environment, layouts: np.ndarray, tmp_path: pathlib.Path, changes: dict[str, object], message: str
) -> None:
    path = tmp_path / "layouts.npz"
    save_layouts(path, env, layouts)
    _rewrite(path, **changes)
    with pytest.raises(ValueError, match=message):
        load_layouts(path, env)


def test_layouts_of_another_environment(env: envs_jax.Environment, layouts: np.ndarray, tmp_path: pathlib.Path) -> None:
    path = tmp_path / "layouts.npz"
    save_layouts(path, env, layouts)
    with pytest.raises(ValueError, match=r"written for letter\).*expects int8 \[number, 6, 6\]"):
        load_layouts(path, envs_jax.make("letter", size=6))
    with pytest.raises(ValueError, match="expected -1 to 1"):
        load_layouts(path, envs_jax.make("letter", num_letters=2))


def test_saving_refuses_what_is_no_layout(
    env: envs_jax.Environment, layouts: np.ndarray, tmp_path: pathlib.Path
) -> None:
    on_start = layouts.copy()
    on_start[2, 0, 0] = 1
    bad = {
        "float64": layouts.astype(float),
        r"\[7, 7\]": layouts[0],
        "start cell": on_start,
        "2 arrays": (layouts, layouts),
    }
    for message, content in bad.items():
        with pytest.raises(ValueError, match=message):
            save_layouts(tmp_path / "bad.npz", env, content)
    assert not list(tmp_path.iterdir())
