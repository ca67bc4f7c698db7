"""The model of what a run costs: what is read off programs against what their authors would count by hand."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scale_model import Sum, exchange_seconds, exchanged, size, sums_of
from hrlspec.learning.shards import SPREAD, Shards
from hrlspec.learning.train import Trainer
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import reward_machine
from tests.probes import Corridor, small_agent, small_config


def test_sums_in_loops_count_as_often_as_they_run() -> None:
    shards = Shards(num_envs=2, blocks=2, devices=2)

    def function(x: jax.Array) -> jax.Array:
        def step(x: jax.Array, _: None) -> tuple[jax.Array, None]:
            return x + shards.total(x), None

        return jax.lax.scan(step, x, None, 7)[0] + shards.total(x[:, :2]).sum()

    program = shards.on_each(function, (SPREAD,), SPREAD)
    traced = jax.make_jaxpr(jax.jit(program))(jnp.zeros((2, 5)))
    assert [*sums_of(traced.jaxpr)] == [Sum(row_bytes=20, times=7), Sum(row_bytes=8, times=1)]


@pytest.mark.slow  # tracing an iteration takes seconds
def test_an_iteration_exchanges_one_gradient_a_minibatch() -> None:
    env = Corridor(cells=("a", "", "bc", "", "d", "", ""), starts=(1, 3, 5), horizon=9)
    config = small_config(num_envs=16, blocks=2)
    trainer = Trainer(small_agent(env, config), devices=2)
    bank = draw_bank(np.random.default_rng(0), config.curriculum, 4, np.zeros(0, np.uint32))
    machine = reward_machine(env.propositions)
    state = jax.eval_shape(trainer.init, jax.random.key(0), bank, machine)
    nothing = jax.ShapeDtypeStruct((0,), jnp.uint32)
    traced = jax.make_jaxpr(Trainer.iterate, static_argnums=0)(trainer, state, bank, machine, nothing)
    sums = [*sums_of(traced.jaxpr)]
    high = trainer.agent.high.ppo
    assert high is not None
    optimisers = {"low": config.low.optimiser, "high": high.optimiser, "reach_critic": config.shield.optimiser}
    gradients = [
        (size(state.params[part]), some.epochs * some.minibatches)
        for part, some in optimisers.items()
        if part in state.optimisers
    ]
    # A row is a gradient, and behind it a few numbers: the loss and what is reported of it.
    assert [one.times for one in sums[: len(gradients)]] == [times for _, times in gradients]
    assert all(0 < one.row_bytes - known < 100 for one, (known, _) in zip(sums, gradients, strict=False))
    assert all(one.row_bytes < 100 and one.times == 1 for one in sums[len(gradients) :])


def test_what_an_exchange_takes() -> None:
    sums = [Sum(row_bytes=1000, times=3), Sum(row_bytes=4, times=1)]
    assert exchanged(sums, 1) == 0
    assert exchanged(sums, 9) == 8 * 3004
    assert exchange_seconds(sums, 1, 1.0, 1.0) == 0.0
    assert exchange_seconds(sums, 2, 0.5, 1e3) == pytest.approx(4 * 0.5 + 3.004)
