"""A method as a value: a high level, the conditioning of the low level, and both levels' shared settings."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar

from hrlspec.agent.high_level import HighLevel
from hrlspec.agent.networks.controller import Sees
from hrlspec.config import Config


@dataclasses.dataclass(frozen=True)
class Method(abc.ABC):
    """What is trained; a frozen dataclass, whose fields are the settings of its own.

    Subclasses live one a file in ``hrlspec/methods``, and anywhere else: nothing has to be registered.

    Attributes:
        high: the high level.
        name: as flags and run folders know it.
        about: one line for ``--help``.
        sees: the part of the task that the low level is conditioned on.
    """

    high: HighLevel

    name: ClassVar[str]
    about: ClassVar[str]
    sees: ClassVar[Sees] = "future"

    def configure(self, config: Config) -> Config:
        """Shared settings as this method needs them, from those of a recipe; must not change them a second time."""
        return config

    def replace(self, **changes: Any) -> Method:
        """A copy with other settings of the high level."""
        return dataclasses.replace(self, high=dataclasses.replace(self.high, **changes))  # type: ignore[type-var]
