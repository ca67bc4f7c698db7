"""Zero-shot reinforcement learning from SPECTRL specifications: language, agent, training, evaluation."""

from __future__ import annotations

from hrlspec.agent.agent import Agent
from hrlspec.config import Config
from hrlspec.evaluation.episodes import run_episodes, trace_episodes
from hrlspec.learning.train import Trainer, TrainState
from hrlspec.spec import compile, parse
from hrlspec.tasks.rewards import Bonus, RewardMachine, reward_machine
from hrlspec.version import __version__

__all__ = [
    "Agent",
    "Bonus",
    "Config",
    "RewardMachine",
    "TrainState",
    "Trainer",
    "__version__",
    "compile",
    "parse",
    "reward_machine",
    "run_episodes",
    "trace_episodes",
]
