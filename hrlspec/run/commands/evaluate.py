"""Evaluates a trained agent: ``hrlspec evaluate --run DIR``, or ``--pretrained NAME``, with ``--help`` for the flags.

Exit status: 0 done, 2 bad usage or input.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from envs_jax import Environment
from hrlspec.api import TrainedAgent, evaluate
from hrlspec.config import Checked, setting
from hrlspec.evaluation import (
    LtlResult,
    LtlSuite,
    Suite,
    SuiteResult,
    evaluate_ltl,
    exact_suite,
    ltl_suite,
    suite_from_text,
)
from hrlspec.evaluation.ltl import MAX_NODES as LTL_NODES
from hrlspec.evaluation.ltl import check_propositions, suite_of_automata
from hrlspec.evaluation.suite import MAX_NODES
from hrlspec.presets import Preset
from hrlspec.presets.peers import go_on_for_ever, peer_formulas
from hrlspec.presets.peers.protocols import Protocol, manner
from hrlspec.run import platform
from hrlspec.run.automaton_file import check_automaton, check_automaton_file, write_automaton
from hrlspec.run.console import result_console
from hrlspec.run.errors import UserError
from hrlspec.run.extras import PICTURES, check_picture, drawing
from hrlspec.run.flags import parse_flags
from hrlspec.run.tables import ltl_table, suite_table
from hrlspec.run.trained import Source, check_named, check_shield, find_trained
from hrlspec.spec import SpecError, bare_lines
from hrlspec.spec.dfa import from_json
from hrlspec.spec.hoa import from_hoa, until_accepting
from hrlspec.spec.ltl import Automaton
from hrlspec.spec.readings import committed_automaton

MOST_PICTURES = 9
_TASKS = ("spec", "spec_file", "ltl", "ltl_file", "hoa", "dfa", "suite")
_MOVING = (".gif", ".mp4")
_LARGEST_FILE = 1_000_000  # bytes


@dataclasses.dataclass(frozen=True)
class EvaluateFlags(Checked):
    """Reports success, return, steps and SPL of a trained agent on the given tasks, in layouts drawn at random.

    Exactly one of --run and --pretrained says which agent, and exactly one of --spec, --spec-file, --ltl, --ltl-file,
    --hoa, --dfa and --suite which tasks.
    """

    run: Path | None = None
    """The run folder of the agent."""
    pretrained: str | None = None
    """An agent that comes along, by its name, such as letter; or the .safetensors file of one."""
    spec: str | None = None
    """A task in SPECTRL, such as "achieve a; (achieve b ensuring not c)"."""
    spec_file: Path | None = None
    """A file with one task a line; # begins a comment."""
    semantics: Literal["committed", "exact"] = "committed"
    """How tasks in SPECTRL are read: by the first visits, as they are trained, or so that a second try is allowed."""
    ltl: str | None = None
    """A task in linear temporal logic, such as "F (a & (!b U c))", to be satisfied by the end of the episode."""
    ltl_file: Path | None = None
    """A file with one such formula a line."""
    hoa: Path | None = None
    """A file with a Büchi automaton in the Hanoi Omega-Automata format."""
    dfa: Path | None = None
    """A file with an automaton as the library dfa has it: json.dumps(dfa2dict(...))."""
    forever: bool = False
    """Count how often a formula's accepting transitions are taken, instead of asking whether it is satisfied in the
    end. Published suites know it of themselves."""
    suite: str | None = None
    """A suite of the agent's environment, such as dag, or published formulas, such as jaxolotl/letter_finite."""
    episodes: int = setting(500, least=1, most=1_000_000)
    """In all; at least one for each task. For tasks as automata, of each."""
    protocol: Protocol | None = None
    """Evaluate formulas as others do: jaxolotl, 512 episodes of each, actions sampled; deepltl, 500, in Zone greedy
    where they are finite. Takes the place of --episodes and --greedy."""
    seed: int = setting(0, least=0, most=2**31 - 1)
    """Of layouts and actions."""
    step: int | None = None
    """The checkpoint of the run to load; the newest if not given."""
    greedy: bool = False
    """Take the most likely action and sub-task instead of sampling."""
    shield: bool = False
    """Replace actions that would step on forbidden propositions, if the agent was trained with a shield."""
    max_nodes: int = setting(MAX_NODES, least=2, most=4096)
    """Largest task tree. Trees of automata are cut at 64 nodes, or fewer."""
    draw: Path | None = None
    """A picture (.png or .svg), or an animation (.gif or .mp4), of one episode of each task, of the first nine."""
    automaton: Path | None = None
    """The automaton of the one task, with short guards as a picture (.png or .svg) or for Graphviz (.dot), or to be
    read again: .hoa for --hoa, .json for --dfa."""
    json: bool = False
    """Print one JSON object and nothing else on standard output."""


