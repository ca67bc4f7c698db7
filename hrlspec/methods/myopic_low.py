"""The ablation Myopic-low: ours, but the low level does not see what comes after its sub-task."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from hrlspec.agent.networks.controller import Sees
from hrlspec.methods.ours import Ours


@dataclasses.dataclass(frozen=True)
class MyopicLow(Ours):
    """Ours without the future (paper, "Ablation Study")."""

    name: ClassVar[str] = "myopic-low"
    about: ClassVar[str] = "ours, whose low level does not see what comes after its sub-task"
    sees: ClassVar[Sees] = "sub-task"


MYOPIC_LOW = MyopicLow()
