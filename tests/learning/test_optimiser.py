"""The optimiser's steps are those of optax's Adam behind its clip."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hrlspec.config import OptimiserConfig
from hrlspec.learning.optimiser import optimiser


def test_steps_are_those_of_adam_behind_a_clip() -> None:
    """Gradients from far below the epsilon to far above the clip, over a hundred steps."""
    rng = np.random.default_rng(0)
    params = {"kernel": jnp.zeros((5, 3), jnp.float32), "bias": jnp.zeros(3, jnp.float32)}
    ours = optimiser(OptimiserConfig(max_grad_norm=0.5))
    theirs = optax.chain(optax.clip_by_global_norm(0.5), optax.scale_by_adam(eps=1e-5))
    mine, other = ours.init(params), theirs.init(params)
    for _ in range(100):
        scale = 10.0 ** rng.uniform(-8, 2)
        gradient = jax.tree.map(lambda x, scale=scale: jnp.float32(scale * rng.normal(size=x.shape)), params)
        step, mine = ours.update(gradient, mine, params)
        expected, other = theirs.update(gradient, other, params)
        # At first 1 - b2^t is a thousandth, and an error of one unit in b2^t is 6e-5 of it.
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=1e-9), step, expected)
