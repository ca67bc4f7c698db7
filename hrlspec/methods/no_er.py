"""The ablation No-ER: ours without relabelled experience."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from hrlspec.config import Config, without_copies
from hrlspec.methods.ours import Ours


@dataclasses.dataclass(frozen=True)
class NoER(Ours):
    """Ours without experience relabelling (paper, "Ablation Study")."""

    name: ClassVar[str] = "no-er"
    about: ClassVar[str] = "ours without relabelled experience"

    def configure(self, config: Config) -> Config:
        """See `without_copies`."""
        return without_copies(config)


NO_ER = NoER()
