"""Encoders: from an observation to a latent vector (paper, "Encoder")."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Float, Float32, Key

from envs_jax.arrays import Array

Planes = Float32[Array, "G ..."]
"""What is seen of each of G propositions or roles: images ``[G, H, W]`` or vectors ``[G, L]``."""
Shared = Float32[Array, " F0"]
"""What is seen and belongs to none of them."""


def initializer(gain: float) -> nn.initializers.Initializer:
    """Standard deviations of the weights of a layer that scales its input by ``gain``; see :func:`randomised`."""

    def deviation(key: Any, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Float32[Array, "..."]:
        del key
        return jnp.full(shape, gain / shape[0] ** 0.5, dtype)

    return deviation


def randomised(key: Key[Array, ""], deviations: Any) -> Any:
    """Truncated normal weights with the given standard deviations, a pytree; zeros stay zeros. The key is consumed.

    One draw serves all layers: with one for each, compiling this would take longer than the rest of a run's start.
    """
    flat, restore = jax.flatten_util.ravel_pytree(deviations)
    within = 2.0  # standard deviations; what remains of a standard normal there has the deviation divided by
    drawn = flat * jax.random.truncated_normal(key, -within, within, flat.shape, jnp.float32) / 0.87962566
    return restore(jax.lax.optimization_barrier(drawn))  # or each layer's slice would draw all of them anew


class MLP(nn.Module):
    """Dense layers with ReLU (or tanh) between them and, unless ``final_activation``, a linear end."""

    features: Sequence[int]
    tanh: bool = False
    final_activation: bool = False
    final_scale: float | None = None

    @nn.compact
    def __call__(self, x: Float32[Array, "*lead _"]) -> Float32[Array, "*lead _out"]:
        """Maps ``[..., F]`` to ``[..., features[-1]]``."""
        for i, width in enumerate(self.features):
            last = i == len(self.features) - 1
            gain = self.final_scale if last and self.final_scale is not None else 2.0**0.5
            x = nn.Dense(width, kernel_init=initializer(gain))(x)
            if not last or self.final_activation:
                x = nn.tanh(x) if self.tanh else nn.relu(x)
        return x


Layer = tuple[Float[Array, "_ _"], Float[Array, " _"]]  # weights and bias


def patches(x: Float[Array, "C H W ..."]) -> Float[Array, "..."]:
    """All 2x2 patches of images, ``[C, H, W, ...]`` to ``[4C, H-1, W-1, ...]``.

    A 2x2 convolution is then one matrix product. Inside a scanned loop the gradient of XLA's own
    convolution is about sixty times slower on a CPU.
    """
    return jnp.concatenate([x[:, :-1, :-1], x[:, 1:, :-1], x[:, :-1, 1:], x[:, 1:, 1:]])


@jax.custom_batching.custom_vmap
def convolve(image: Float[Array, "C H W"], layers: Sequence[Layer]) -> Float[Array, " F"]:
    """2x2 convolutions with ReLU, stride 1.

    Args:
        image: float32 ``[C, H, W]``.
        layers: for each the weights ``[4C, C']`` of its `patches`, and the bias ``[C']``.

    Returns:
        The last layer's features in a row, float32 ``[C' · H' · W']``.
    """
    return _convolve(image[..., None], layers)[:, 0]


@convolve.def_vmap
def _vmapped(size: int, batched: Any, image: Float[Array, "..."], layers: Any) -> tuple[Float[Array, "B F"], bool]:
    """With the batch last, patches are long copies instead of a few numbers each: an update takes an eighth less."""
    del size
    if any(jax.tree.leaves(batched[1])):
        axes = jax.tree.map(lambda yes: 0 if yes else None, batched)
        return jax.vmap(convolve.fun, in_axes=tuple(axes))(image, layers), True
    return _convolve(jnp.moveaxis(image, 0, -1), layers).T, True


def _convolve(x: Float[Array, "C H W B"], layers: Sequence[Layer]) -> Float[Array, "F B"]:
    """Images ``[C, H, W, B]`` to features ``[F, B]``."""
    for weights, bias in layers:
        x = patches(x)
        # A plain matrix product: for a product over the first of four axes XLA would turn the gradient's operands.
        flat = weights.T @ x.reshape(x.shape[0], -1) + bias[:, None]
        x = nn.relu(flat).reshape(-1, *x.shape[1:])
    return x.reshape(-1, x.shape[-1])


class Encoder(nn.Module):
    """CNN for images, MLP for vectors, then one linear layer to the latent.

    Attributes:
        latent: width of the output.
        conv_channels: channels of the 2x2 convolutions, stride 1, of which a small image has no more than fit; none
            treats an image as a vector.
        mlp: hidden units for vectors.
    """

    latent: int
    conv_channels: Sequence[int]
    mlp: Sequence[int]

    @nn.compact
    def __call__(self, planes: Planes, shared: Shared) -> Float32[Array, " latent"]:
        """Encodes one observation.

        Args:
            planes: float32 ``[G, H, W]`` images or ``[G, F]`` vectors, one per channel.
            shared: float32 ``[F0]``, the part of the observation that belongs to no proposition.

        Returns:
            float32 ``[latent]``.
        """
        channels = self.conv_channels[: min(planes.shape[1:]) - 1] if planes.ndim == 3 else ()
        if channels:
            x = jnp.concatenate([convolve(planes, self._layers(planes.shape[0], channels)), shared])
        else:
            x = MLP(self.mlp, final_activation=True)(jnp.concatenate([planes.reshape(-1), shared]))
        return nn.Dense(self.latent, kernel_init=initializer(1.0))(x)

    def _layers(self, planes: int, channels: Sequence[int]) -> list[Layer]:
        """The weights of the convolutions."""
        layers = []
        for i, width in enumerate(channels):
            shape = (4 * (channels[i - 1] if i else planes), width)
            weights = self.param(f"conv_{i}", initializer(2.0**0.5), shape)
            layers.append((weights, self.param(f"conv_{i}_bias", nn.initializers.zeros, (width,), jnp.float32)))
        return layers
