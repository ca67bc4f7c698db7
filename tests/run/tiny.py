"""A real run that is as small as it can be with every technique on, on two devices."""

from __future__ import annotations

from pathlib import Path

ITERATIONS, STEPS = 12, 80
TOTAL = ITERATIONS * STEPS

FLAGS = """
--config.num-envs 8 --config.num-steps 10 --config.group 4 --config.blocks 2
--config.low.optimiser.epochs 1 --config.low.optimiser.minibatches 2
--config.shield.optimiser.minibatches 2 --config.relabel.share 0.5
--config.curriculum.levels 2 --config.curriculum.tasks-per-level 16 --config.curriculum.max-nodes 6
--config.network.latent 8 --config.network.conv-channels --config.network.encoder-mlp 8
--config.network.task-features 8 --config.network.task-rounds 0
--config.network.actor 8 --config.network.critic 8 --config.network.reach-critic 8
--evaluation.every 400 --evaluation.episodes 20 --evaluation.final-tasks 2 --evaluation.contested 0
""".split()
PLANNER = """
--method.high.steps-per-sample 4 --method.high.ppo.optimiser.epochs 1 --method.high.ppo.optimiser.minibatches 1
--method.high.network.features 8 --method.high.network.hidden 8 --method.high.network.rounds 0
--method.high.network.policy 8
""".split()


def arguments(out: Path, *more: str) -> list[str]:
    """The flags of a run of `TOTAL` steps into ``out``; evaluations of 20 episodes share one compiled program."""
    return [*FLAGS, *PLANNER, "--total-steps", str(TOTAL), "--out", str(out), *more]
