"""From a formula in LTL to an agent that acts on it: milliseconds of the first and of later formulas; one JSON object.

python -m benchmarks.formulas [--env letter12] [--suite deepltl/letter_finite] [--out FILE]

A later formula needs no compilation: the program that acts is the same for all of them. Measured are reading and
translating it, with the trees that its states show, and an episode that ends after its first action.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from hrlspec.agent.agent import Agent
from hrlspec.evaluation.episodes import run_episodes
from hrlspec.evaluation.ltl import ltl_suite
from hrlspec.presets import preset
from hrlspec.presets.peers import go_on_for_ever, peer_formulas
from hrlspec.run.errors import main_guard
from hrlspec.run.platform import prepare
from hrlspec.spec import bare_lines


@dataclasses.dataclass(frozen=True)
class Flags:
    """What to measure."""

    env: str = "letter12"
    suite: str = "deepltl/letter_finite"
    repeat: int = 5
    """How often each formula after the first."""
    out: Path | None = None
    """Where the JSON goes besides standard output."""


def main() -> None:
    """Measures and prints."""
    flags = tyro.cli(Flags, description=__doc__)
    prepare()
    world = preset(flags.env)
    config, method = world.settings()
    env: Any = world.make()
    agent = Agent(dataclasses.replace(env, horizon=1), config, method)
    params = jax.jit(agent.init)(jax.random.key(0))
    layouts = jax.tree.map(lambda x: x[None], env.sample_layout(jax.random.key(1), env.default_params))
    formulas = [line for line in bare_lines(peer_formulas(flags.suite)) if line.strip()]

    def once(formula: str) -> tuple[float, float]:
        """Milliseconds until there is an automaton, and from there to the first action."""
        before = time.perf_counter()
        suite = ltl_suite("formula", formula, env, forever=go_on_for_ever(flags.suite))
        between = time.perf_counter()
        one = np.zeros(1, int)
        episode = run_episodes(jax.random.key(2), agent, params, world.rewards(), suite.automata, layouts, which=one)
        jax.block_until_ready(episode)
        return 1e3 * (between - before), 1e3 * (time.perf_counter() - between)

    first = once(formulas[0])
    later = [once(formula) for formula in formulas[1:] for _ in range(flags.repeat)]
    names = ("translate_ms", "action_ms")
    result = {
        "env": flags.env,
        "suite": flags.suite,
        "jax": jax.__version__,
        "first": dict(zip(names, first, strict=True)),
        "later": {
            name: {"median": statistics.median(values), "max": max(values)}
            for name, values in zip(names, zip(*later, strict=True), strict=True)
        },
    }
    text = json.dumps(result, indent=1)
    print(text)
    if flags.out is not None:
        flags.out.write_text(text + "\n")


if __name__ == "__main__":
    sys.exit(main_guard(main))
