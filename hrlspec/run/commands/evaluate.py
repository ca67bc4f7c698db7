"""Evaluates a trained agent: ``hrlspec evaluate --run DIR``, with ``--help`` for the flags.

Exit status: 0 done, 2 bad usage or input.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hrlspec import checkpoint
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.api import TrainedAgent, evaluate
from hrlspec.config import Checked, setting
from hrlspec.evaluation import LtlResult, LtlSuite, Suite, SuiteResult, evaluate_ltl, ltl_suite, suite_from_text
from hrlspec.evaluation.ltl import MAX_NODES as LTL_NODES
from hrlspec.evaluation.ltl import suite_of_automata
from hrlspec.evaluation.suite import MAX_NODES
from hrlspec.presets.peers import go_on_for_ever, peer_formulas
from hrlspec.run import platform
from hrlspec.run.console import result_console
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import Experiment, experiment_of
from hrlspec.run.extras import check_drawing, drawing
from hrlspec.run.flags import parse_flags
from hrlspec.run.folder import check_writable, read_record
from hrlspec.run.tables import ltl_table, suite_table
from hrlspec.run.unseen import with_tasks
from hrlspec.spec import SpecError, bare_lines
from hrlspec.spec.hoa import from_hoa, until_accepting

MOST_PICTURES = 9
_TASKS = ("spec", "spec_file", "ltl", "ltl_file", "hoa", "suite")
_LARGEST_FILE = 1_000_000  # bytes


@dataclasses.dataclass(frozen=True)
class EvaluateFlags(Checked):
    """Reports success, return, steps and SPL of a trained agent on the given tasks, in layouts drawn at random.

    Exactly one of --spec, --spec-file, --ltl, --ltl-file, --hoa and --suite says which tasks.
    """

    run: Path
    """The run folder."""
    spec: str | None = None
    """A task in SPECTRL, such as "achieve a; (achieve b ensuring not c)"."""
    spec_file: Path | None = None
    """A file with one task a line; # begins a comment."""
    ltl: str | None = None
    """A task in linear temporal logic, such as "F (a & (!b U c))", to be satisfied by the end of the episode."""
    ltl_file: Path | None = None
    """A file with one such formula a line."""
    hoa: Path | None = None
    """A file with an automaton in the Hanoi Omega-Automata format, deterministic Büchi."""
    forever: bool = False
    """Count how often a formula's accepting transitions are taken, instead of asking whether it is satisfied in the
    end. Published suites know it of themselves."""
    suite: str | None = None
    """A suite of the run's environment, such as dag, or published formulas, such as jaxolotl/letter_finite."""
    episodes: int = setting(500, least=1, most=1_000_000)
    """In all; at least one for each task. For formulas in LTL, of each."""
    seed: int = setting(0, least=0, most=2**31 - 1)
    """Of layouts and actions."""
    step: int | None = None
    """The checkpoint to load; the newest if not given."""
    greedy: bool = False
    """Take the most likely action and sub-task instead of sampling."""
    shield: bool = False
    """Replace actions that would step on forbidden propositions."""
    max_nodes: int = setting(MAX_NODES, least=2, most=4096)
    """Largest task tree. Trees of formulas in LTL are cut at 64 nodes, or fewer."""
    draw: Path | None = None
    """A picture (.png or .svg) of one episode of each task, of the first nine."""
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
    """
    flags = parse_flags(EvaluateFlags, argv, program=program)
    _check(flags)
    experiment = experiment_of(read_record(flags.run)["config"], str(flags.run))
    formulas = formulas_of(flags, experiment)
    if formulas is not None and flags.draw is not None:
        raise UserError("--draw takes tasks in SPECTRL, no formulas and no automata")
    suite = None if formulas else tasks_of(flags, experiment)
    platform.prepare()
    agent = experiment.agent
    params, step = load_params(agent, flags.run, flags.step)
    facts = {"run": str(flags.run), "checkpoint_step": step, "reward_set": experiment.reward_set}
    key = jax.random.fold_in(jax.random.key(flags.seed), 1)
    if formulas is not None:
        how: dict[str, Any] = {"seed": flags.seed, "greedy": flags.greedy, "shield": flags.shield}
        found = evaluate_ltl(key, agent, params, experiment.rewards, formulas, episodes=flags.episodes, **how)
        _show(flags, found, facts)
        return
    assert suite is not None
    try:
        result = evaluate(
            key,
            TrainedAgent(agent, params, experiment.rewards),
            suite,
            episodes=flags.episodes,
            seed=flags.seed,
            greedy=flags.greedy,
            shield=flags.shield,
        )
    except ValueError as error:
        raise UserError(str(error)) from error  # a task that nothing can satisfy
    _show(flags, result, facts)
    if flags.draw is not None:
        with drawing():
            _draw(flags, agent, params, experiment, suite)


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


def _draw(flags: EvaluateFlags, agent: Agent, params: Params, experiment: Experiment, suite: Suite) -> None:
    from hrlspec.run import plots

    assert flags.draw is not None
    some = suite.take(np.arange(min(len(suite), MOST_PICTURES)))
    machine = experiment.rewards
    episodes = plots.episodes_of(jax.random.key(flags.seed), agent, params, machine, some)
    flags.draw.parent.mkdir(parents=True, exist_ok=True)
    plots.gallery(episodes, agent.env.propositions, flags.draw)


def load_params(agent: Agent, run: Path, step: int | None = None) -> tuple[Params, int]:
    """The parameters in a run's newest intact checkpoint, or in that of ``step``, and its step.

    Raises:
        CheckpointError: there is none.
    """
    target = {"params": jax.eval_shape(agent.init, jax.random.key(0))}
    restored = checkpoint.load(run / "checkpoints", target, step=step, partial=True)
    return restored.state["params"], restored.step


def formulas_of(flags: EvaluateFlags, experiment: Experiment) -> LtlSuite | None:
    """The formulas in LTL that the flags name; ``None`` if they name tasks in SPECTRL.

    Raises:
        UserError: no such file.
        SuiteError: no such suite.
        SpecError: a formula cannot be read, or its automaton is too large.
    """
    if flags.ltl is not None:
        name, text, forever = "--ltl", " ".join(bare_lines(flags.ltl)), flags.forever
    elif flags.ltl_file is not None:
        name, text, forever = flags.ltl_file.name, _read(flags.ltl_file), flags.forever
    elif flags.hoa is not None:
        return _of_automaton(flags.hoa, flags, experiment)
    elif flags.suite is not None and "/" in flags.suite:
        name, text, forever = flags.suite, peer_formulas(flags.suite), go_on_for_ever(flags.suite)
    else:
        return None
    env, max_nodes = experiment.preset.make(), min(flags.max_nodes, LTL_NODES)
    return ltl_suite(name, text, env, forever=forever, max_nodes=max_nodes)


def _of_automaton(file: Path, flags: EvaluateFlags, experiment: Experiment) -> LtlSuite:
    """A suite of the one task in a HOA file."""
    env = experiment.preset.make()
    try:
        automaton = from_hoa(_read(file), env.propositions, env.possible_labels)
    except SpecError as error:
        raise SpecError(error.message, error.line, error.column, file.name) from None
    automaton = automaton if flags.forever else until_accepting(automaton)
    return suite_of_automata(file.name, [file.name], [automaton], env, max_nodes=min(flags.max_nodes, LTL_NODES))


def tasks_of(flags: EvaluateFlags, experiment: Experiment) -> Suite:
    """The tasks that the flags name.

    Raises:
        UserError: no such suite or file.
        SpecError: a task cannot be read or is too large.
    """
    if flags.suite is not None:
        return with_tasks(experiment.preset, flags.run, experiment.seed).suite(flags.suite)
    if flags.spec is not None:
        # A task may be written over several lines; a suite has one on each.
        name, text = "--spec", " ".join(bare_lines(flags.spec))
    else:
        assert flags.spec_file is not None
        name, text = flags.spec_file.name, _read(flags.spec_file)
    return suite_from_text(name, text, experiment.preset.make().propositions, max_nodes=flags.max_nodes)


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
    if flags.draw is not None and flags.draw.suffix not in (".png", ".svg"):
        raise UserError(f"--draw {flags.draw}: expected a file that ends in .png or .svg")
    if flags.draw is not None:
        if flags.draw.is_dir():
            raise UserError(f"--draw {flags.draw}: expected a file, found a folder")
        check_writable(flags.draw.parent)
        check_drawing()
