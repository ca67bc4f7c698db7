"""Programs taken apart into scalars compute what they did."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs_jax.zone.scalarize import CannotScalarizeError, scalarize

MATRIX = np.array([[0.0, 1.0, 0.0], [2.0, 0.0, -1.0], [0.0, 0.0, 0.0]], np.float32)


def products(x: jax.Array, y: jax.Array) -> jax.Array:
    left = jnp.einsum("bij,bjk->bik", jnp.stack([x, y]), jnp.stack([MATRIX, MATRIX.T]))
    return left.sum((0, 2)) + MATRIX @ x[0] - (y * MATRIX).T @ y[1]


def rearrangements(x: jax.Array, y: jax.Array) -> jax.Array:
    rows = x[np.array([2, 0])]
    diagonal = x[np.arange(3), np.array([1, 2, 0])]
    windows = jax.vmap(lambda start: jax.lax.dynamic_slice(y, (start, 0), (2, 3)))(np.array([0, 1]))
    padded = jnp.pad(rows, ((1, 0), (0, 2)))[:, ::-1]
    tiled = jnp.tile(diagonal, (2, 2)).reshape(-1)
    return jnp.concatenate([rows.T.ravel(), diagonal, windows.ravel(), padded.ravel(), tiled, jnp.split(y, 3)[1][0]])


def updates(x: jax.Array, y: jax.Array) -> jax.Array:
    repeated = jnp.zeros(3).at[np.array([0, 0, 2])].add(x[0])
    placed = x.at[np.array([2, 0])].set(y[:2])
    dropped = jnp.zeros(3).at[np.arange(5)].set(jnp.arange(5.0), mode="drop")
    column = y.at[:, 1].add(x[1])
    return jnp.concatenate([repeated, placed.ravel(), dropped * x[2], column.ravel()])


def elements(x: jax.Array, y: jax.Array) -> jax.Array:
    chosen = jnp.where(np.array([True, False, True]), x, jnp.where(y > 0, jnp.clip(x, -0.5, 0.5), y**3))
    zero = jnp.zeros((3, 3)) - x * MATRIX
    return chosen + zero / 2 + jnp.sin(jnp.maximum(x, y)) - jax.nn.relu(-x) + 0.0 * y


@pytest.mark.parametrize("function", [products, rearrangements, updates, elements])
def test_equal_to_the_program_as_it_is(function) -> None:
    rng = np.random.default_rng(0)
    x, y = jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32)
    simple = scalarize(function, x, y)
    expected = function(x, y)
    got = jax.jit(simple)(x, y)
    assert got.shape == expected.shape
    assert got.dtype == expected.dtype
    np.testing.assert_allclose(got, expected, atol=1e-5)
    # Batched and inside another program too.
    batch = jax.jit(jax.vmap(simple))(jnp.stack([x, y]), jnp.stack([y, x]))
    np.testing.assert_allclose(batch, np.stack([expected, function(y, x)]), atol=1e-5)


def test_only_what_matters_is_left() -> None:
    """Products with zeros and ones, sums with zeros, and rearrangements are gone."""
    permutation = np.eye(3, dtype=np.float32)[[1, 2, 0]]
    simple = scalarize(lambda x: (permutation @ x)[np.array([0, 2])] + 0.0, np.zeros(3, np.float32))
    operations = {equation.primitive.name for equation in jax.make_jaxpr(simple)(np.zeros(3, np.float32)).eqns}
    assert operations <= {"slice", "squeeze", "stack", "concatenate", "broadcast_in_dim", "reshape"}


@pytest.mark.parametrize(
    "function",
    [
        jnp.sort,
        lambda x: jax.lax.while_loop(lambda x: x.sum() < 9, lambda x: x + 1, x),
        lambda x: x[x[0].astype(int)],
    ],
)
def test_what_is_not_known_is_refused(function) -> None:
    with pytest.raises(CannotScalarizeError):
        scalarize(function, np.zeros(3, np.float32))
