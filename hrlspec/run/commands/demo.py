"""``python -m experiments.demo rooms|dilemma``: the paper's two motivating examples, trained on and drawn.

``rooms``: red ball, then blue ball, behind a door whose key lies at the start. Who thinks of one sub-task at a time
comes back for the key. ``dilemma``: reaching a completes the task, and closes off c, which pays ten times as much.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro
from rich.table import Table

from envs_jax.rooms import COLUMNS, DILEMMA, DILEMMA_TASK, DOORS, MIDDLE, ROWS, Rooms, fewest_steps
from hrlspec import Agent, Trainer, compile, parse
from hrlspec.config import Config
from hrlspec.evaluation.episodes import Episodes, Trace, trace_episodes
from hrlspec.presets.settings import preset
from hrlspec.run import platform
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import Method, RewardSet
from hrlspec.run.flags import parse_flags
from hrlspec.run.learner import BANK_ITERATIONS
from hrlspec.run.progress import ProgressDisplay
from hrlspec.run.tables import plain_table, result_console
from hrlspec.tasks.curriculum import draw_bank
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine

PROGRAM = "python -m experiments.demo"
LAYOUTS = 200
"""Episodes behind each figure of the table."""


@dataclasses.dataclass(frozen=True)
class DemoFlags:
    """Trains each method on one of the paper's motivating examples and draws what it does."""

    world: tyro.conf.Positional[Literal["rooms", "dilemma"]]
    """rooms: a key to think of; dilemma: a reward to do without."""
    seed: int = 0
    steps: int | None = None
    """Environment steps of each method; 0.6 M in rooms and 1 M in dilemma if not given."""
    out: Path = Path("runs")
    """Folder for the picture."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """One example.

    Attributes:
        env: the world.
        task: what is asked for, a task like those of the curriculum.
        methods: who is trained.
        steps: environment steps.
        like: the environment and the reward set whose preset serves here.
        levels: of the curriculum.
        height: of the picture in inches.
        draw: draws a layout and the positions ``[t + 1, 2]`` of an episode.
        bonuses: what orders of propositions earn beyond the 1 for the task.
        ways: what is to be told from each other, by name: the steps it takes in a layout; the best first.
    """

    env: Any
    task: str
    methods: tuple[Method, ...]
    steps: int
    like: tuple[str, RewardSet]
    levels: int
    height: float
    draw: Callable[[Any, Any, np.ndarray], None]
    bonuses: tuple[Bonus, ...] = ()
    ways: Mapping[str, Callable[[Any], int]] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def machine(self) -> RewardMachine:
        """The rewards; made when asked for, since making them takes hold of the device."""
        return reward_machine(self.env.propositions, bonuses=self.bonuses)

    def config(self, method: Method, steps: int) -> Config:
        """Settings of a method."""
        env_name, reward_set = self.like
        config = preset(env_name, "hrlspec", reward_set, method)
        # The ball behind the locked door is found by chance, and rarely: what is found teaches in hindsight, and tasks
        # that are mastered wait for no other.
        curriculum = dataclasses.replace(
            config.curriculum, levels=self.levels, promotion=0.7, contested=0.0, tasks_per_level=64
        )
        return dataclasses.replace(
            config,
            total_steps=steps,
            # The worlds are small, and so are the runs: many updates, and noise that does not end at the walls.
            num_envs=128,
            noise_correlation=0.95,
            final_noise_correlation=0.95,
            discount=max(config.discount, 0.95),
            low=dataclasses.replace(config.low, minibatches=16),
            curriculum=curriculum,
            relabel=dataclasses.replace(config.relabel, visits=True),
            # Turning the rooms would move their doors.
            network=dataclasses.replace(config.network, symmetric=False),
        )


def main(argv: Sequence[str] | None = None) -> None:
    """The command line.

    Args:
        argv: the arguments, those of the process by default.

    Raises:
        UserError: bad usage.
    """
    flags = parse_flags(DemoFlags, sys.argv[1:] if argv is None else argv, program=PROGRAM)
    demo = DEMOS[flags.world]
    steps = demo.steps if flags.steps is None else flags.steps
    if steps < 1:
        raise UserError(f"--steps is {steps}, expected at least 1")
    platform.prepare("letter", "hrlspec")
    shown = {method: act(demo, train(demo, method, steps, flags.seed), flags.seed) for method in demo.methods}
    result_console().print(table(demo, shown))
    flags.out.mkdir(parents=True, exist_ok=True)
    print(f"picture: {draw(demo, shown, flags.out / f'demo-{flags.world}.png')}")


def train(demo: Demo, method: Method, steps: int, seed: int) -> tuple[Agent, Any]:
    """An agent trained on random tasks in the world, and its parameters. The task itself may be among them."""
    config = demo.config(method, steps)
    trainer = Trainer(Agent(demo.env, config))
    nothing, rng = np.zeros(0, np.uint32), np.random.default_rng(seed)
    state, bank = None, None
    with ProgressDisplay(config.num_iterations * config.steps_per_iteration, f"{demo.env.name}, {method}") as display:
        for i in range(config.num_iterations):
            if i % BANK_ITERATIONS == 0:
                bank = draw_bank(rng, config.curriculum, demo.env.num_propositions, nothing)
            if state is None:
                state = trainer.init(jax.random.key(seed), bank, demo.machine)
            state, metrics = trainer.iterate(state, bank, demo.machine, nothing)
            display.advance((i + 1) * config.steps_per_iteration, {k: float(v) for k, v in metrics.items()})
    assert state is not None
    return trainer.agent, state.params


@dataclasses.dataclass(frozen=True)
class Shown:
    """What a method does, in the same layouts for all.

    Attributes:
        layouts: leading axis B.
        episodes: how they ended.
        trace: what happened, leading axes H, B.
    """

    layouts: Any
    episodes: Episodes
    trace: Trace


def act(demo: Demo, trained: tuple[Agent, Any], seed: int) -> Shown:
    """Lets an agent carry out the task in many layouts, greedily."""
    agent, params = trained
    tree = compile(parse(demo.task), demo.env.propositions, max_nodes=agent.config.curriculum.max_nodes)
    trees = jax.tree.map(lambda x: np.stack([x] * LAYOUTS), tree)
    keys = jax.random.split(jax.random.key(seed + 1), LAYOUTS)
    layouts = jax.vmap(demo.env.sample_layout, (0, None))(keys, demo.env.default_params)
    key = jax.random.key(seed + 2)
    episodes, trace = trace_episodes(key, agent, params, demo.machine, trees, layouts, greedy=True)
    return Shown(jax.tree.map(np.asarray, layouts), episodes, trace)


def table(demo: Demo, shown: dict[Method, Shown]) -> Table:
    """Success, steps and return of each method; in the rooms what thinking ahead and not doing so would take."""
    result = plain_table(demo.task, ("method", "success", "steps", "return"))
    for method, some in shown.items():
        episodes = some.episodes
        steps = episodes.steps[episodes.success].mean() if episodes.success.any() else float("nan")
        result.add_row(method, f"{episodes.success.mean():.3f}", f"{steps:.1f}", f"{episodes.returns.mean():.2f}")
    for name, steps in ways(demo, shown).items():
        result.add_row(name, "1.000", f"{steps.mean():.1f}", "1.00")
    return result


def ways(demo: Demo, shown: Mapping[Method, Shown]) -> dict[str, np.ndarray]:
    """What each of the example's ways takes in each of the layouts, int ``[B]``."""
    layouts = next(iter(shown.values())).layouts
    each = [jax.tree.map(lambda x, i=i: x[i], layouts) for i in range(LAYOUTS)]
    return {name: np.array([way(layout) for layout in each]) for name, way in demo.ways.items()}


