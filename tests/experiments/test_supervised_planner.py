"""The planner's networks told what to choose: what they are told, and that they learn it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.supervised_planner import Flags, draw, loss
from hrlspec.agent.agent import Agent
from hrlspec.config import evolve
from hrlspec.methods import ImplicitPlanner
from hrlspec.presets import preset
from hrlspec.spec import initial, open_edges, task_hashes
from tests.probes import quick_jit, random_params

FLAGS = Flags(recipe="hrlspec", tasks=12, layouts=4, minibatch=8)


def test_samples_are_first_choices_that_matter_of_tasks_that_nobody_is_tested_on() -> None:
    world = preset("letter")
    samples, pairs = draw(world, FLAGS, 0)
    assert 0 < len(samples.best) < pairs == 48
    is_open = np.asarray(jax.vmap(lambda tree: open_edges(tree, initial(tree)))(samples.tree))
    best = np.asarray(samples.best)
    assert (best <= is_open).all()
    assert (best.any(1) & (best < is_open).any(1)).all()
    assert not np.isin(task_hashes(jax.tree.map(np.asarray, samples.tree)), world.reserved).any()
    again, other = draw(world, FLAGS, 0)[0], draw(world, FLAGS, 1)[0]
    assert all(map(np.array_equal, jax.tree.leaves(samples), jax.tree.leaves(again)))
    assert not np.array_equal(samples.tree.reach[:8], other.tree.reach[:8])


def test_the_loss_is_of_the_probability_of_a_best_edge() -> None:
    world = preset("letter")
    config, method = world.settings("ours", "hrlspec")
    agent = Agent(world.make(), config, evolve(method, {"high.network.advice": 0.0}))
    samples = jax.tree.map(lambda x: x[:3], draw(world, FLAGS, 0)[0])
    params = random_params(agent, 0)["high"]
    planner = cast(ImplicitPlanner, agent.high).planner(agent.low)

    @quick_jit
    def choose(samples: object) -> jax.Array:
        view, tree, _ = samples  # type: ignore[misc]
        advice = jnp.zeros(tree.parent.shape, jnp.float32)
        return jax.vmap(planner.apply, in_axes=(None, 0, 0, 0, 0))(params, view, tree, jax.vmap(initial)(tree), advice)[
            0
        ]

    odds = np.exp(np.asarray(choose(samples), np.float64))
    chosen = (odds * np.asarray(samples.best)).sum(1) / odds.sum(1)
    found = quick_jit(lambda samples: loss(agent, params, samples))(samples)
    assert float(found) == pytest.approx(-np.log(chosen).mean(), rel=1e-4)


@pytest.mark.slow
def test_they_learn(tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    flags = "--recipe hrlspec --draws 6 --minibatch 64 --learning-rate 2e-3".split()
    command = [sys.executable, "-m", "experiments.supervised_planner", *flags, "--out", str(file)]
    subprocess.run(command, check=True)
    found = json.loads(file.read_text())
    assert found["curve"]["first_choice"][-1] > found["chance"] + 0.1
    assert found["curve"]["loss"][-1] < found["curve"]["loss"][0]
