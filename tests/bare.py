"""An environment stripped of its capabilities."""

from __future__ import annotations

import dataclasses
from typing import Any

from envs_jax import Environment


@dataclasses.dataclass(frozen=True)
class Bare(Environment):
    """The contract and nothing more, of a world that can do more.

    Attributes:
        world: what it is in truth.
    """

    world: Environment

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"bare {self.world.name}"

    @property
    def horizon(self) -> int:  # type: ignore[override]
        return self.world.horizon

    @property
    def propositions(self) -> Any:
        return self.world.propositions

    @property
    def observation_shape(self) -> Any:
        return self.world.observation_shape

    @property
    def observation_space(self) -> Any:
        return self.world.observation_space

    @property
    def action_space(self) -> Any:
        return self.world.action_space

    def resample_layout(self, key: Any, layout: Any, needed: Any, params: Any) -> Any:
        return self.world.resample_layout(key, layout, needed, params)

    def sample_layout(self, key: Any, params: Any) -> Any:
        return self.world.sample_layout(key, params)

    def check_layout(self, layout: Any) -> None:
        self.world.check_layout(layout)

    def reset_to(self, layout: Any, key: Any, params: Any) -> Any:
        return self.world.reset_to(layout, key, params)

    def step_env(self, key: Any, state: Any, action: Any, params: Any) -> Any:
        return self.world.step_env(key, state, action, params)

    def labels(self, state: Any, params: Any) -> Any:
        return self.world.labels(state, params)

    def observation(self, state: Any, params: Any) -> Any:
        return self.world.observation(state, params)

    def proposition_view(self, observation: Any) -> Any:
        return self.world.proposition_view(observation)
