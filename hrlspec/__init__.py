"""Zero-shot reinforcement learning from logical specifications: language, agent, training, evaluation.

What is offered here is imported when it is first asked for, so that a module below can be had without all the others.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from hrlspec.version import __version__

if TYPE_CHECKING:
    from hrlspec.agent.agent import Agent
    from hrlspec.api import TrainedAgent, evaluate, pretrained, train
    from hrlspec.config import Config
    from hrlspec.learning.train import Trainer
    from hrlspec.presets import preset  # type: ignore[no-redef]  # there is a module of that name, too
    from hrlspec.spec import compile_task, parse
    from hrlspec.tasks.rewards import reward_machine

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
    "pretrained",
    "reward_machine",
    "train",
]

_MODULES = {
    "Agent": "agent.agent",
    "Config": "config",
    "TrainedAgent": "api",
    "Trainer": "learning.train",
    "compile_task": "spec",
    "evaluate": "api",
    "parse": "spec",
    "preset": "presets",
    "pretrained": "api",
    "reward_machine": "tasks.rewards",
    "train": "api",
}

if not TYPE_CHECKING:  # else any name would pass

    def __getattr__(name: str) -> Any:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