def main(argv: Sequence[str], *, program: str = "hrlspec evaluate") -> None:
    """The command line.

    Args:
        argv: the arguments.
        program: what to call it in messages.

    Raises:
        UserError: bad usage or input.
        SpecError: a task cannot be read.
        CheckpointError: there is no usable checkpoint.
        AgentFileError: there is no such agent in a file, or it cannot be used.
    """
    flags = parse_flags(EvaluateFlags, argv, program=program)
    check_named(flags.run, flags.pretrained, flags.step)
    _check(flags)
    source = find_trained(flags.run, flags.pretrained, flags.step)
    tasks = formulas_of(flags, source.preset) or tasks_of(flags, source)
    if flags.protocol is not None and not isinstance(tasks, LtlSuite):
        raise UserError(f"--protocol {flags.protocol} is for formulas and automata, not for tasks in SPECTRL")
    if flags.draw is not None and isinstance(tasks, LtlSuite):
        raise UserError("--draw takes tasks in SPECTRL, no formulas and no automata; --automaton draws one of these")
    platform.prepare()
    automaton = None if flags.automaton is None else _automaton_of(flags.automaton, tasks, source.preset)
    trained, facts = source.load()
    if flags.shield:
        check_shield(trained)
    key = jax.random.fold_in(jax.random.key(flags.seed), 1)
    how: dict[str, Any] = {name: getattr(flags, name) for name in ("episodes", "seed", "greedy", "shield")}
    if isinstance(tasks, LtlSuite):
        if flags.protocol is not None:
            how |= manner(flags.protocol, trained.agent.env, tasks.forever)._asdict()
            facts |= {"protocol": flags.protocol}
        _show(flags, evaluate_ltl(key, trained.agent, trained.params, trained.rewards, tasks, **how), facts)
    else:
        try:
            result = evaluate(key, trained, tasks, **how)
        except ValueError as error:
            raise UserError(str(error)) from error  # a task that nothing can satisfy
        _show(flags, result, facts)
        if flags.draw is not None:
            with drawing():
                _draw(flags, trained, tasks)
    if automaton is not None and flags.automaton is not None:
        write_automaton(automaton, tasks.formulas[0], flags.automaton)


def _show(flags: EvaluateFlags, result: SuiteResult | LtlResult, facts: dict[str, Any]) -> None:
    """Prints the results."""
    if flags.json:
        print(json.dumps({**facts, **result.to_json()}, allow_nan=False), flush=True)
        return
    console = result_console()
    if isinstance(result, LtlResult):
        console.print(ltl_table(result))
        return
    console.print(suite_table(result))
    if 1 < len(result.per_task) <= 20:
        for task in result.per_task:
            score = task.score
            console.say(f"{score.success_rate.estimate:.3f}  {task.task}")


def _draw(flags: EvaluateFlags, trained: TrainedAgent, suite: Suite) -> None:
    from hrlspec.run import plots

    assert flags.draw is not None
    some = suite.take(np.arange(min(len(suite), MOST_PICTURES)))
    agent, key = trained.agent, jax.random.key(flags.seed)
    episodes = plots.episodes_of(key, agent, trained.params, trained.rewards, some)
    flags.draw.parent.mkdir(parents=True, exist_ok=True)
    draw = plots.animation if flags.draw.suffix in _MOVING else plots.gallery
    draw(episodes, agent.env.propositions, flags.draw)


def _automaton_of(file: Path, tasks: Suite | LtlSuite, preset: Preset) -> Automaton:
    """The automaton of the one task.

    Raises:
        UserError: there are several tasks, or the file cannot hold the automaton.
        SpecError: it is too large, or the environment has too many propositions.
    """
    if len(tasks) != 1:
        raise UserError(f"--automaton takes one task, found {len(tasks)}")
    if isinstance(tasks, LtlSuite):
        (automaton,) = tasks.sources
    else:
        env = preset.make()
        check_propositions(tasks.name, env)
        tree = jax.tree.map(lambda x: x[0], tasks.trees)
        automaton = committed_automaton(tree, env.propositions, env.possible_labels)
    check_automaton("--automaton", file, automaton)
    return automaton


