"""Zero-shot reinforcement learning from logical specifications: language, agent, training, evaluation."""

from __future__ import annotations

from hrlspec.agent.agent import Agent
from hrlspec.api import TrainedAgent, evaluate, train
from hrlspec.config import Config
from hrlspec.learning.train import Trainer
from hrlspec.presets import preset
from hrlspec.spec import compile_task, parse
from hrlspec.tasks.rewards import reward_machine
from hrlspec.version import __version__

__all__ = [
    "Agent",
    "Config",
    "TrainedAgent",
    "Trainer",
    "__version__",
    "compile_task",
    "evaluate",
    "parse",
    "preset",
    "reward_machine",
    "train",
]
