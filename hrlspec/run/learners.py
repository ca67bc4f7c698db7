"""Learners of several seeds, iterated as one program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp

from hrlspec.learning.seeds import Seeds
from hrlspec.learning.train import TrainState
from hrlspec.run.learner import Learner
from hrlspec.run.loop import Together


def together(learners: Sequence[Learner], devices: int) -> Together:
    """How the host loop iterates them.

    Args:
        learners: on one device each, different in nothing but their seeds.
        devices: how many share them evenly.
    """
    first = learners[0]
    seeds = Seeds(first.trainer, len(learners), devices)
    program = first.program("iterate", Seeds.iterate, seeds, devices)
    # Worlds without suites have tasks of their own for each seed, and not always as many.
    most = max(len(learner.reserved) for learner in learners)
    reserved = jnp.stack([jnp.pad(some.reserved, (0, most - len(some.reserved)), mode="edge") for some in learners])

    def iterate(states: TrainState, index: int) -> tuple[TrainState, Mapping[str, jax.Array]]:
        banks = jax.tree.map(lambda *x: jnp.stack(x), *(learner.banks.at(index) for learner in learners))
        result: tuple[TrainState, Mapping[str, jax.Array]] = program(states, banks, first.machine, reserved)
        return result

    return Together(seeds.join, seeds.split, iterate)
