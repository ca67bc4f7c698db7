"""Writes a page that plays episodes of trained agents: ``hrlspec replay``, with ``--help`` for the flags.

Exit status: 0 done, 2 bad usage or input.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from tyro.conf import UseAppendAction

from envs_jax import Environment
from envs_jax.base import Layout
from hrlspec.config import Checked, setting
from hrlspec.run import platform
from hrlspec.run.console import counted, result_console
from hrlspec.run.errors import UserError
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import check_writable
from hrlspec.run.replay.data import Played, page_data
from hrlspec.run.replay.page import page
from hrlspec.run.replay.recorder import draw_layouts, record
from hrlspec.run.replay.tasks import read_task
from hrlspec.run.trained import Source, check_shield, find_trained
from hrlspec.spec import TaskTree
from hrlspec.spec.automata import Automata

MOST_AGENTS = 2


@dataclasses.dataclass(frozen=True)
class ReplayFlags(Checked):
    """Writes a page that plays episodes of trained agents, with what the planner and the low level thought of them.

    The page is one file, which needs neither a network nor a server.
    """

    out: Path
    """The page (.html)."""
    run: UseAppendAction[tuple[Path, ...]] = ()
    """A run folder; a second agent is shown beside the first, in the same layouts."""
    pretrained: UseAppendAction[tuple[str, ...]] = ()
    """An agent that comes along, by its name, such as letter; or the .safetensors file of one."""
    spec: str | None = None
    """A task in SPECTRL, such as "achieve a; (achieve b ensuring not c)"."""
    ltl: str | None = None
    """A task in linear temporal logic, such as "F (a & (!b U c))"."""
    forever: bool = False
    """Count how often the formula's accepting transitions are taken, instead of asking whether it is satisfied."""
    episodes: int = setting(5, least=1, most=50)
    """Each in a layout of its own."""
    seed: int = setting(0, least=0, most=2**31 - 1)
    """Of layouts and actions."""
    greedy: bool = False
    """Take the most likely action and sub-task instead of sampling."""
    shield: bool = False
    """Replace actions that would step on forbidden propositions."""


@dataclasses.dataclass(frozen=True)
class _Shown:
    """An agent that is to be shown, not loaded yet."""

    name: str
    source: Source


def main(argv: Sequence[str], *, program: str = "hrlspec replay") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage or input.
        SpecError: the task cannot be read.
        CheckpointError: there is no usable checkpoint.
        AgentFileError: there is no such agent in a file, or it cannot be used.
    """
    flags = parse_flags(ReplayFlags, argv, program=program)
    _check(flags)
    agents = _agents(flags)
    env = _common_world(agents)
    formula, tasks = _task(flags, env)
    platform.prepare()
    kept = not any(agent.source.foreign for agent in agents)
    layouts = draw_layouts(env, flags.seed, flags.episodes, kept=kept)
    played = [_play(agent, flags, tasks, layouts) for agent in agents]
    text = page(page_data(env, formula, tasks, layouts, played))
    flags.out.parent.mkdir(parents=True, exist_ok=True)
    flags.out.write_text(text, encoding="utf-8", newline="\n")
    size = len(text.encode()) / 1000
    result_console().say(
        f"{flags.out}: {counted(flags.episodes, 'episode')} in {size:.0f} kB, to be opened in a browser"
    )


def _agents(flags: ReplayFlags) -> list[_Shown]:
    """The agents that the flags name.

    Raises:
        UserError: there is none, or none that can be read.
    """
    names = [run.resolve().name for run in flags.run]
    if len({*names}) < len(names):
        names = [str(run) for run in flags.run]
    sources = [find_trained(run, None, None) for run in flags.run]
    sources += [find_trained(None, name, None) for name in flags.pretrained]
    return [_Shown(name, source) for name, source in zip((*names, *flags.pretrained), sources, strict=True)]


def _common_world(agents: Sequence[_Shown]) -> Environment:
    """The world of all agents.

    Raises:
        UserError: it is not the same.
    """
    first, *others = agents
    env = first.source.preset.make()
    for other in others:
        if other.source.preset.make() != env:
            found = f"{first.name} is of {first.source.preset.name}, {other.name} of {other.source.preset.name}"
            raise UserError(f"{found}; side by side they are shown in the same layouts, which takes the same world")
    return env


def _task(flags: ReplayFlags, env: Environment) -> tuple[str, TaskTree | Automata]:
    """The task as it was written, and as it is carried out, with one row or as one automaton.

    Raises:
        SpecError: it cannot be read, or is too large.
        UserError: there is more than one.
    """
    if flags.ltl is not None:
        return read_task("--ltl", "ltl", flags.ltl, env, forever=flags.forever)
    return read_task("--spec", "spec", flags.spec or "", env)


def _play(shown: _Shown, flags: ReplayFlags, tasks: TaskTree | Automata, layouts: Layout) -> Played:
    """Lets an agent carry out the task in each layout; the random numbers are the same for all agents."""
    trained, _ = shown.source.load()
    if flags.shield:
        check_shield(trained)
    how = {"greedy": flags.greedy, "shield": flags.shield, "kept": not shown.source.foreign}
    return Played(shown.name, trained.agent.method.name, *record(trained, flags.seed, tasks, layouts, **how))


def _check(flags: ReplayFlags) -> None:
    if (flags.spec is None) == (flags.ltl is None):
        raise UserError(f"expected either --spec or --ltl, found {'neither' if flags.spec is None else 'both'}")
    if flags.forever and flags.ltl is None:
        raise UserError("--forever goes with --ltl")
    agents = [*map(str, flags.run), *flags.pretrained]
    if not 1 <= len(agents) <= MOST_AGENTS or len({*agents}) < len(agents):
        found = " and ".join(agents) or "none"
        raise UserError(f"expected one --run or --pretrained, or two different ones, found {found}")
    if flags.out.suffix != ".html":
        raise UserError(f"--out {flags.out}: expected a file that ends in .html")
    if flags.out.is_dir():
        raise UserError(f"--out {flags.out}: expected a file, found a folder")
    check_writable(flags.out.parent)
