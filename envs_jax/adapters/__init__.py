"""Environments in the forms that other libraries expect, and other libraries' environments in this one's.

Out of this library; each module needs only its own library:

* `envs_jax.adapters.gymnasium`: single and vector environments (extra ``gymnasium``),
* `envs_jax.adapters.brax`: a brax ``Env`` (extra ``brax``),
* `envs_jax.adapters.gymnax`: the interface of gymnax, before 1.0 or since (nothing to install).

Into it; whoever has such an environment has its library:

* :func:`from_gymnax`: an environment of gymnax, with labels,
* :func:`from_brax`: an environment of brax, with labels.

An environment knows nothing of tasks. A task language is handed to an adapter as an object that follows the
protocol `envs_jax.adapters.tasks.Tasks`; without one an adapter shows the bare environment.
"""

from __future__ import annotations

from envs_jax.adapters.from_brax import from_brax
from envs_jax.adapters.from_gymnax import from_gymnax

__all__ = ["from_brax", "from_gymnax"]
