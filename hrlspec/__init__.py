"""Zero-shot reinforcement learning from SPECTRL specifications: language, agent, training, evaluation."""

from __future__ import annotations

from hrlspec.agent import Agent
from hrlspec.config import Config
from hrlspec.evaluation.episodes import run_episodes, trace_episodes
from hrlspec.rewards import Bonus, RewardMachine, reward_machine
from hrlspec.spec import compile, parse
from hrlspec.training import Trainer, TrainState
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
