"""Records that no run made."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.paper.records import Record


def record(curve: Sequence[float], final: float, violations: float = 0.0, seed: int = 0) -> Record:
    """A record of evaluations every 100 steps."""
    return Record(
        settings={"env": "letter", "seed": seed, "config": {"discount": 0.9}},
        circumstances={"commit": "0123abc", "machine": "a small one", "versions": {"jax": "0.10"}},
        env_steps=100 * len(curve),
        wall_s=60.0,
        curve={
            "env_steps": [100 * (i + 1) for i in range(len(curve))],
            "eval/return_mean": list(curve),
            "train/violations": [violations] * len(curve),
        },
        final={
            "suite": {"return_mean": final, "success_rate": final, "spl": final, "steps_mean": 50.0},
            "contested_choice": {"contested_choice": final},
        },
    )
