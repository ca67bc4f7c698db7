"""Pictures of episodes: trajectories, task graphs, animations; and of automata.

Axes: **B** episodes, **H** horizon.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import subprocess
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from envs_jax import Drawable, Environment
from envs_jax.base import Layout, State
from envs_jax.scenes import Leg, Scene
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.evaluation import Suite
from hrlspec.evaluation.cases import draw_layouts
from hrlspec.evaluation.episodes import Episodes, Trace, trace_episodes
from hrlspec.run.figures import save
from hrlspec.run.files import replacing
from hrlspec.run.timeline import Timeline
from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, TaskState, TaskTree, draw_task, subtasks
from hrlspec.spec.draw_automaton import draw_automaton
from hrlspec.spec.ltl import Automaton
from hrlspec.tasks.rewards import RewardMachine

_FRAME_MS, _LAST_FRAME_MS = 350, 1500
_MOST_FRAMES = 80


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode, for drawing.

    Attributes:
        formula: the task.
        tree: the same, unbatched.
        scene: where it took place.
        positions: ``[t + 1, D]``, where the agent was in the scene, the end included.
        nodes: int ``[t + 1]``, where the task stood.
        assigned: int ``[t]``, the edge in force at each step.
        success: the task was satisfied.
        violated: the task was violated, or the environment ended the episode.
    """

    formula: str
    tree: TaskTree
    scene: Scene
    positions: np.ndarray
    nodes: np.ndarray
    assigned: np.ndarray
    success: bool
    violated: bool

    def legs(self, names: Sequence[str]) -> list[Leg]:
        """The sub-tasks in the order in which they were in force."""
        changes = [0] + [
            t
            for t in range(1, len(self.assigned))
            if self.nodes[t] != self.nodes[t - 1] or self.assigned[t] != self.assigned[t - 1]
        ]
        legs = []
        for number, (first, end) in enumerate(zip(changes, [*changes[1:], len(self.assigned)], strict=True), 1):
            completed = self.nodes[end] != self.nodes[end - 1]
            # A flat policy is assigned nothing: what it completed was its sub-task, whatever it meant to do.
            edge = int(self.assigned[first]) or int(completed * self.nodes[end])
            if edge == TaskTree.ROOT:
                legs.append(Leg(first, end - 1, f"{number}. what remains", (), (), False))
                continue
            (found,) = [x for x in subtasks(self.tree, int(self.tree.parent[edge]), names) if x.node == edge]
            reach, avoid = (tuple(str(name) for name in some) for some in (found.reach, found.avoid))
            label = f"{number}. {' and '.join(reach)}" + (f", avoiding {' '.join(avoid)}" if avoid else "")
            legs.append(Leg(first, end - 1, label, reach, avoid, bool(completed)))
        return legs

    @property
    def outcome(self) -> str:
        """How it ended."""
        return "satisfied" if self.success else "violated" if self.violated else "not satisfied in time"


def examples(
    key: jax.Array, agent: Agent, params: Params, machine: RewardMachine, suite: Suite, folder: Path
) -> list[Path]:
    """Lets an agent carry out one task of each depth and draws it.

    Args:
        key: consumed.
        agent: the networks.
        params: their parameters.
        machine: the rewards.
        suite: unseen tasks; of those with a choice the shortest to write are taken.
        folder: where the pictures go.

    Returns:
        ``example_<depth>.png`` and ``task_<depth>.png`` for each depth, and ``episode.gif`` of the deepest.
    """
    has_choice = np.asarray(suite.trees.accepting).sum(-1) > 1
    length = np.array([len(formula) for formula in suite.formulas]) + 10_000 * ~has_choice
    depths = np.unique(suite.depths)
    rows = [int(np.argmin(np.where(suite.depths == depth, length, np.iinfo(int).max))) for depth in depths]
    files: list[Path] = []
    names = agent.env.propositions
    shown = episodes_of(key, agent, params, machine, suite.take(rows))
    for depth, episode in zip(depths, shown, strict=True):
        files += [folder / f"example_{depth}.png", folder / f"task_{depth}.png"]
        trajectory(episode, names, files[-2])
        task_graph(episode, names, files[-1])
    return [*files, animation(shown[-1:], names, folder / "episode.gif")]


def episodes_of(key: jax.Array, agent: Agent, params: Params, machine: RewardMachine, suite: Suite) -> list[Episode]:
    """One episode of each task of a suite, each in a layout of its own, actions sampled."""
    layouts = draw_layouts(agent.env, suite, 1)
    ended, trace = jax.device_get(trace_episodes(key, agent, params, machine, suite.trees, layouts))
    found = []
    for i, formula in enumerate(suite.formulas):
        tree, layout, end = jax.tree.map(lambda x, i=i: x[i], (suite.trees, layouts, ended))
        found.append(episode_of(agent.env, formula, tree, layout, end, trace, i))
    return found


def episode_of(
    env: Environment, formula: str, tree: TaskTree, layout: Layout, ended: Episodes, trace: Trace, index: int
) -> Episode:
    """One of the episodes of a trace, for drawing.

    Args:
        env: the environment.
        formula: the task.
        tree: the same, unbatched.
        layout: where it took place, unbatched (numpy).
        ended: how it ended, unbatched.
        trace: what happened in B episodes.
        index: which of them it is.
    """
    # Entry t is the state before step t, so the one after the last step is there unless the horizon came first.
    end = min(int(ended.steps) + 1, len(trace.node))
    positions = _positions(env, jax.tree.map(lambda x: x[:, index], trace.env_state))
    return Episode(
        formula=formula,
        tree=tree,
        scene=env.scene(layout) if isinstance(env, Drawable) else Timeline(env.propositions),
        positions=np.asarray(positions)[:end],
        nodes=np.asarray(trace.node)[:end, index],
        assigned=np.asarray(trace.assigned)[: end - 1, index],
        success=bool(ended.success),
        violated=bool(ended.violated),
    )


