"""Arrays as annotations speak of them: ``Float[Array, "T E"]`` is a float array of T time steps and E environments.

Axes are named once and the letters used everywhere: **E** environments, **T** time steps, **N** tree nodes, **C**
children, **P** atomic propositions, **F** features, **D** depth, **M** tasks. Axes of one file are explained there;
``...`` and ``*lead`` are any leading axes. Nothing is checked at run time but in the tests (jaxtyping with beartype).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import numpy as np

if TYPE_CHECKING:
    Array = jax.Array
else:
    Array = jax.Array | np.ndarray
    """JAX's arrays; on the host, the same code runs on numpy's."""
