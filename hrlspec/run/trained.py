"""A trained agent as commands are told of it: in a run folder, ``--run``, or in a file, ``--pretrained``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from hrlspec import checkpoint
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.agent_files import AgentFile, read_agent, read_params
from hrlspec.api import TrainedAgent
from hrlspec.evaluation import Suite
from hrlspec.presets import Preset
from hrlspec.run.errors import UserError
from hrlspec.run.experiment import experiment_of
from hrlspec.run.folder import read_record
from hrlspec.run.unseen import with_tasks


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a trained agent comes from. Its parameters are read when it is loaded.

    Attributes:
        preset: its environment with what belongs to it.
        load: the agent, and facts that a report of it begins with.
        run: its run folder, if it has one.
        seed: that it was trained with.
        foreign: whether its environment or its method is not of this library.
    """

    preset: Preset
    load: Callable[[], tuple[TrainedAgent, dict[str, Any]]]
    run: Path | None
    seed: int
    foreign: bool = False

    def suite(self, name: str) -> Suite:
        """A suite of its environment.

        Raises:
            SuiteError: there is none.
            UserError: that of its run folder cannot be read.
        """
        return with_tasks(self.preset, self.run, self.seed).suite(name)


def find_trained(run: Path | None, pretrained: str | None, step: int | None) -> Source:
    """The agent that the flags name.

    Args:
        run: its run folder, or
        pretrained: its name or path; see `hrlspec.pretrained`.
        step: the checkpoint of the run; the newest if not given.

    Raises:
        UserError: not exactly one of them is given, or a run folder's record or a file cannot be read here.
        AgentFileError: there is no such agent, or its card is not of this version.
    """
    check_named(run, pretrained, step)
    if pretrained is not None:
        return _in_file(pretrained)
    assert run is not None
    return _in_run(run, step)


def check_named(run: Path | None, pretrained: str | None, step: int | None) -> None:
    """Whether the flags name one agent; nothing is read.

    Raises:
        UserError: not exactly one of --run and --pretrained is given, or --step with the latter.
    """
    if (run is None) == (pretrained is None):
        found = "none" if run is None else "both"
        raise UserError(f"expected exactly one of --run and --pretrained, found {found}")
    if pretrained is not None and step is not None:
        raise UserError("--step goes with --run: a file holds the agent of one step")


def check_shield(trained: TrainedAgent) -> None:
    """Whether an agent can be shielded.

    Raises:
        UserError: it has no reach critic.
    """
    if "reach_critic" not in trained.params:
        raise UserError("--shield needs the reach critic of an agent that was trained with a shield; this one was not")


def find_file(name: str) -> AgentFile:
    """An agent in a file.

    Raises:
        UserError: a library is missing.
        AgentFileError: there is no such agent, or its card is not of this version.
    """
    try:
        return read_agent(name)
    except ImportError as error:
        raise UserError(str(error)) from error


def load_file(file: AgentFile) -> Params:
    """Its parameters.

    Raises:
        UserError: a library is missing.
        AgentFileError: they do not fit.
    """
    try:
        return read_params(file)
    except ImportError as error:
        raise UserError(str(error)) from error


def _in_file(name: str) -> Source:
    file = find_file(name)

    def load() -> tuple[TrainedAgent, dict[str, Any]]:
        facts = {"pretrained": name, "env_steps": file.card.env_steps, "reward_set": file.reward_set}
        return TrainedAgent(file.agent, load_file(file), file.rewards), facts

    return Source(file.preset, load, None, file.seed)


def _in_run(run: Path, step: int | None) -> Source:
    experiment = experiment_of(read_record(run)["config"], str(run), to_act=True)

    def load() -> tuple[TrainedAgent, dict[str, Any]]:
        agent = experiment.agent
        params, found = _load_params(agent, run, step)
        facts = {"run": str(run), "checkpoint_step": found, "reward_set": experiment.reward_set}
        return TrainedAgent(agent, params, experiment.rewards), facts

    return Source(experiment.preset, load, run, experiment.seed, experiment.is_foreign)


def _load_params(agent: Agent, run: Path, step: int | None) -> tuple[Params, int]:
    """What acting needs of the newest intact checkpoint, or of that of ``step``, and its step.

    Raises:
        CheckpointError: there is none.
    """
    target = {"params": agent.acting(jax.eval_shape(agent.init, jax.random.key(0)))}
    restored = checkpoint.load(run / "checkpoints", target, step=step, partial=True)
    return restored.state["params"], restored.step