@functools.partial(jax.jit, static_argnums=0)
def _positions(env: Environment, states: State) -> jax.Array:
    """Where the agent is in its scene, ``[H, D]``; on a timeline that is what holds, bool ``[H, P]``."""
    if isinstance(env, Drawable):
        return jax.vmap(env.position)(states)
    return jax.vmap(env.labels, (0, None))(states, env.default_params)


def trajectory(episode: Episode, names: Sequence[str], file: Path) -> Path:
    """Draws an episode as a line, coloured by the sub-task in force; chosen instances are marked."""
    figure = Figure(figsize=(7.5, 5.2), layout="constrained")
    ax = figure.subplots()
    episode.scene.draw(ax, episode.positions, episode.legs(names))
    title = "\n".join(textwrap.wrap(episode.formula, 80))
    ax.set_title(f"{title}\n{episode.outcome}, {len(episode.assigned)} steps", fontsize=9)
    figure.legend(loc="outside right center", title="sub-tasks", fontsize=9)
    return save(figure, file)


def gallery(episodes: Sequence[Episode], names: Sequence[str], file: Path) -> Path:
    """Several episodes side by side, as `trajectory` draws each; the file's ending says in which format."""
    columns = min(len(episodes), 3)
    rows = -(-len(episodes) // columns)
    figure = Figure(figsize=(5 * columns, 5.2 * rows), layout="constrained")
    axes: Any = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat[len(episodes) :]:
        ax.set_axis_off()
    for ax, episode in zip(axes.flat, episodes, strict=False):
        episode.scene.draw(ax, episode.positions, episode.legs(names))
        title = "\n".join(textwrap.wrap(episode.formula, 60))
        ax.set_title(f"{title}\n{episode.outcome}, {len(episode.assigned)} steps", fontsize=9)
        ax.legend(loc="upper right", fontsize=7)
    return save(figure, file)


def task_graph(episode: Episode, names: Sequence[str], file: Path) -> Path:
    """Draws the task with the branch that was taken."""
    status = SATISFIED if episode.success else VIOLATED if episode.violated else RUNNING
    blocked = np.zeros(episode.tree.num_nodes, bool)
    state = TaskState(node=episode.nodes[-1], blocked=blocked, status=np.int32(status))  # type: ignore[arg-type]
    return save(draw_task(episode.tree, names, state), file)


def automaton_graph(automaton: Automaton, task: str, file: Path) -> Path:
    """Draws an automaton below its task; the file's ending says in which format."""
    figure = draw_automaton(automaton)
    figure.suptitle("\n".join(textwrap.wrap(task, 80)), fontsize=9)
    return save(figure, file)


def animation(episodes: Sequence[Episode], names: Sequence[str], file: Path) -> Path:
    """Episodes one after the other, the sub-task in force below; of a long one every so many steps.

    Args:
        episodes: at least one, all in one environment.
        names: of the propositions.
        file: a GIF, or a video if it ends in .mp4.
    """
    frames: list[Image.Image] = []
    durations: list[int] = []
    for number, episode in enumerate(episodes, start=1):
        some = _frames(episode, names, f"task {number}, " if len(episodes) > 1 else "")
        pause = _FRAME_MS if len(some) == len(episode.positions) else _FRAME_MS // 4
        frames += some
        durations += [pause] * (len(some) - 1) + [_LAST_FRAME_MS]
    gif = io.BytesIO()
    frames[0].save(gif, format="GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0)
    with replacing(file) as new:
        if file.suffix == ".mp4":
            _encode(gif.getvalue(), new)
        else:
            new.write_bytes(gif.getvalue())
    return file


def _frames(episode: Episode, names: Sequence[str], before: str) -> list[Image.Image]:
    legs, last = episode.legs(names), len(episode.positions) - 1
    stride = -(-len(episode.positions) // _MOST_FRAMES)
    frames = []
    for t in (*range(0, last, stride), last):
        leg = next((leg for leg in legs if leg.first <= t <= leg.last), None)
        picture = episode.scene.frame(episode.positions, t, leg)
        caption = f"{before}step {t}: {leg.label if leg else episode.outcome}"
        frame = Image.new("RGB", (picture.shape[1], picture.shape[0] + 28), "white")
        frame.paste(Image.fromarray(picture), (0, 0))
        ImageDraw.Draw(frame).text((8, picture.shape[0] + 6), caption, fill="black", font_size=15)
        # A palette without dithering keeps the file small and the colours flat.
        frames.append(frame.quantize(64, dither=Image.Dither.NONE))
    return frames


def _encode(gif: bytes, file: Path) -> None:
    """Writes an animation as a video.

    Raises:
        OSError: the encoder says that it cannot.
    """
    from imageio_ffmpeg import get_ffmpeg_exe

    # The format that every player knows takes even sizes alone.
    picture = "fps=25,pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white", "-pix_fmt", "yuv420p"
    command = [get_ffmpeg_exe(), "-v", "error", "-y", "-f", "gif", "-i", "-", "-vf", *picture, str(file)]
    ended = subprocess.run(command, input=gif, capture_output=True, check=False)
    if ended.returncode:
        raise OSError(ended.stderr.decode(errors="replace"))
