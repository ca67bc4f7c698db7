"""Where episodes take place, as pictures: Letter's grid, and worlds of discs seen from above.

Axes: **t** steps of an episode.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes

from envs_jax import Environment, Letter, Walk
from envs_jax.letter import render as letter_render
from envs_jax.walk import render as walk_render
from envs_jax.walk.render import PATH_COLORS, Region, Scene


@dataclasses.dataclass(frozen=True)
class Leg:
    """The steps during which a sub-task was in force.

    Attributes:
        first: the first step.
        last: the last step, this one included.
        label: such as ``2. a, avoiding c d``.
        reach: names of what was to be reached.
        avoid: names of what was to be avoided.
        reached: whether the leg ended because the task moved on.
    """

    first: int
    last: int
    label: str
    reach: tuple[str, ...]
    avoid: tuple[str, ...]
    reached: bool


class Stage(Protocol):
    """What an environment's layout looks like with an agent in it."""

    def draw(self, ax: Axes, positions: np.ndarray, legs: Sequence[Leg]) -> None:
        """Draws a whole episode: positions ``[t + 1, 2 or more]`` as a line coloured by leg, goals where reached."""
        ...

    def frame(self, positions: np.ndarray, now: int, leg: Leg | None) -> np.ndarray:
        """One moment, uint8 ``[H, W, 3]``."""
        ...


def stage_of(env: Environment, layout: Any) -> Stage | None:
    """The stage of an unbatched layout (numpy), ``None`` for an environment without pictures."""
    if isinstance(env, Letter):
        return LetterStage(np.asarray(layout))
    if isinstance(env, Walk):
        return DiscStage(walk_render.walk_scene(env, layout))
    if hasattr(layout, "zones"):
        from envs_jax.zone.world import BOUNDARY  # Zone's module is imported by those who use Zone alone

        zones = np.asarray(layout.zones)
        radius = float(env.radius)  # type: ignore[attr-defined]
        regions = [
            Region(name, float(centre[0]), float(centre[1]), radius)
            for name, some in zip(env.propositions, zones, strict=True)
            for centre in some
        ]
        return DiscStage(Scene(tuple(regions), -BOUNDARY, BOUNDARY))
    return None


def position_of(state: Any) -> np.ndarray:
    """Where the agent is in a state of any of these environments: row and column, x and y, or x, y and heading."""
    return np.asarray(state.body)[..., :3] if hasattr(state, "body") else np.asarray(state.position)


@dataclasses.dataclass(frozen=True)
class LetterStage:
    """Letter's grid; positions are rows and columns.

    Attributes:
        layout: int ``[n, n]``.
        cell: its pixels in a frame.
    """

    layout: np.ndarray
    cell: int = 48

    def draw(self, ax: Axes, positions: np.ndarray, legs: Sequence[Leg]) -> None:
        """See :class:`Stage`."""
        size = self.layout.shape[0]
        grid = letter_render.rgb(self.layout, positions[0], cell_pixels=self.cell)
        ax.imshow(grid, extent=(-0.5, size - 0.5, size - 0.5, -0.5))
        for number, leg in enumerate(legs):
            color = PATH_COLORS[number % len(PATH_COLORS)]
            for t in range(leg.first, leg.last + 1):
                label = leg.label if t == leg.first else None
                _draw_move(ax, positions[t], positions[t + 1], color, label, shift=0.06 * ((number + 1) % 5 - 2))
            if leg.reached:
                row, column = positions[leg.last + 1]
                ax.plot(
                    column, row, "o", markersize=30, markerfacecolor="none", markeredgecolor=color, markeredgewidth=3
                )
                ax.annotate(str(number + 1), (column + 0.3, row - 0.3), color=color, weight="bold", fontsize=11)

    def frame(self, positions: np.ndarray, now: int, leg: Leg | None) -> np.ndarray:
        """See :class:`Stage`."""
        del leg
        return letter_render.rgb(self.layout, positions[now], trail=positions[:now], cell_pixels=self.cell)


@dataclasses.dataclass(frozen=True)
class DiscStage:
    """A square with discs; positions are x and y, and a heading where there is one.

    Attributes:
        scene: the discs.
    """

    scene: Scene

    def draw(self, ax: Axes, positions: np.ndarray, legs: Sequence[Leg]) -> None:
        """See :class:`Stage`."""
        walk_render.draw_episode(
            ax,
            self.scene,
            positions,
            legs=np.concatenate([np.full(leg.last + 1 - leg.first, i) for i, leg in enumerate(legs)]),
            names=[leg.label for leg in legs],
            reached={leg.last + 1: leg.reach for leg in legs if leg.reached},
            avoided=sorted({name for leg in legs for name in leg.avoid}),
        )

    def frame(self, positions: np.ndarray, now: int, leg: Leg | None) -> np.ndarray:
        """See :class:`Stage`."""
        here = positions[now]
        return walk_render.rgb(
            self.scene,
            here,
            heading=float(here[2]) if len(here) > 2 else None,
            trail=positions[:now:4],
            avoided=leg.avoid if leg else (),
        )


def _draw_move(ax: Axes, here: np.ndarray, there: np.ndarray, color: str, label: str | None, shift: float) -> None:
    """One move on the grid; over the edge of the torus it leaves on one side and comes back on the other."""
    move = there - here
    style: dict[str, Any] = {"color": color, "linewidth": 2.5, "solid_capstyle": "round"}
    if np.abs(move).max() <= 1:
        ax.plot([here[1] + shift, there[1] + shift], [here[0] + shift, there[0] + shift], label=label, **style)
        return
    step = -np.sign(move) * 0.45
    for at, to in ((here, here + step), (there - step, there)):
        ax.plot([at[1] + shift, to[1] + shift], [at[0] + shift, to[0] + shift], label=label, **style)
        label = None