def formulas_of(flags: EvaluateFlags, preset: Preset) -> LtlSuite | None:
    """The tasks that are carried out as automata; ``None`` if the flags name tasks that are trees.

    Raises:
        UserError: no such file.
        SuiteError: no such suite.
        SpecError: a task cannot be read, or its automaton is too large.
    """
    env, max_nodes = preset.make(), min(flags.max_nodes, LTL_NODES)
    if flags.hoa is not None:
        return _of_automaton(flags.hoa, flags, env)
    if flags.dfa is not None:
        return _of_automaton(flags.dfa, flags, env)
    if flags.semantics == "exact":
        name, text = _spectrl(flags)
        return exact_suite(name, text, env, max_nodes=max_nodes)
    if flags.ltl is not None:
        name, text, forever = "--ltl", " ".join(bare_lines(flags.ltl)), flags.forever
    elif flags.ltl_file is not None:
        name, text, forever = flags.ltl_file.name, _read(flags.ltl_file), flags.forever
    elif flags.suite is not None and "/" in flags.suite:
        name, text, forever = flags.suite, peer_formulas(flags.suite), go_on_for_ever(flags.suite)
    else:
        return None
    return ltl_suite(name, text, env, forever=forever, max_nodes=max_nodes)


def _of_automaton(file: Path, flags: EvaluateFlags, env: Environment) -> LtlSuite:
    """A suite of the one task in a file of --hoa or --dfa."""
    check_propositions(file.name, env)
    read = from_hoa if flags.dfa is None else from_json
    try:
        automaton = read(_read(file), env.propositions, env.possible_labels)
        if automaton.marks is not None and not flags.forever:
            automaton = until_accepting(automaton)
    except SpecError as error:
        raise SpecError(error.message, error.line, error.column, file.name) from None
    return suite_of_automata(file.name, [file.name], [automaton], env, max_nodes=min(flags.max_nodes, LTL_NODES))


def tasks_of(flags: EvaluateFlags, source: Source) -> Suite:
    """The tasks that the flags name.

    Raises:
        UserError: no such suite or file.
        SpecError: a task cannot be read or is too large.
    """
    if flags.suite is not None:
        return source.suite(flags.suite)
    name, text = _spectrl(flags)
    return suite_from_text(name, text, source.preset.make().propositions, max_nodes=flags.max_nodes)


def _spectrl(flags: EvaluateFlags) -> tuple[str, str]:
    """The name and the lines of --spec or --spec-file."""
    if flags.spec is not None:
        # A task may be written over several lines; a suite has one on each.
        return "--spec", " ".join(bare_lines(flags.spec))
    assert flags.spec_file is not None
    return flags.spec_file.name, _read(flags.spec_file)


def _read(file: Path) -> str:
    try:
        if file.stat().st_size > _LARGEST_FILE:
            raise UserError(f"{file} is larger than {_LARGEST_FILE} bytes; a file of tasks has one formula a line")
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"cannot read {file}: not UTF-8 text") from error


def _check(flags: EvaluateFlags) -> None:
    given = [name for name in _TASKS if getattr(flags, name) is not None]
    if len(given) != 1:
        found = " and ".join(f"--{name.replace('_', '-')}" for name in given) or "none"
        flags_there_are = ", ".join(f"--{name.replace('_', '-')}" for name in _TASKS[:-1])
        raise UserError(f"expected exactly one of {flags_there_are} and --suite, found {found}")
    if flags.forever and flags.ltl is None and flags.ltl_file is None and flags.hoa is None:
        raise UserError("--forever goes with --ltl, --ltl-file or --hoa")
    if flags.semantics != "committed" and flags.spec is None and flags.spec_file is None:
        raise UserError(f"--semantics {flags.semantics} goes with --spec or --spec-file")
    if flags.protocol is not None and (flags.greedy or flags.episodes != EvaluateFlags.episodes):
        raise UserError(f"--protocol {flags.protocol} says how many episodes there are and whether actions are sampled")
    if flags.automaton is not None:
        check_automaton_file("--automaton", flags.automaton)
    if flags.draw is not None:
        check_picture("--draw", flags.draw, (*PICTURES, *_MOVING))
