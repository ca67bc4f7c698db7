"""Recorded episodes as plain values for JSON: what the page is made of.

What changes rarely is a list of changes, each beginning with the step from which it holds; numbers are rounded.
Axes: **B** episodes, **H** horizon, **T** steps of an episode, **R** tasks or states of an automaton.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from envs_jax import Drawable, Environment
from envs_jax.arrays import Array
from envs_jax.base import Layout
from envs_jax.scenes import Scene
from hrlspec.evaluation.episodes import Episodes
from hrlspec.evaluation.recording import Record, Standing
from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, TaskTree, subtask_avoid
from hrlspec.spec.automata import Automata
from hrlspec.spec.guards import JUMP, guards

Json = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Played:
    """What one agent did in B layouts.

    Attributes:
        name: what to call it.
        method: how it was trained.
        episodes: how the episodes ended (numpy).
        record: what went on in them (numpy).
    """

    name: str
    method: str
    episodes: Episodes
    record: Record


def page_data(
    env: Environment, formula: str, tasks: TaskTree | Automata, layouts: Layout, played: Sequence[Played]
) -> Json:
    """Everything that a page shows.

    Args:
        env: the world.
        formula: the task as it was written.
        tasks: the same, of one task: a tree with a leading axis 1, or an automaton.
        layouts: B of them (numpy).
        played: what each agent did in them.
    """
    names = env.propositions
    num_layouts = len(jax.tree.leaves(layouts)[0])
    each = [jax.tree.map(lambda x, i=i: x[i], layouts) for i in range(num_layouts)]
    scenes = [env.scene(layout) if isinstance(env, Drawable) else None for layout in each]
    automata = tasks if isinstance(tasks, Automata) else None
    trees = jax.tree.map(np.asarray, tasks.trees if isinstance(tasks, Automata) else tasks)
    runs: list[Json] = [
        {
            "name": some.name,
            "method": some.method,
            "episodes": [_episode(some, i, scene, one_task=automata is None) for i, scene in enumerate(scenes)],
        }
        for some in played
    ]
    visited = {change[1] for run in runs for episode in run["episodes"] for change in episode["standing"]}
    return {
        "world": env.name,
        "formula": formula,
        "names": names,
        "tasks": {row: _tree(jax.tree.map(lambda x, row=row: x[row], trees)) for row in sorted(visited)},
        "automaton": None if automata is None else _automaton(automata, names),
        "scenes": [scene_data(scene) for scene in scenes],
        "runs": runs,
    }


def _episode(played: Played, index: int, scene: Scene | None, *, one_task: bool) -> Json:
    """One episode; a task's row is its number among the episodes where they all have one and the same tree."""
    ended = jax.tree.map(lambda x: x[index], played.episodes)
    steps = int(ended.steps)
    record: Record = jax.tree.map(lambda x: x[:steps, index], played.record)
    after, high = record.after, record.high
    whole: Standing = jax.tree.map(lambda first, later: np.concatenate([first[:1], later]), record.before, after)
    task = np.zeros(steps + 1, int) if one_task else whole.task
    decided = np.flatnonzero(high.made & (high.edge != TaskTree.ROOT))
    return {
        "outcome": "satisfied" if ended.success else "violated" if ended.violated else "not satisfied in time",
        "rounds": int(ended.rounds),
        "return": _rounded(ended.returns),
        "steps": steps,
        "places": places_data(np.asarray(whole.position), scene),
        "labels": _changes([_members(row)] for row in whole.labels),
        "standing": _changes(
            [int(row), int(node), _members(blocked)]
            for row, node, blocked in zip(task, whole.state.node, whole.state.blocked, strict=True)
        ),
        "edges": _changes([int(edge)] for edge in high.edge),
        "decisions": [
            {
                "step": int(t),
                "value": _rounded(high.value[t]),
                "branches": [
                    [edge, _rounded(high.probability[t, edge]), _rounded(high.worth[t, edge])]
                    for edge in _members(high.open[t])
                ],
            }
            for t in decided
        ],
        "values": [_rounded(value) for value in record.value],
        "rewards": [[int(t), _rounded(record.reward[t])] for t in np.flatnonzero(record.reward)],
    }


def places_data(positions: np.ndarray, scene: Scene | None) -> list[list[float | None]] | None:
    """Positions ``[_, D]`` in the scene's outline: x, y and perhaps a heading, each ``[_]``; ``None`` likewise."""
    if scene is None or scene.outline() is None:
        return None
    return [[_rounded(number) for number in column] for column in scene.in_outline(positions).T]


def scene_data(scene: Scene | None) -> Json | None:
    """A layout as shapes; ``None`` where there is nothing to see."""
    outline = None if scene is None else scene.outline()
    if outline is None:
        return None
    shapes = [
        {**dataclasses.asdict(x), "x": _rounded(x.x), "y": _rounded(x.y), "radius": _rounded(x.radius)}
        for x in outline.shapes
    ]
    return {"width": outline.width, "height": outline.height, "cell": outline.cell, "shapes": shapes}


def _tree(tree: TaskTree) -> Json:
    """The valid nodes of one task; sets of propositions by their indices."""
    rows = range(int(np.flatnonzero(tree.valid).max()) + 1)
    avoid = np.asarray(subtask_avoid(tree))
    return {
        "parent": [int(tree.parent[row]) for row in rows],
        "reach": [_members(tree.reach[row]) for row in rows],
        "avoid": [_members(avoid[row]) for row in rows],
        "accepting": _members(tree.accepting),
    }


def _automaton(automata: Automata, names: Sequence[str]) -> Json:
    """The states that can be reached, and the moves between them, each with its condition.

    Of moves from a state to itself those that accept.
    """
    column = np.asarray(automata.column)
    labels = {
        frozenset(name for i, name in enumerate(names) if code >> i & 1): int(column[code])
        for code in np.flatnonzero(column >= 0).tolist()
    }
    status, successors, accepts = map(np.asarray, (automata.status, automata.successors, automata.accepts))
    origins = np.asarray(automata.origin)
    moves, states = [], [int(automata.start[0])]
    for state in states:  # grows while it is read
        if status[state] != RUNNING:
            continue
        goes = {label: (int(successors[state, at]), bool(accepts[state, at])) for label, at in labels.items()}
        for (target, accepting), text in guards(goes).items():
            if target not in states:
                states.append(target)
            if target != state or accepting:
                moves.append({"from": state, "to": target, "if": text, "accepts": accepting})
        for origin in dict.fromkeys(origins[state][origins[state] != state].tolist()):
            if origin not in states:
                states.append(origin)
            moves.append({"from": state, "to": origin, "if": JUMP, "accepts": False})
    return {
        "satisfied": [state for state in states if status[state] == SATISFIED],
        "violated": [state for state in states if status[state] == VIOLATED],
        "moves": moves,
    }


def _changes(rows: Iterable[list[Any]]) -> list[list[Any]]:
    """Rows that differ from the one before, each with its number first."""
    found: list[list[Any]] = []
    for number, row in enumerate(rows):
        if not found or found[-1][1:] != row:
            found.append([number, *row])
    return found


def _members(row: Bool[Array, " _"]) -> list[int]:
    return np.flatnonzero(row).tolist()


def _rounded(number: Any) -> float | None:
    """Three decimals, whole numbers without any; what is not finite has no JSON."""
    value = round(float(number), 3)
    return None if not np.isfinite(value) else int(value) if value.is_integer() else value
