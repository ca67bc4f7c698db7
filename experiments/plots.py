"""Pictures of runs: learning curves, example trajectories, task graphs, one animation.

Axes: **B** episodes, **H** horizon.
"""

from __future__ import annotations

import dataclasses
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from envs_jax import Letter
from envs_jax.letter_render import rgb
from hrlspec.agent import Agent, Params
from hrlspec.evaluation import Suite
from hrlspec.evaluation.cases import draw_layouts
from hrlspec.evaluation.episodes import trace_episodes
from hrlspec.rewards import RewardMachine
from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, TaskState, TaskTree, draw_task, subtasks

_CELL = 48  # pixels of a cell
_COLORS = ("#1f5fa8", "#c2452d", "#2e8b57", "#8a4fbf", "#b8860b", "#c2408f", "#4d4d4d", "#008b8b")
_FRAME_MS, _LAST_FRAME_MS = 350, 1500
_CURVES = {
    "eval/success_rate": "success on unseen tasks",
    "eval/spl": "SPL on unseen tasks",
    "eval/return_mean": "return on unseen tasks",
    "eval/steps_mean": "steps of successful episodes",
    "train/success_rate": "success while training",
    "level": "curriculum level",
}


def learning_curves(runs: Mapping[str, Sequence[Mapping[str, Any]]], file: Path) -> Path:
    """Draws the rows of ``metrics.jsonl`` of one run or several, each a line, and returns the PNG's path."""
    figure = Figure(figsize=(12, 6), layout="constrained")
    for ax, (name, title) in zip(figure.subplots(2, 3).flat, _CURVES.items(), strict=True):
        for label, rows in runs.items():
            points = [(row["env_steps"], row[name]) for row in rows if row.get(name) is not None]
            if points:
                steps, values = zip(*points, strict=True)
                ax.plot(np.array(steps) / 1e6, values, label=label, marker="." if len(points) < 10 else None)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("million environment steps", fontsize=8)
        ax.grid(alpha=0.3)
        if "success" in name or name == "eval/spl":
            ax.set_ylim(-0.02, 1.02)
    if len(runs) > 1:
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    figure.savefig(file, dpi=110, metadata={"Software": None})
    return file


@dataclasses.dataclass(frozen=True)
class Walk:
    """One episode in Letter, for drawing.

    Attributes:
        formula: the task.
        tree: the same, unbatched.
        layout: int ``[n, n]``.
        cells: int ``[t + 1, 2]``, where the agent was, the end included.
        nodes: int ``[t + 1]``, where the task stood.
        assigned: int ``[t]``, the edge in force at each step.
        success: the task was satisfied.
        violated: the task was violated.
    """

    formula: str
    tree: TaskTree
    layout: np.ndarray
    cells: np.ndarray
    nodes: np.ndarray
    assigned: np.ndarray
    success: bool
    violated: bool


