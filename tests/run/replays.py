"""Pages of episodes that somebody played by hand, for tests of what is in them."""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np

import envs_jax
from hrlspec.evaluation import ltl_suite, suite_from_text
from hrlspec.evaluation.recording import record_episodes
from hrlspec.run.replay.data import Played, page_data
from hrlspec.tasks.rewards import reward_machine
from tests.evaluation.scripted import manner, walker

LETTER = envs_jax.make("letter")
TASK = "(achieve a or achieve b); (achieve c ensuring not d)"
FORMULA = "F (a & (!b U c)) & (!e U d)"
EPISODES = 10


def tasks_of(*, ltl: bool) -> Any:
    if ltl:
        return ltl_suite("ltl", FORMULA, LETTER, max_nodes=8).automata
    return suite_from_text("spec", TASK, LETTER.propositions).trees


@functools.cache
def played(*, ltl: bool = False) -> tuple[Any, list[Played], dict[str, Any]]:
    """Layouts, what two walkers did in them, who begin with the first or the last branch, and the page's data."""
    keys = jax.random.split(jax.random.key(5), EPISODES)
    layouts = jax.tree.map(np.asarray, jax.vmap(LETTER.sample_layout, (0, None))(keys, LETTER.default_params))
    tasks = tasks_of(ltl=ltl)
    agent, machine, which = walker(LETTER), reward_machine(LETTER.propositions), np.zeros(EPISODES, int)
    both = []
    for name, last in (("first", False), ("last", True)):
        found = record_episodes(
            jax.random.key(0), agent, manner(last=last), machine, tasks, layouts, which=which, greedy=True
        )
        both.append(Played(name, "scripted", *jax.device_get(found)))
    return layouts, both, page_data(LETTER, FORMULA if ltl else TASK, tasks, layouts, both)


def at(changes: list[list[Any]], step: int) -> list[Any]:
    """What a list of changes says of a step."""
    return [change for change in changes if change[0] <= step][-1][1:]
