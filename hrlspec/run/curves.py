"""Learning curves of runs, drawn from their rows of metrics; of several seeds as their mean with a band.

Axes: **S** seeds (or runs), **N** evaluations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from hrlspec.evaluation.stats import mean_interval
from hrlspec.run.figures import save

Rows = Sequence[Mapping[str, Any]]
"""Those of a run's ``metrics.jsonl``, in the order of ``env_steps``."""

_CURVES = {
    "eval/success_rate": "success on unseen tasks",
    "eval/spl": "SPL on unseen tasks",
    "eval/return_mean": "return on unseen tasks",
    "eval/steps_mean": "steps of successful episodes",
    "train/success_rate": "success while training",
    "level": "curriculum level",
}
_FEWEST_FOR_BAND = 3
"""Student's t interval of two seeds is twelve times as wide as what they differ by."""


def learning_curves(curves: Mapping[str, Sequence[Rows]], file: Path) -> Path:
    """Draws success, SPL, return and more against environment steps.

    Args:
        curves: by label the runs that a curve is the mean of, often one. From where not all of them have come each is
            drawn by itself, thin.
        file: the picture (.png or .svg).
    """
    figure = Figure(figsize=(12, 6), layout="constrained")
    for ax, (name, title) in zip(figure.subplots(2, 3).flat, _CURVES.items(), strict=True):
        for number, (label, runs) in enumerate(curves.items()):
            _curve(ax, name, runs, f"C{number}", label)
        ax.set_title(title, fontsize=10)
        ax.set_xlabel("million environment steps", fontsize=8)
        ax.grid(alpha=0.3)
        if "success" in name or name == "eval/spl":
            ax.set_ylim(-0.02, 1.02)
    if len(curves) > 1:
        figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return save(figure, file)


def band(ax: Axes, steps: ArrayLike, values: ArrayLike, **line: Any) -> None:
    """Draws the mean over seeds, and from three seeds on its 95 % interval by Student's t.

    Args:
        ax: where.
        steps: environment steps ``[N]``, shown in millions.
        values: ``[S, N]``, finite.
        **line: colour, label and marker, as ``Axes.plot`` takes them.
    """
    millions = np.asarray(steps) / 1e6
    table: Float[np.ndarray, "S N"] = np.asarray(values, float)
    intervals = [mean_interval(column) for column in table.T]
    (drawn,) = ax.plot(millions, [interval.estimate for interval in intervals], **line)
    if len(table) >= _FEWEST_FOR_BAND:
        low, high = ([getattr(interval, end) for interval in intervals] for end in ("low", "high"))
        ax.fill_between(millions, low, high, alpha=0.2, color=drawn.get_color(), linewidth=0)


def _curve(ax: Axes, name: str, runs: Sequence[Rows], color: str, label: str) -> None:
    """One metric of runs that share a curve."""
    found = [{row["env_steps"]: row[name] for row in rows if row.get(name) is not None} for rows in runs]
    shared = sorted(set.intersection(*map(set, found)))
    marker = "." if len(shared) < 10 else None
    # Between dollars the drawing library would read mathematics.
    label = label.replace("$", r"\$")
    band(ax, shared, [[some[step] for step in shared] for some in found], color=color, label=label, marker=marker)
    for some in found:
        rest = [step for step in some if not shared or step >= shared[-1]]
        if len(rest) > 1:
            ax.plot(np.array(rest) / 1e6, [some[step] for step in rest], color=color, linewidth=0.6)
