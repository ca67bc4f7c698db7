"""``hrlspec demo rooms|dilemma``: the paper's two motivating examples, trained on and drawn.

``rooms``: red ball, then blue ball, behind a door whose key lies at the start. Who thinks of one sub-task at a time
comes back for the key. ``dilemma``: reaching a completes the task, and closes off c, which pays ten times as much.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro
from rich.table import Table

from envs_jax import Environment
from envs_jax.base import Layout
from envs_jax.rooms.world import fewest_steps
from hrlspec import compile_task, parse
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.config import Checked, evolve, setting
from hrlspec.evaluation.episodes import Episodes, Trace, trace_episodes
from hrlspec.learning.train import Trainer
from hrlspec.presets import Preset, RewardSet
from hrlspec.presets.demos import DILEMMA, ROOMS
from hrlspec.run import platform
from hrlspec.run.circumstances import circumstances
from hrlspec.run.console import result_console
from hrlspec.run.errors import UserError
from hrlspec.run.extras import check_drawing, drawing
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import check_writable
from hrlspec.run.programs import Program
from hrlspec.run.progress import ProgressDisplay
from hrlspec.run.tables import plain_table
from hrlspec.spec import TaskTree
from hrlspec.tasks.bank import TaskBanks
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine

LAYOUTS = 200
"""Episodes behind each figure of the table."""


@dataclasses.dataclass(frozen=True)
class DemoFlags(Checked):
    """Trains each method on one of the paper's motivating examples and draws what it does."""

    world: tyro.conf.Positional[Literal["rooms", "dilemma"]]
    """rooms: a key to think of; dilemma: a reward to do without."""
    seed: int = setting(0, least=0, most=2**31 - 1)
    num_seeds: int = setting(1, least=1, most=1000)
    """How many, one after another; the picture is of the first."""
    methods: tuple[str, ...] = ()
    """Some of those that are compared, such as ours; all if not given."""
    steps: int | None = setting(None, least=1, most=2**40)
    """Environment steps of each method; 0.6 M in rooms and 2 M in dilemma if not given."""
    out: Path = Path("runs")
    """Folder for the picture, and for a record of each method and seed: demo-rooms.jsonl."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """One example.

    Attributes:
        preset: the world.
        reward_set: whose settings serve here.
        task: what is asked for, a task like those of the curriculum.
        methods: who is trained.
        steps: environment steps.
        height: of the picture in inches.
        bonuses: what orders of propositions earn beyond the 1 for the task.
        ways: what is to be told from each other, by name: the steps it takes in a layout; the best first.
    """

    preset: Preset
    reward_set: RewardSet
    task: str
    methods: tuple[str, ...]
    steps: int
    height: float
    bonuses: tuple[Bonus, ...] = ()
    ways: Mapping[str, Callable[[Layout], int]] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def env(self) -> Environment:
        """The world."""
        return self.preset.make()

    @functools.cached_property
    def machine(self) -> RewardMachine:
        """The rewards; made when asked for, since making them takes hold of the device."""
        return reward_machine(self.env.propositions, bonuses=self.bonuses)

    def agent(self, name: str, steps: int) -> Agent:
        """A method in this world."""
        config, method = self.preset.settings(name, "hrlspec", self.reward_set)
        return Agent(self.env, evolve(config, {"total_steps": steps}), method)


def main(argv: Sequence[str], *, program: str = "hrlspec demo") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage.
    """
    flags = parse_flags(DemoFlags, argv, program=program)
    demo = DEMOS[flags.world]
    for method in flags.methods:
        if method not in demo.methods:
            expected = ", ".join(demo.methods)
            raise UserError(f"--methods {method}: it is not compared in {flags.world}, expected some of: {expected}")
    methods = flags.methods or demo.methods
    steps = demo.steps if flags.steps is None else flags.steps
    check_writable(flags.out)
    check_drawing()
    platform.prepare()
    shown: dict[tuple[str, int], Shown] = {}
    flags.out.mkdir(parents=True, exist_ok=True)
    for method in methods:
        for seed, trained in train(demo, method, steps, range(flags.seed, flags.seed + flags.num_seeds)):
            shown[method, seed] = act(demo, trained, seed)
            line = {
                "world": flags.world,
                "method": method,
                "seed": seed,
                "steps": steps,
                **shown[method, seed].scores(),
            }
            with (flags.out / f"demo-{flags.world}.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps({**line, **circumstances()}) + "\n")
    result_console().print(table(demo, shown))
    with drawing():
        first = {method: shown[method, flags.seed] for method in methods}
        print(f"picture: {draw(demo, first, flags.out / f'demo-{flags.world}.png')}")


def train(demo: Demo, method: str, steps: int, seeds: Iterable[int]) -> Iterator[tuple[int, tuple[Agent, Params]]]:
    """For each seed an agent trained on random tasks in the world, and its parameters.

    The task itself may be among them.
    """
    trainer = Trainer(demo.agent(method, steps))
    config, nothing = trainer.agent.config, np.zeros(0, np.uint32)
    iterate = Program("iterate", Trainer.iterate, trainer, effort=demo.preset.effort("hrlspec"))
    for seed in seeds:
        banks = TaskBanks(seed, config.curriculum, demo.env.num_propositions, nothing)
        state = trainer.init(jax.random.key(seed), banks.at(0), demo.machine)
        title = f"{demo.env.name}, {method}, seed {seed}"
        with ProgressDisplay(config.num_iterations * config.steps_per_iteration, title) as display:
            for i in range(config.num_iterations):
                state, metrics = iterate(state, banks.at(i), demo.machine, nothing)
                display.advance((i + 1) * config.steps_per_iteration, {k: float(v) for k, v in metrics.items()})
        yield seed, (trainer.agent, state.params)


@dataclasses.dataclass(frozen=True)
class Shown:
    """What a method does, in the same layouts for all.

    Attributes:
        tree: the task.
        layouts: leading axis B.
        episodes: how they ended.
        trace: what happened, leading axes H, B.
    """

    tree: TaskTree
    layouts: Layout
    episodes: Episodes
    trace: Trace

    def scores(self) -> dict[str, float | None]:
        """Success rate, mean steps of the episodes that succeed (``None`` if none does), mean return."""
        episodes, success = self.episodes, self.episodes.success
        return {
            "success_rate": float(success.mean()),
            "steps_mean": float(episodes.steps[success].mean()) if success.any() else None,
            "return_mean": float(episodes.returns.mean()),
        }


def act(demo: Demo, trained: tuple[Agent, Params], seed: int) -> Shown:
    """Lets an agent carry out the task in many layouts, greedily."""
    agent, params = trained
    tree = compile_task(parse(demo.task), demo.env.propositions, max_nodes=agent.config.curriculum.max_nodes)
    trees = jax.tree.map(lambda x: np.stack([x] * LAYOUTS), tree)
    keys = jax.random.split(jax.random.key(seed + 1), LAYOUTS)
    layouts = jax.vmap(demo.env.sample_layout, (0, None))(keys, demo.env.default_params)
    key = jax.random.key(seed + 2)
    episodes, trace = jax.device_get(trace_episodes(key, agent, params, demo.machine, trees, layouts, greedy=True))
    return Shown(tree, jax.tree.map(np.asarray, layouts), episodes, trace)


def table(demo: Demo, shown: Mapping[tuple[str, int], Shown]) -> Table:
    """Success, steps and return by method and seed; in the rooms what thinking ahead and not doing so would take."""
    result = plain_table(demo.task, ("method", "seed", "success", "steps", "return"))
    for (method, seed), some in shown.items():
        success, steps, returns = some.scores().values()
        result.add_row(
            method, str(seed), f"{success:.3f}", "never" if steps is None else f"{steps:.1f}", f"{returns:.2f}"
        )
    for name, each in ways(demo, next(iter(shown.values())).layouts).items():
        result.add_row(name, "", "1.000", f"{each.mean():.1f}", "1.00")
    return result


def ways(demo: Demo, layouts: Layout) -> dict[str, np.ndarray]:
    """What each of the example's ways takes in each of the layouts, int ``[B]``."""
    each = [jax.tree.map(lambda x, i=i: x[i], layouts) for i in range(LAYOUTS)]
    return {name: np.array([way(layout) for layout in each]) for name, way in demo.ways.items()}


def draw(demo: Demo, shown: Mapping[str, Shown], file: Path) -> Path:
    """One episode of each method, in the same layout: the one where most is at stake."""
    from matplotlib.figure import Figure

    from hrlspec.run import plots
    from hrlspec.run.figures import save

    steps_of_ways = [*ways(demo, next(iter(shown.values())).layouts).values()]
    index = int(np.argmax(steps_of_ways[-1] - steps_of_ways[0])) if steps_of_ways else 0
    figure = Figure(figsize=(5 * len(shown), demo.height), layout="constrained")
    axes: Any = figure.subplots(1, len(shown), squeeze=False)
    for ax, (method, some) in zip(axes[0], shown.items(), strict=True):
        layout, ended = jax.tree.map(lambda x: x[index], (some.layouts, some.episodes))
        episode = plots.episode_of(demo.env, demo.task, some.tree, layout, ended, some.trace, index)
        episode.scene.draw(ax, episode.positions, episode.legs(demo.env.propositions))
        ax.set_title(f"{method}: {int(ended.steps)} steps, return {float(ended.returns):g}", fontsize=10)
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), fontsize=7)
    figure.suptitle(demo.task, fontsize=10)
    return save(figure, file)


DEMOS = {
    "rooms": Demo(
        ROOMS,
        1,
        "achieve red; achieve blue",
        ("ours", "option"),
        600_000,
        height=2.4,
        ways={
            "key first: best": functools.partial(fewest_steps, key_first=True),
            "red first: myopic": functools.partial(fewest_steps, key_first=False),
        },
    ),
    "dilemma": Demo(
        DILEMMA,
        2,
        "achieve a ensuring not d or achieve b ensuring not d; (achieve c ensuring not d)",
        ("ours", "option", "ltl2action"),
        2_000_000,
        height=6.4,
        bonuses=(Bonus("b", "c", 9.0),),
    ),
}