def draw(demo: Demo, shown: dict[Method, Shown], file: Path) -> Path:
    """One episode of each method, in the same layout: the one where most is at stake."""
    from matplotlib.figure import Figure

    steps_of_ways = [*ways(demo, shown).values()]
    index = int(np.argmax(steps_of_ways[-1] - steps_of_ways[0])) if steps_of_ways else 0
    figure = Figure(figsize=(5 * len(shown), demo.height), layout="constrained")
    axes: Any = figure.subplots(1, len(shown), squeeze=False)
    for ax, (method, some) in zip(axes[0], shown.items(), strict=True):
        running = np.asarray(some.trace.running)[:, index]
        positions = np.asarray(some.trace.env_state.position)[: running.sum() + 1, index]
        layout = jax.tree.map(lambda x: x[index], some.layouts)
        demo.draw(ax, layout, positions)
        steps, earned = int(some.episodes.steps[index]), float(some.episodes.returns[index])
        ax.set_title(f"{method}: {steps} steps, return {earned:g}", fontsize=10)
        ax.set_axis_off()
    figure.suptitle(demo.task, fontsize=10)
    figure.savefig(file, dpi=110, metadata={"Software": None})
    return file


def _draw_rooms(ax: Any, layout: Any, positions: np.ndarray) -> None:
    walls = np.zeros((ROWS, COLUMNS))
    walls[:, list(DOORS)] = 1
    walls[MIDDLE, DOORS[0]], walls[MIDDLE, DOORS[1]] = 0, 0.4
    ax.imshow(walls, cmap="Greys", vmin=0, vmax=1.4, extent=(-0.5, COLUMNS - 0.5, ROWS - 0.5, -0.5))
    for cell, color in ((layout.red, "tab:red"), (layout.blue, "tab:blue")):
        ax.plot(cell[1], cell[0], "o", color=color, markersize=16)
    ax.text(layout.key[1], layout.key[0], "key", ha="center", va="center", fontsize=9)
    # Each move a little aside from the one before, so that a way back can be told from the way there.
    aside = np.linspace(-0.2, 0.2, len(positions))
    ax.plot(positions[:, 1] + aside, positions[:, 0] + aside, color="tab:green", linewidth=1.5)
    ax.plot(positions[0, 1] + aside[0], positions[0, 0] + aside[0], "s", color="tab:green", markersize=6)


def _draw_discs(ax: Any, layout: Any, positions: np.ndarray) -> None:
    from matplotlib.patches import Circle

    del layout  # there is one alone
    for name, x, y, radius in DILEMMA.discs:
        ax.add_patch(Circle((x, y), radius, color="tab:orange" if name == "c" else "tab:gray", alpha=0.4))
        ax.text(x, y, name, ha="center", va="center")
    ax.plot(positions[:, 0], positions[:, 1], color="tab:green")
    ax.plot(*positions[0], "s", color="tab:green")
    ax.set_xlim(-1, 9)
    ax.set_ylim(-1, 4)
    ax.set_aspect("equal")


DEMOS = {
    "rooms": Demo(
        Rooms(),
        "achieve red; achieve blue",
        ("ours", "option"),
        600_000,
        like=("letter", 1),
        levels=2,  # two colours make no longer tasks
        height=2.4,
        draw=_draw_rooms,
        ways={
            "key first: best": functools.partial(fewest_steps, key_first=True),
            "red first: myopic": functools.partial(fewest_steps, key_first=False),
        },
    ),
    "dilemma": Demo(
        DILEMMA,
        DILEMMA_TASK,
        ("ours", "option", "ltl2action"),
        1_000_000,
        like=("walk", 2),
        levels=3,
        height=4.6,
        draw=_draw_discs,
        bonuses=(Bonus("b", "c", 9.0),),
    ),
}
