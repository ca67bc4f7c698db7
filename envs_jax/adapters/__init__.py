"""Environments in the forms that other libraries expect; each module needs only its own library.

* `envs_jax.adapters.gymnasium`: single and vector environments (extra ``gymnasium``),
* `envs_jax.adapters.brax`: a brax ``Env`` (extra ``brax``),
* `envs_jax.adapters.gymnax`: the five-tuple interface of gymnax (nothing to install).

An environment knows nothing of tasks. A task language is handed to an adapter as an object that follows the
protocol `envs_jax.adapters.tasks.Tasks`; without one an adapter shows the bare environment.
"""

from __future__ import annotations
