"""What a policy draws its actions from: a categorical distribution, or a diagonal Gaussian over a box.

Both are described by a vector of network outputs, and drawn with noise of standard form, so that zero noise gives the
mode. Axes: **A** actions, or components of an action; **K** candidate actions.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from envs_jax import Box, Discrete

MASKED = -1e9
"""Logit of what cannot be chosen."""
LEAST_LOG_STD, MOST_LOG_STD = -1.5, 1.0
MOST_MEAN = 1.5
"""Bounds of the moments, in units of half the box's width. Experience that is relabelled meets a policy which would
have acted otherwise: the gradient of its log-likelihood grows with the distance of the means over the variance."""


@runtime_checkable
class Distribution(Protocol):
    """A family of distributions over one environment's actions."""

    @property
    def num_outputs(self) -> int:
        """Length of the vector that describes a member."""
        ...

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """Shape of the noise that one draw takes."""
        ...

    def noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Noise for draws, float32 ``[*shape, *noise_shape]``. The key is consumed."""
        ...

    def noise_sequence(self, key: jax.Array, length: int, correlation: jax.Array | float) -> jax.Array:
        """Noise for successive steps, float32 ``[length, *noise_shape]``; correlated where it makes sense."""
        ...

    def sample(self, outputs: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
        """An action and its log-probability ``[]`` (density, where actions are continuous)."""
        ...

    def log_prob(self, outputs: jax.Array, action: jax.Array) -> jax.Array:
        """Log-probability of an action, ``[]``."""
        ...

    def entropy(self, outputs: jax.Array) -> jax.Array:
        """Entropy ``[]``, in nats."""
        ...

    def candidates(self) -> jax.Array:
        """Actions to choose among where one is to be best or worst: all of them, or some all over the box."""
        ...


@dataclasses.dataclass(frozen=True)
class Categorical:
    """Logits of A actions; an action is an int32 ``[]``, noise is Gumbel."""

    num_actions: int

    @property
    def num_outputs(self) -> int:
        """A."""
        return self.num_actions

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """``(A,)``."""
        return (self.num_actions,)

    def noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """See :class:`Distribution`."""
        return jax.random.gumbel(key, (*shape, self.num_actions), jnp.float32)

    def noise_sequence(self, key: jax.Array, length: int, correlation: jax.Array | float) -> jax.Array:
        """See :class:`Distribution`; never correlated."""
        del correlation
        return self.noise(key, (length,))

    def sample(self, outputs: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See :class:`Distribution`."""
        choice = jnp.argmax(outputs + noise).astype(jnp.int32)
        return choice, self.log_prob(outputs, choice)

    def log_prob(self, outputs: jax.Array, action: jax.Array) -> jax.Array:
        """See :class:`Distribution`."""
        return jax.nn.log_softmax(outputs)[action]

    def entropy(self, outputs: jax.Array) -> jax.Array:
        """See :class:`Distribution`; masked actions count nothing."""
        log_probs = jax.nn.log_softmax(outputs)
        return -(jnp.exp(log_probs) * jnp.where(log_probs > -1e8, log_probs, 0.0)).sum()

    def candidates(self) -> jax.Array:
        """All actions, int32 ``[A]``."""
        return jnp.arange(self.num_actions, dtype=jnp.int32)


@dataclasses.dataclass(frozen=True)
class DiagonalGaussian:
    """Means and log standard deviations of A components; noise is normal.

    An action is a float32 ``[A]`` and may lie outside the box: the environment clips it, and the density is that of
    what was drawn. So a mean beyond the bound, where noise matters little, can be learned.

    Attributes:
        size: A.
        low, high: the box, the same in every component; means and deviations are in units of half its width.
        candidates_per_side: candidate actions form a grid with so many points a side.
    """

    size: int
    low: float
    high: float
    candidates_per_side: int = 3

    @property
    def num_outputs(self) -> int:
        """2A: means, then log standard deviations."""
        return 2 * self.size

    @property
    def noise_shape(self) -> tuple[int, ...]:
        """``(A,)``."""
        return (self.size,)

    def noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """See :class:`Distribution`."""
        return jax.random.normal(key, (*shape, self.size), jnp.float32)

    def noise_sequence(self, key: jax.Array, length: int, correlation: jax.Array | float) -> jax.Array:
        """See :class:`Distribution`: a stationary first-order autoregression, standard normal at every step."""
        white = self.noise(key, (length,))
        fresh = jnp.sqrt(1 - correlation**2)

        def step(before: jax.Array, drawn: jax.Array) -> tuple[jax.Array, jax.Array]:
            now = correlation * before + fresh * drawn
            return now, now

        return jnp.concatenate([white[:1], jax.lax.scan(step, white[0], white[1:])[1]])

    def sample(self, outputs: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See :class:`Distribution`."""
        mean, log_std = self._moments(outputs)
        action = mean + jnp.exp(log_std) * noise
        return action, self.log_prob(outputs, action)

    def log_prob(self, outputs: jax.Array, action: jax.Array) -> jax.Array:
        """See :class:`Distribution`."""
        mean, log_std = self._moments(outputs)
        z = (action - mean) * jnp.exp(-log_std)
        return -(0.5 * z**2 + log_std + 0.5 * math.log(2 * math.pi)).sum()

    def entropy(self, outputs: jax.Array) -> jax.Array:
        """See :class:`Distribution`."""
        return (self._moments(outputs)[1] + 0.5 * math.log(2 * math.pi * math.e)).sum()

    def candidates(self) -> jax.Array:
        """A grid over the box, corners included, float32 ``[K, A]``."""
        side = jnp.linspace(self.low, self.high, self.candidates_per_side, dtype=jnp.float32)
        return jnp.stack(jnp.meshgrid(*[side] * self.size, indexing="ij"), -1).reshape(-1, self.size)

    def _moments(self, outputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        half, middle = (self.high - self.low) / 2, (self.high + self.low) / 2
        mean, raw = MOST_MEAN * jnp.tanh(outputs[: self.size] / MOST_MEAN), outputs[self.size :]
        return middle + half * mean, jnp.clip(raw, LEAST_LOG_STD, MOST_LOG_STD) + math.log(half)


def distribution_over(space: Discrete | Box) -> Distribution:
    """The family for an action space.

    Raises:
        ValueError: if actions are arrays of more than one axis.
    """
    if isinstance(space, Discrete):
        return Categorical(space.n)
    if len(space.shape) != 1:
        raise ValueError(f"actions have shape {space.shape}, expected one axis")
    return DiagonalGaussian(space.shape[0], space.low, space.high)
