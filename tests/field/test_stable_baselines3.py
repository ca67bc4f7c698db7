"""Stable-Baselines3 makes the environments by id and trains on them."""

from __future__ import annotations

import pytest

import hrlspec.gymnasium  # noqa: F401 - registers the ids

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed", exc_type=ImportError)


@pytest.mark.filterwarnings("ignore")  # theirs
@pytest.mark.parametrize("name", ["letter", "walk"])
def test_ppo_trains_on_environments_made_by_id(name: str) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env(f"hrlspec/{name}-v0", 2, seed=0, env_kwargs={"task": "achieve a; achieve b"})
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=16, n_epochs=1, device="cpu", seed=0)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(64)
    assert model.num_timesteps == 64
    assert any((p != q).any() for p, q in zip(before, model.policy.parameters(), strict=True))
    assert envs.reset().shape == (2, *envs.observation_space.shape)
