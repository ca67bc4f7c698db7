"""A real run that is as small as it can be with every technique on."""

from __future__ import annotations

from pathlib import Path

ITERATIONS, STEPS = 12, 80
TOTAL = ITERATIONS * STEPS

FLAGS = """
--config.num-envs 8 --config.num-steps 10 --config.group 4 --config.planner-share 4
--config.low.epochs 1 --config.low.minibatches 2 --config.high.epochs 1 --config.high.minibatches 1
--config.shield.minibatches 2 --config.relabel.share 0.5
--config.curriculum.levels 2 --config.curriculum.tasks-per-level 16 --config.curriculum.max-nodes 6
--config.network.latent 8 --config.network.conv-channels --config.network.encoder-mlp 8
--config.network.planner-features 8 --config.network.planner-hidden 8 --config.network.planner-rounds 0
--config.network.planner-policy 8 --config.network.task-features 8 --config.network.task-rounds 0
--config.network.actor 8 --config.network.critic 8 --config.network.reach-critic 8
--evaluation.every 400 --evaluation.episodes 20 --evaluation.final-tasks 2 --evaluation.contested 0
""".split()


def arguments(out: Path, *more: str) -> list[str]:
    """The flags of a run of `TOTAL` steps into ``out``; evaluations of 20 episodes share one compiled program."""
    return [*FLAGS, "--total-steps", str(TOTAL), "--out", str(out), *more]
