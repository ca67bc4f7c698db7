"""The ablation No-ER: ours without relabelled experience."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from hrlspec.config import Config, evolve
from hrlspec.methods.ours import Ours


@dataclasses.dataclass(frozen=True)
class NoER(Ours):
    """Ours without experience relabelling (paper, "Ablation Study")."""

    name: ClassVar[str] = "no-er"
    about: ClassVar[str] = "ours without relabelled experience"

    def configure(self, config: Config) -> Config:
        """No relabelled copies; minibatches as large as with them, if the environments divide into such."""
        rows, minibatches = config.envs_per_block + config.copies_per_block, config.low.optimiser.minibatches
        fewer, rest = divmod(minibatches * config.envs_per_block, rows)
        kept = minibatches if rest or config.envs_per_block % fewer else fewer
        return evolve(config, {"relabel.share": 0.0, "low.optimiser.minibatches": kept})


NO_ER = NoER()