def examples(
    key: jax.Array, agent: Agent, params: Params, machine: RewardMachine, suite: Suite, folder: Path
) -> list[Path]:
    """Lets an agent carry out one task of each depth and draws it; only for environments that have pictures.

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
    if not isinstance(agent.env, Letter):
        return []
    has_choice = np.asarray(suite.trees.accepting).sum(-1) > 1
    length = np.array([len(formula) for formula in suite.formulas]) + 10_000 * ~has_choice
    depths = np.unique(suite.depths)
    rows = [int(np.argmin(np.where(suite.depths == depth, length, np.iinfo(int).max))) for depth in depths]
    files = []
    names = agent.env.propositions
    for depth, walk in zip(depths, walks(key, agent, params, machine, suite.take(rows)), strict=True):
        files += [folder / f"example_{depth}.png", folder / f"task_{depth}.png"]
        trajectory(walk, names, files[-2])
        task_graph(walk, names, files[-1])
    return [*files, animation(walk, names, folder / "episode.gif")]


def walks(key: jax.Array, agent: Agent, params: Params, machine: RewardMachine, suite: Suite) -> list[Walk]:
    """One episode of each task of a suite, each in a layout of its own, actions sampled."""
    layouts = draw_layouts(agent.env, suite, 1)
    episodes, trace = trace_episodes(key, agent, params, machine, suite.trees, layouts)
    found = []
    for i, formula in enumerate(suite.formulas):
        # Entry t is the state before step t, so the one after the last step is there unless the horizon came first.
        steps = int(episodes.steps[i])
        end = min(steps + 1, len(trace.node))
        tree: TaskTree = jax.tree.map(lambda x, i=i: x[i], suite.trees)
        found.append(
            Walk(
                formula=formula,
                tree=tree,
                layout=np.asarray(layouts)[i],
                cells=np.asarray(trace.env_state.position)[:end, i],
                nodes=np.asarray(trace.node)[:end, i],
                assigned=np.asarray(trace.assigned)[:steps, i],
                success=bool(episodes.success[i]),
                violated=bool(episodes.violated[i]),
            )
        )
    return found


def trajectory(walk: Walk, names: Sequence[str], file: Path) -> Path:
    """Draws an episode as a line over the grid, coloured by the sub-task in force; chosen instances are circled."""
    figure = Figure(figsize=(7.5, 5.2), layout="constrained")
    ax = figure.subplots()
    size = walk.layout.shape[0]
    ax.imshow(rgb(walk.layout, walk.cells[0], cell_pixels=_CELL), extent=(-0.5, size - 0.5, size - 0.5, -0.5))
    leg = 0  # counts assignments, from 1
    for t in range(len(walk.cells) - 1):
        label = None
        if t == 0 or walk.nodes[t] != walk.nodes[t - 1] or walk.assigned[t] != walk.assigned[t - 1]:
            leg += 1
            label = f"{leg}. {_subtask(walk, int(walk.assigned[t]), names)}"
        color = _COLORS[(leg - 1) % len(_COLORS)]
        _draw_step(ax, walk.cells[t], walk.cells[t + 1], color, label, shift=0.06 * (leg % 5 - 2))
        if walk.nodes[t + 1] != walk.nodes[t]:
            row, column = walk.cells[t + 1]
            ax.plot(column, row, "o", markersize=30, markerfacecolor="none", markeredgecolor=color, markeredgewidth=3)
            ax.annotate(str(leg), (column + 0.3, row - 0.3), color=color, weight="bold", fontsize=11)
    outcome = "satisfied" if walk.success else "violated" if walk.violated else "not satisfied in time"
    title = "\n".join(textwrap.wrap(walk.formula, 80))
    ax.set_title(f"{title}\n{outcome}, {len(walk.assigned)} steps", fontsize=9)
    ax.set_axis_off()
    figure.legend(loc="outside right center", title="sub-tasks", fontsize=9)
    figure.savefig(file, dpi=110, metadata={"Software": None})
    return file


def task_graph(walk: Walk, names: Sequence[str], file: Path) -> Path:
    """Draws the task with the branch that was taken."""
    status = SATISFIED if walk.success else VIOLATED if walk.violated else RUNNING
    blocked = np.zeros(walk.tree.num_nodes, bool)
    state = TaskState(node=walk.nodes[-1], blocked=blocked, status=np.int32(status))  # type: ignore[arg-type]
    draw_task(walk.tree, names, state).savefig(file, dpi=110, metadata={"Software": None})
    return file


def animation(walk: Walk, names: Sequence[str], file: Path) -> Path:
    """The episode as a GIF, the sub-task in force below the grid."""
    frames = []
    for t in range(len(walk.cells)):
        grid = rgb(walk.layout, walk.cells[t], trail=walk.cells[:t], cell_pixels=_CELL)
        if t < len(walk.assigned):
            caption = f"step {t}: {_subtask(walk, int(walk.assigned[t]), names)}"
        else:
            caption = f"step {t}: {'satisfied' if walk.success else 'violated' if walk.violated else 'out of time'}"
        frame = Image.new("RGB", (grid.shape[1], grid.shape[0] + 28), "white")
        frame.paste(Image.fromarray(grid), (0, 0))
        ImageDraw.Draw(frame).text((8, grid.shape[0] + 6), caption, fill="black", font_size=15)
        # A palette without dithering keeps the file small and the colours flat.
        frames.append(frame.quantize(64, dither=Image.Dither.NONE))
    durations = [_FRAME_MS] * (len(frames) - 1) + [_LAST_FRAME_MS]
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=durations, loop=0)
    return file


def _draw_step(ax: Axes, here: np.ndarray, there: np.ndarray, color: str, label: str | None, shift: float) -> None:
    """One move; over the edge of the torus it leaves on one side and comes back on the other."""
    move = there - here
    style: dict[str, Any] = {"color": color, "linewidth": 2.5, "solid_capstyle": "round"}
    if np.abs(move).max() <= 1:
        ax.plot([here[1] + shift, there[1] + shift], [here[0] + shift, there[0] + shift], label=label, **style)
        return
    step = -np.sign(move) * 0.45
    for at, to in ((here, here + step), (there - step, there)):
        ax.plot([at[1] + shift, to[1] + shift], [at[0] + shift, to[0] + shift], label=label, **style)
        label = None


def _subtask(walk: Walk, edge: int, names: Sequence[str]) -> str:
    """Such as ``a, avoiding c d``."""
    parent = int(walk.tree.parent[edge])
    (found,) = [each for each in subtasks(walk.tree, parent, names) if each.node == edge]
    avoid = " ".join(str(name) for name in found.avoid)
    return " and ".join(str(name) for name in found.reach) + (f", avoiding {avoid}" if avoid else "")
