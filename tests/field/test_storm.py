"""Some trials of the storm; all of them: ``python -m tests.field.storm``."""

from __future__ import annotations

import collections
import os
from pathlib import Path

import pytest

from tests.field.storm import ENVIRONMENTS, NAMES, PLACES, Storm, plan_of


def test_the_plans_reach_everything() -> None:
    plans = [plan_of(0, index) for index in range(2000)]
    assert plans[7] == plan_of(0, 7)
    assert {plan.name for plan in plans} == {"run", *NAMES}
    assert {plan.place for plan in plans} == {"", *PLACES}
    assert all(any(plan.environment == each for plan in plans) for each in ENVIRONMENTS)
    hazards = collections.Counter(plan.hazard for plan in plans)
    assert min(hazards[each] for each in ("none", "signal", "pipe", "disk")) > 100
    assert {"file", "closed", "full", "pipe"} == {stream for plan in plans for stream in plan.streams}
    assert sum(len(plan.signals) == 2 for plan in plans) > 100


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self"), reason="odd places and disks are Linux's")
def test_a_few_trials(tmp_path: Path) -> None:
    storm = Storm(tmp_path, seed=1)
    found = {index: storm.trial(index) for index in range(6)}
    assert not {str(plan): wrong for plan, _, wrong in found.values() if wrong}
