"""The ablation No-ER: ours without relabelled experience."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from hrlspec.config import Config
from hrlspec.methods.ours import Ours


@dataclasses.dataclass(frozen=True)
class NoER(Ours):
    """Ours without experience relabelling (paper, "Ablation Study")."""

    name: ClassVar[str] = "no-er"
    about: ClassVar[str] = "ours without relabelled experience"

    def configure(self, config: Config) -> Config:
        """No relabelled copies."""
        return dataclasses.replace(config, relabel=dataclasses.replace(config.relabel, share=0.0))


NO_ER = NoER()
