"""Settings of kept records under the names that they have today.

Records are never edited, so those made before a setting was renamed have its old name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

_OPTIMISER = ("learning_rate", "final_learning_rate", "epochs", "minibatches", "max_grad_norm")
_LEVELS = {"low": "config.low", "high": "method_settings.high.ppo"}
_PLANNER = "method_settings.high"

RENAMED = {
    "config.relabel.visits": "config.relabel.hindsight",
    "config.shield.learning_rate": "config.shield.optimiser.learning_rate",
    "config.shield.minibatches": "config.shield.optimiser.minibatches",
    "config.max_operator": f"{_PLANNER}.max_operator",
    "config.unfinished": f"{_PLANNER}.learns_unfinished",
    "config.relabel.planner_policy": f"{_PLANNER}.learns_from_copies",
    "config.planner_share": f"{_PLANNER}.steps_per_sample",
    "config.transe": f"{_PLANNER}.transe",
    "config.transe_margin": f"{_PLANNER}.transe_margin",
    "config.network.advised": f"{_PLANNER}.advised",
    "config.network.advice": f"{_PLANNER}.network.advice",
    "config.network.child_embeddings": f"{_PLANNER}.network.child_embeddings",
    **{f"config.network.planner_{n}": f"{_PLANNER}.network.{n}" for n in ("features", "hidden", "policy", "rounds")},
    **{f"config.{level}.{n}": f"{now}.optimiser.{n}" for level, now in _LEVELS.items() for n in _OPTIMISER},
    **{f"config.{level}.most_ratio": f"{now}.dual_clip" for level, now in _LEVELS.items()},
    **{f"config.{level}.relative": f"{now}.advantage_scale" for level, now in _LEVELS.items()},
}
GONE: dict[str, tuple[Any, ...]] = {
    "config.low.expectile": (0.5,),
    "config.high.expectile": (0.5,),
    # Recipe hrlspec's records were made without the correction, which is always made now.
    "config.relabel.corrected": (False, True),
}
"""Settings with the values that records may have."""
NEW = {
    "config.shield.optimiser.final_learning_rate": 1e-3,
    "config.shield.optimiser.epochs": 1,
    "config.shield.optimiser.max_grad_norm": 1.0,
    "config.curriculum.joint": 0.0,
    "config.network.chart": [],
    "config.network.waves": 0,
    "config.curriculum.retry": 0.0,
    "config.network.forbidden": False,
    "config.network.exclusions": False,
    "config.network.near": 0.0,
    "config.network.critic_encoder": False,
    "begun_from": None,
}
"""Settings with the value that the code had before."""
OF_METHODS = {
    "config.future_embedding": "myopic-low option",
    "config.options": "option",
    "config.network.whole_task": "ltl2action",
}
"""Settings that methods have taken the place of: where each was not what it was for ours."""
OWN = {"option": {f"{_PLANNER}.sharpness": 100.0, f"{_PLANNER}.decay": 0.98}}
"""Settings of methods without a planner, with the value that the code had before."""


def dotted(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted names."""
    if not isinstance(settings, dict):
        return {prefix: settings}
    return {
        name: value
        for key, inner in settings.items()
        for name, value in dotted(inner, f"{prefix}.{key}" if prefix else key).items()
    }


ADDED = {
    "config.blocks": 1,
    "evaluation.final": "test",
    "config.curriculum.stay": 0.0,
    "config.curriculum.longest_stay": 200,
    "config.curriculum.hold_before_jump": 30,
}
ADDED_TO_PLANNERS = {
    f"{_PLANNER}.values_paths": False,
    f"{_PLANNER}.inverse_temperature": 400.0,
    f"{_PLANNER}.tells_path": False,
}
"""What records lack that are older than these settings, and what they would have said."""
BEFORE = {
    "config.blocks": (1,),
    "config.group": (8, 32),
    "config.low.optimiser.epochs": (2,),
    "config.low.optimiser.minibatches": (16,),
    "config.low.value_coefficient": (0.5,),
    # LTL2Action had none under recipe hrlspec.
    "config.network.conv_channels": ([],),
    # Zone under recipe hrlspec, which now is told what violates the task, and whose critic has an encoder of its own.
    "config.network.forbidden": (False,),
    "config.network.near": (0.0,),
    "config.network.critic_encoder": (False,),
    f"{_PLANNER}.steps_per_sample": (64,),
}
"""What has been changed since the records were made, and what they say of it. ``results/README.md`` tells."""


def effective(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as a run folder keeps them, old or new, by today's names; without those of a shield that is off.

    And without those that were changed since: see `before`.
    """
    return {name: value for name, value in _translated(settings).items() if name not in BEFORE}


def before(settings: Mapping[str, Any]) -> dict[str, Any]:
    """What a record says of the settings that were changed since."""
    return {name: value for name, value in _translated(settings).items() if name in BEFORE}


def _translated(settings: Mapping[str, Any]) -> dict[str, Any]:
    now = dotted(json.loads(json.dumps(settings)))
    if "method_settings" not in settings:
        now = _renamed(now)
    if not now["config.shield.enabled"]:
        now = {name: value for name, value in now.items() if not name.startswith("config.shield.")}
    return ADDED | (ADDED_TO_PLANNERS if f"{_PLANNER}.transe" in now else {}) | now


def _renamed(old: Mapping[str, Any]) -> dict[str, Any]:
    method = old["method"]
    for name, methods in OF_METHODS.items():
        assert old[name] == ((method in methods.split()) != (name == "config.future_embedding")), name
    for name, values in GONE.items():
        assert old[name] in values, name
    left = {name: value for name, value in old.items() if name not in OF_METHODS and name not in GONE}
    mode = left.pop("config.shield.mode")
    now = {_rename(name): value for name, value in left.items()}
    if method in ("ltl2action", "option"):
        now = {name: value for name, value in now.items() if not name.startswith(_PLANNER)}
    return now | NEW | OWN.get(method, {}) | {"config.shield.enabled": mode == "state"}


def _rename(name: str) -> str:
    if name in RENAMED:
        return RENAMED[name]
    return name.replace("config.high.", f"{_PLANNER}.ppo.")
