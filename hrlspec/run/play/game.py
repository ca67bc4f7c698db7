"""An agent that carries out tasks as they come, in layouts as they are arranged."""

from __future__ import annotations

import contextlib
import functools
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from envs_jax import Drawable, Environment, Rearrangeable
from envs_jax.arrays import Array
from envs_jax.base import Layout
from hrlspec.api import TrainedAgent
from hrlspec.run.play.requests import Arrangement, Attempt, RequestError
from hrlspec.run.programs import Program
from hrlspec.run.replay.data import Json, Played, page_data, places_data, scene_data
from hrlspec.run.replay.recorder import draw_layouts, record
from hrlspec.run.replay.tasks import Language, read_task
from hrlspec.spec import SpecWarning
from hrlspec.spec.automata import MAX_PROPOSITIONS

_PATIENCE = 30.0  # seconds until somebody who waits for others is sent away


class Busy(Exception):
    """Others are being served, for longer than anybody should wait."""


class Game:
    """One agent in its world. Threads may share it: one is served at a time.

    Args:
        name: what to call the agent.
        trained: the agent.
        greedy: take the most likely action and sub-task instead of sampling.
        shield: replace actions that lead to propositions to be avoided.
        kept: whether compiled programs are, from one process to the next; see `draw_layouts`.
    """

    def __init__(self, name: str, trained: TrainedAgent, *, greedy: bool, shield: bool, kept: bool) -> None:
        self.name, self.trained = name, trained
        self.env = trained.agent.env
        self._how = {"greedy": greedy, "shield": shield, "kept": kept}
        self._start = Program("start", _start, self.env, effort="least", kept=kept)
        self._lock = threading.Lock()

    @property
    def languages(self) -> tuple[Language, ...]:
        """What tasks can be written in."""
        return ("spec", "ltl") if self.env.num_propositions <= MAX_PROPOSITIONS else ("spec",)

    def example(self, language: Language) -> str:
        """A task of this world: one thing, then another if there is any."""
        names = self.env.propositions[:2]
        return f"F ({' & F '.join(names)})" if language == "ltl" else "; ".join(f"achieve {name}" for name in names)

    def warm_up(self) -> None:
        """Loads or compiles all programs, so that nobody waits for them later."""
        where = Arrangement(0, None)
        self.arranged(where)
        for language in self.languages:
            self.played(Attempt(where, language, self.example(language), False, 0))

    def arranged(self, where: Arrangement) -> Json:
        """A layout to look at, and what in it can be moved.

        Returns:
            ``scene`` as in a record, or ``None``; ``agent``, x, y and perhaps its heading where it starts; ``things``,
            each a name, x and y, in the order in which an arrangement has their places.

        Raises:
            RequestError: there is no such layout.
            Busy: too many ask.
        """
        with self._served():
            layout = self._layout(where)
            if not isinstance(self.env, Drawable):
                return {"seed": where.seed, "scene": None, "agent": None, "things": []}
            scene = self.env.scene(layout)
            agent = places_data(np.asarray(self._start(layout))[None], scene)
            return {
                "seed": where.seed,
                "scene": scene_data(scene),
                "agent": agent and [column[0] for column in agent],
                "things": self._things(where),
            }

    def played(self, attempt: Attempt) -> Json:
        """The record of an episode, as `hrlspec.run.replay.data.page_data` has it, with ``notes`` about the task.

        Raises:
            SpecError: the task cannot be read, or is too large.
            RequestError: there is no such layout.
            Busy: too many ask.
        """
        with self._served(), warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", SpecWarning)
            formula, tasks = read_task(
                "the task", attempt.language, attempt.task, self.env, forever=attempt.forever, usual=True
            )
            layouts = jax.tree.map(lambda x: x[None], self._layout(attempt.where))
            found = record(self.trained, attempt.draw, tasks, layouts, **self._how)
            played = Played(self.name, self.trained.agent.method.name, *found)
            data = page_data(self.env, formula, tasks, layouts, [played])
            return {**data, "notes": [str(note.message) for note in said]}

    def _things(self, where: Arrangement) -> list[list[Any]]:
        """Names and places, in the order that the drawn layout has: moving a thing may change that of the new one."""
        drawn = self._drawn(where.seed)
        if not isinstance(self.env, Rearrangeable):
            return []
        scene, things = self.env.scene(drawn), self.env.things(drawn)
        places = np.array([thing.place for thing in things], float)
        if where.places is not None:
            places = scene.from_outline(where.places)
        columns = places_data(places, scene)
        return [] if columns is None else [list(row) for row in zip([x.name for x in things], *columns, strict=True)]

    def _layout(self, where: Arrangement) -> Layout:
        drawn = self._drawn(where.seed)
        if where.places is None:
            return drawn
        if not isinstance(self.env, Rearrangeable):
            raise RequestError(f"nothing can be moved in the layouts of {self.env.name}")
        number = len(self.env.things(drawn))
        if len(where.places) != number:
            raise RequestError(f"found {len(where.places)} places, {number} things can be moved")
        try:
            return self.env.rearranged(drawn, self.env.scene(drawn).from_outline(where.places))
        except ValueError as error:
            raise RequestError(str(error)) from error

    def _drawn(self, seed: int) -> Layout:
        return jax.tree.map(lambda x: x[0], draw_layouts(self.env, seed, 1, kept=self._how["kept"]))

    @contextlib.contextmanager
    def _served(self) -> Iterator[None]:
        """One at a time."""
        if not self._lock.acquire(timeout=_PATIENCE):
            raise Busy("others are being served; try again")
        try:
            yield
        finally:
            self._lock.release()


@functools.partial(jax.jit, static_argnums=0)
def _start(env: Environment, layout: Layout) -> Array:
    """Where the agent is in the beginning, in the scene's coordinates."""
    assert isinstance(env, Drawable)
    return env.position(env.reset_to(layout, jax.random.key(0), env.default_params)[1])
