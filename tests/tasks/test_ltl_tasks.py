"""LTL as a task language of the adapters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hrlspec.gymnasium
from envs_jax.base import at_most_one
from hrlspec.spec import SpecError
from hrlspec.tasks.ltl_tasks import LtlTasks

NAMES = ("a", "b", "c", "d")
FINITE = LtlTasks(NAMES, at_most_one(NAMES), max_states=8)
FOREVER = LtlTasks(NAMES, at_most_one(NAMES), forever=True, max_states=8)


def follow(language: LtlTasks, text: str, trace: str) -> list[tuple[float, bool, bool, dict]]:
    """Reward, end, success and description after each step; a dot is a step on which nothing holds."""
    task = jax.tree.map(jnp.asarray, language.read(text))
    progress, found = language.start(task), []
    for step in trace:
        progress, verdict = jax.jit(language.advance)(task, progress, jnp.array([name == step for name in NAMES]))
        said = language.describe(text, jax.tree.map(np.asarray, progress))
        found.append((float(verdict.reward), bool(verdict.ended), bool(verdict.success), said))
    return found


def test_a_second_try_to_the_end() -> None:
    found = follow(FINITE, "!a U (b & (!c U d))", "b.cbdd")
    assert [reward for reward, *_ in found] == [0, 0, 0, 0, 1, 0]
    assert [ended for _, ended, _, _ in found] == [False] * 4 + [True] * 2
    said = [each["subtasks"] for *_, each in found]
    assert said[0] == said[1] == said[3] == ("achieve d ensuring not c",)
    assert said[2] == ("achieve b ensuring not a",)
    assert said[4] == ()
    assert [each["status"] for *_, each in found] == ["running"] * 4 + ["satisfied"] * 2


def test_a_bad_end() -> None:
    (*_, (reward, ended, success, said)) = follow(FINITE, "!a U b", "ca")
    assert (reward, ended, success, said["status"]) == (0, True, False, "violated")


def test_rounds_pay() -> None:
    found = follow(FOREVER, "GF a & GF b & G !d", "abbabda")
    assert [reward for reward, *_ in found] == [0, 1, 0, 0, 1, 0, 0]
    assert [each["rounds"] for *_, each in found] == [0, 1, 1, 1, 2, 2, 2]
    assert [ended for _, ended, _, _ in found] == [False] * 5 + [True] * 2
    assert found[0][3]["subtasks"] == ("achieve b ensuring not d",)


def test_what_is_refused() -> None:
    with pytest.raises(SpecError, match="the automaton has 16 states, at most 8 are taken"):
        FINITE.read("F a & F b & F c & F d")
    with pytest.raises(SpecError, match="'z' is no proposition"):
        FINITE.read("F z")
    with pytest.raises(SpecError, match="from when on something holds for ever is for the agent to say"):
        FOREVER.read("FG a")
    with pytest.raises(ValueError, match="unknown language 'latin', expected one of: spectrl, ltl, ltl forever"):
        hrlspec.gymnasium.make("letter", language="latin")  # type: ignore[arg-type]


def test_in_an_environment() -> None:
    """Going right and down in Letter until something is met: whatever it is satisfies the formula."""
    env = hrlspec.gymnasium.make("letter", language="ltl", task="F (a | b | c | d | e)")
    _, info = env.reset(seed=0)
    assert info["status"] == "running"
    assert len(info["subtasks"]) == 5
    for step in range(75):
        _, reward, terminated, _, info = env.step(3 if step % 7 else 1)
        if terminated:
            break
    assert (reward, info["status"], info["success"]) == (1.0, "satisfied", True)
    assert info["labels"].any()
