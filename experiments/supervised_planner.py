"""How well the planner's networks choose when they are told: trained on exact optima, not on what an agent earns.

    python -m experiments.supervised_planner [--env letter] [--recipe paper] [--reward-set 1] [--seed 1100] [--out FILE]

Each sample is a random task in a random layout in which the first choice matters, drawn afresh, with the first edges
that are best; the loss is the cross-entropy of the policy over the open edges. Tested on tasks for validation. Networks
that choose well here and badly after a training run lack no capacity there, but signal or data.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import operator
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Bool, Float32, Key

from envs_jax.arrays import Array
from envs_jax.base import Layout
from hrlspec.agent.agent import Agent
from hrlspec.agent.experience import View, view_of
from hrlspec.agent.method import Method
from hrlspec.config import Config, evolve
from hrlspec.evaluation import Suite
from hrlspec.evaluation.first_choice import first_choice_evaluation
from hrlspec.methods import ImplicitPlanner
from hrlspec.presets import Preset, Recipe, RewardSet, preset
from hrlspec.presets.suite_rules import MAX_NODES
from hrlspec.run.circumstances import circumstances
from hrlspec.run.errors import main_guard
from hrlspec.run.platform import prepare
from hrlspec.spec import TaskTree, initial
from hrlspec.tasks.sampling import sample_trees


@dataclasses.dataclass(frozen=True)
class Flags:
    """What is trained, and on how much."""

    env: str = "letter"
    recipe: Recipe = "paper"
    """Whose networks; without the low level's advice."""
    reward_set: RewardSet = 1
    """What makes a first choice the best: fewest steps, or the largest return."""
    seed: int = 1100
    draws: int = 40
    """Times that tasks and layouts are drawn; each sample is used once."""
    tasks: int = 400
    """Of a draw."""
    layouts: int = 25
    """For each task; one is enough where all are alike, as in Walk."""
    minibatch: int = 256
    learning_rate: float = 1e-3
    """At first; it falls to zero by a cosine."""
    width: int = 1
    """How many times as wide as the recipe's all layers are."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""


class Samples(NamedTuple):
    """First choices with their labels; leading axis B, numpy leaves where they are drawn."""

    view: View
    tree: TaskTree
    best: Bool[Array, "B N"]


def draw(world: Preset, flags: Flags, number: int) -> tuple[Samples, int]:
    """The samples of a draw, and how many pairs of task and layout there were.

    Args:
        world: where.
        flags: how many.
        number: of the draw; with the seed it says what is drawn.
    """
    env, rng = world.make(), np.random.default_rng([flags.seed, number])
    trees = sample_trees(
        rng,
        num_tasks=flags.tasks,
        num_propositions=env.num_propositions,
        max_nodes=MAX_NODES,
        min_depth=2,
        max_depth=world.settings()[0].curriculum.levels,
        max_branching=3,
        max_avoid=2,
        min_leaves=2,
        reserved=world.reserved,
    )
    suite = Suite("drawn", ("",) * flags.tasks, trees)
    machine, seed = world.rewards(flags.reward_set), int(rng.integers(2**31))
    cases = first_choice_evaluation(env, suite, machine, layouts_per_task=flags.layouts, seed=seed).cases
    pairs = flags.tasks * flags.layouts
    # As many layouts in every draw, or each would compile anew.
    layouts = jax.tree.map(lambda x: np.resize(x, (pairs, *x.shape[1:])), cases.layouts)
    views = jax.device_get(_first_views(env, jax.random.key(seed), layouts))
    view: View = jax.tree.map(lambda x: x[: len(cases)], views)
    tree: TaskTree = jax.tree.map(lambda x: x[cases.task], trees)
    return Samples(view, tree, cast(Array, cases.best)), pairs


@functools.partial(jax.jit, static_argnums=0)
def _first_views(env: Any, key: Key[Array, ""], layouts: Layout) -> View:
    """What is seen at the start in each layout, leading axis B."""
    keys = jax.random.split(key, len(jax.tree.leaves(layouts)[0]))
    observation, _ = jax.vmap(env.reset_to, in_axes=(0, 0, None))(layouts, keys, env.default_params)
    return jax.vmap(lambda x: view_of(env, x))(observation)


def loss(agent: Agent, params: Any, samples: Samples) -> Float32[Array, ""]:
    """Mean of -log of the probability that one of the best edges is chosen."""
    planner = cast(ImplicitPlanner, agent.high).planner(agent.low)

    def one(view: View, tree: TaskTree, best: Bool[Array, " N"]) -> Float32[Array, ""]:
        logits, _ = planner.apply(params, view, tree, initial(tree), jnp.zeros(tree.num_nodes, jnp.float32))
        return jax.nn.logsumexp(logits) - jax.nn.logsumexp(jnp.where(best, logits, -jnp.inf))

    return jax.vmap(one)(*samples).mean()


def train(flags: Flags) -> Iterator[dict[str, Any]]:
    """Trains, and yields after each draw what was seen by then and how many first choices for validation are right."""
    world = preset(flags.env)
    config, method = world.settings("ours", flags.recipe, flags.reward_set)
    agent = Agent(world.make(), *_as_wide(flags.width, config, method))
    suite, machine = world.suite("dag_validation"), world.rewards(flags.reward_set)
    evaluate = first_choice_evaluation(agent.env, suite, machine, seed=1, greedy=True)
    key = jax.random.key(flags.seed)
    params = agent.init(key)
    total = math.ceil(flags.draws * flags.tasks * flags.layouts / flags.minibatch)
    rate = optax.cosine_decay_schedule(flags.learning_rate, total)
    transform = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
    state = transform.init(params["high"])

    @jax.jit
    def descend(own: Any, state: Any, batch: Samples) -> tuple[Any, Any, Float32[Array, ""]]:
        value, gradient = jax.value_and_grad(functools.partial(loss, agent))(own, batch)
        updates, state = transform.update(gradient, state, own)
        return optax.apply_updates(own, updates), state, value

    seen, drawn = 0, 0
    for number in range(flags.draws):
        samples, pairs = draw(world, flags, number)
        order = np.random.default_rng([flags.seed, number, 1]).permutation(len(samples.best))
        losses = []
        for first in range(0, len(order) - flags.minibatch + 1, flags.minibatch):
            batch = jax.tree.map(operator.itemgetter(order[first : first + flags.minibatch]), samples)
            params["high"], state, value = descend(params["high"], state, batch)
            losses.append(value)
        seen, drawn = seen + len(losses) * flags.minibatch, drawn + pairs
        now = jax.random.fold_in(key, number)
        result, right = evaluate(now, agent, params, machine), evaluate.right(now, agent, params, machine)
        margins = _by_margin(right, evaluate.cases.margin)
        yield {"samples": seen, "drawn": drawn, "loss": float(np.mean(losses)), **result.to_json(), "margins": margins}


def _as_wide(width: int, config: Config, method: Method) -> tuple[Config, Method]:
    """The settings of networks so many times as wide, and a planner that nobody advises."""
    network, own = config.network, method.high.network  # type: ignore[attr-defined]
    wide = {"features": width * own.features, "hidden": width * own.hidden, "advice": 0.0}
    wide["policy"] = tuple(width * size for size in own.policy)
    encoder = {"latent": width * network.latent, "encoder_mlp": tuple(width * size for size in network.encoder_mlp)}
    changed = evolve(config, {f"network.{name}": value for name, value in encoder.items()})
    planner = {"high.values_paths": False} | {f"high.network.{name}": value for name, value in wide.items()}
    return changed, evolve(method, planner)


def _by_margin(right: Bool[np.ndarray, " B"], margin: Float32[np.ndarray, " B"]) -> list[tuple[float, int, float]]:
    """For each whole margin, from 5 on together: itself, how many cases have it, and how many of them are right."""
    whole = np.minimum(np.round(margin), 5)
    return [(float(m), int((whole == m).sum()), float(right[whole == m].mean())) for m in np.unique(whole)]


def main() -> None:
    """The command line."""
    flags = tyro.cli(Flags, description=__doc__)
    prepare()
    curve = []
    for row in train(flags):
        curve.append(row)
        right = f"best first edge {row['first_choice']:.3f}, chance {row['chance']:.3f}"
        print(f"{row['samples']:,} samples, loss {row['loss']:.3f}, {right}", file=sys.stderr, flush=True)
    shared = {key: curve[-1][key] for key in ("suite", "by", "episodes", "excluded", "chance")}
    columns = ("samples", "drawn", "loss", "first_choice", "first_choice_interval")
    settings = {**dataclasses.asdict(flags), "out": None}
    shared["margins"] = curve[-1]["margins"]
    report = {"flags": settings, **shared, "curve": {name: [row[name] for row in curve] for name in columns}}
    text = json.dumps({**report, **circumstances(command=False)}, indent=2)
    print(text)
    if flags.out is not None:
        flags.out.write_text(text + "\n")


if __name__ == "__main__":
    sys.exit(main_guard(main))
