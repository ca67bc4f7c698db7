"""Settings of every preset, recipe, reward set and method: they go with each other, and are what was tuned."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any, ClassVar

import pytest

from envs_jax import Box, Environment
from hrlspec.agent.agent import Agent
from hrlspec.config import Config, evolve
from hrlspec.learning.train import Trainer
from hrlspec.methods import LTL2ACTION, METHODS, MYOPIC_LOW, NO_ER, OPTION, ImplicitPlanner, Ours
from hrlspec.presets import PRESETS, RECIPES, Recipe, RewardSet, preset, preset_for
from tests.probes import Corridor, small_planner

REWARD_SETS: tuple[RewardSet, ...] = (1, 2)
ABLATIONS = ("myopic-low", "no-er")


@functools.cache
def world(name: str) -> Environment:
    if name.startswith("zone"):
        pytest.importorskip("mujoco.mjx")
    return preset(name).make()


def config_of(name: str, method: str = "ours", recipe: Recipe = "hrlspec", reward_set: RewardSet = 1) -> Config:
    return preset(name).settings(method, recipe, reward_set)[0]


def planner_of(name: str, method: str = "ours", recipe: Recipe = "hrlspec", reward_set: RewardSet = 1) -> Any:
    return preset(name).settings(method, recipe, reward_set)[1].high


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("name", PRESETS)
def test_an_agent_can_be_built_of_every_combination(name: str, recipe: Recipe, method: str) -> None:
    env = world(name)
    for reward_set in REWARD_SETS:
        config, chosen = preset(name).settings(method, recipe, reward_set)
        agent = Agent(env, config, chosen)
        assert agent.high is chosen.high
        assert agent.low.config == config
        assert hash(Trainer(agent)) == hash(Trainer(Agent(env, config, chosen)))  # a static argument
        assert (chosen.name, chosen.sees) == (METHODS[method].name, METHODS[method].sees)
        assert chosen.configure(config) == config  # nothing is changed a second time
        assert config.curriculum.max_avoid <= env.num_propositions - 2
        if isinstance(env.action_space, Box):
            assert config.low.dual_clip == 3.0
        else:
            assert config.noise_correlation == config.final_noise_correlation == 0
        assert preset(name).rewards(reward_set).avoid.shape[1] == env.num_propositions


@pytest.mark.parametrize(
    ("name", "recipe", "ours", "ltl2action", "option"),
    [
        ("letter", "paper", 2e-3, 2e-3, 2e-3),
        ("letter", "hrlspec", 7e-4, 3.5e-4, 1.4e-3),
        ("letter12", "paper", 1e-3, 1e-3, 1e-3),
        ("letter12", "hrlspec", 7e-4, 7e-4, 7e-4),
        ("walk", "paper", 1e-3, 2e-3, 2e-3),
        ("walk", "hrlspec", 1e-3, 1e-3, 2e-3),
        ("flatworld", "paper", 1e-3, 1e-3, 1e-3),
        ("flatworld", "hrlspec", 1e-3, 1e-3, 1e-3),
        ("zone", "paper", 1.4e-3, 7e-4, 1.4e-3),
        ("zone", "hrlspec", 1.4e-3, 1.4e-3, 1.4e-3),
        ("zone-nm", "paper", 1.4e-3, 7e-4, 1.4e-3),
        ("zone-ltl2action", "hrlspec", 1.4e-3, 1.4e-3, 1.4e-3),
    ],
)
def test_learning_rates(name: str, recipe: Recipe, ours: float, ltl2action: float, option: float) -> None:
    """As tuning chose them; an ablation is ours but for one thing."""
    expected = {"ours": ours, "ltl2action": ltl2action, "option": option} | dict.fromkeys(ABLATIONS, ours)
    for method, reward_set in itertools.product(METHODS, REWARD_SETS):
        assert config_of(name, method, recipe, reward_set).low.optimiser.learning_rate == expected[method]


@pytest.mark.parametrize(
    ("name", "recipe", "steps", "envs", "rollout", "discount", "discount2"),
    [
        ("letter", "paper", 3_000_000, 128, 64, 0.94, 0.97),
        ("letter", "hrlspec", 2_500_000, 128, 64, 0.9, 0.97),
        ("letter12", "hrlspec", 6_000_000, 128, 64, 0.9, 0.97),
        ("walk", "paper", 10_000_000, 256, 128, 0.99, 0.99),
        ("walk", "hrlspec", 10_000_000, 256, 128, 0.99, 0.99),
        ("flatworld", "hrlspec", 15_000_000, 256, 128, 0.997, 0.997),
        ("zone", "paper", 10_000_000, 256, 128, 0.998, 0.998),
        ("zone", "hrlspec", 10_000_000, 128, 128, 0.998, 0.998),
        ("zone-nm", "hrlspec", 10_000_000, 128, 128, 0.998, 0.998),
        ("zone-jaxolotl", "hrlspec", 8_000_000, 128, 128, 0.998, 0.998),
    ],
)
def test_sizes_of_a_run(
    name: str, recipe: Recipe, steps: int, envs: int, rollout: int, discount: float, discount2: float
) -> None:
    for method in METHODS:
        config = config_of(name, method, recipe)
        assert (config.total_steps, config.num_envs, config.num_steps) == (steps, envs, rollout)
        assert config.discount == discount
        assert config_of(name, method, recipe, 2).discount == discount2


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("name", PRESETS)
def test_what_distinguishes_the_methods(name: str, recipe: Recipe) -> None:
    for reward_set in REWARD_SETS:
        ours, config = planner_of(name, "ours", recipe, reward_set), config_of(name, "ours", recipe, reward_set)
        assert config.relabel.share > 0
        # The ablations: one thing each.
        no_er, method = preset(name).settings("no-er", recipe, reward_set)
        assert no_er.relabel.share == no_er.copies_per_block == 0
        assert dataclasses.replace(no_er, relabel=config.relabel, low=config.low) == config
        assert dataclasses.replace(no_er.low, optimiser=config.low.optimiser) == config.low
        copies = no_er.envs_per_block / (config.envs_per_block + config.copies_per_block)
        minibatches = (some.low.optimiser.minibatches for some in (no_er, config))
        assert next(minibatches) in (copies * (number := next(minibatches)), number)
        assert method.high == ours
        myopic, method = preset(name).settings("myopic-low", recipe, reward_set)
        assert (myopic, method.high, method.sees) == (config, ours, "sub-task")
        # The baselines: no planner that learns by gradient.
        flat, method = preset(name).settings("ltl2action", recipe, reward_set)
        network = flat.network
        assert not any((network.roles, network.names, network.symmetric, network.memory, flat.shield.enabled))
        assert network.conv_channels == (16, 32, 64)
        assert (network.task_features, network.task_rounds, method.sees) == (32, 0, "whole task")
        assert method.high.ppo is None
        option, method = preset(name).settings("option", recipe, reward_set)
        assert (option.network.lookahead, option.network.names, option.network.memory) == (0, False, 0)
        assert (option.shield, method.sees, method.high.ppo) == (config.shield, "sub-task", None)
        for baseline in (flat, option):
            told_all = dataclasses.replace(config.curriculum, stay=0.0)  # neither can be told to stay
            assert (baseline.relabel, baseline.curriculum) == (config.relabel, told_all)


@pytest.mark.parametrize("name", PRESETS)
def test_what_distinguishes_the_recipes(name: str) -> None:
    paper, planner = config_of(name, recipe="paper"), planner_of(name, recipe="paper")
    assert not any((paper.network.roles, paper.network.names, paper.network.symmetric))
    assert (paper.curriculum.tree_share, paper.curriculum.contested) == (0, 0)  # sequences alone
    assert paper.shield.enabled
    assert paper.relabel.share == 0.5
    assert (planner.max_operator, planner.learns_unfinished, planner.learns_from_copies) == (True, False, True)
    assert (planner.network.rounds, planner.network.advice, planner.transe) == (8, 0, 0.01)
    # Recipe planner departs in what V^h is asked, and in what it learns from.
    for reward_set, temperature in ((1, 400.0), (2, 80.0)):
        config, method = preset(name).settings("ours", "planner", reward_set)
        as_written, written = preset(name).settings("ours", "paper", reward_set)
        changes = {"high.values_paths": True, "high.inverse_temperature": temperature}
        changes |= {"high.learns_unfinished": True, "high.ppo.optimiser.epochs": 8}
        assert (config, method) == (as_written, evolve(written, changes))
    ours, planner = config_of(name), planner_of(name)
    assert ours.network.roles
    assert ours.network.symmetric
    assert ours.curriculum.tree_share == 0.5
    assert not ours.shield.enabled
    assert (planner.max_operator, planner.learns_unfinished, planner.learns_from_copies) == (False, True, False)
    assert (planner.network.rounds, planner.network.advice, planner.transe) == (0, 400, 0.01)


def test_reward_set_2() -> None:
    for name, recipe in itertools.product(PRESETS, RECIPES):
        assert config_of(name, recipe=recipe, reward_set=2).network.names
        scale = {"paper": 0.0, "planner": 0.0, "hrlspec": 1.0}[recipe]
        assert config_of(name, recipe=recipe, reward_set=2).low.advantage_scale == scale
        assert config_of(name, recipe=recipe).low.advantage_scale == 0
    assert planner_of("letter", reward_set=2).network.advice == 80
    assert planner_of("letter", recipe="paper", reward_set=2).network.advice == 0
    memory = {"letter": 3, "walk": 0, "flatworld": 3, "zone": 2}
    for name, expected in memory.items():
        assert config_of(name, reward_set=2).network.memory == expected
        assert config_of(name, recipe="paper", reward_set=2).network.memory == 0
    walk = config_of("walk", reward_set=2)
    assert (walk.low.value_coefficient, walk.curriculum.tree_share) == (2.0, 0.25)
    assert (config_of("zone").low.entropy, config_of("zone", reward_set=2).low.entropy) == (0.003, 0)


@pytest.mark.parametrize("name", PRESETS)
def test_rewards(name: str) -> None:
    """The order bonuses of the paper's worlds, 5 and 10 or 10 and 20; FlatWorld has none."""
    world(name)
    plain, rich = preset(name).rewards(1), preset(name).rewards(2)
    assert (float(plain.completion), float(plain.subtask), plain.num_rules) == (1, 0, 0)
    assert (float(rich.completion), float(rich.subtask)) == (1, 1)
    bonuses = {"letter": [5, 10], "letter12": [5, 10], "walk": [5, 10], "flatworld": []}.get(name, [10, 20])
    assert rich.bonus.tolist() == bonuses


@pytest.mark.parametrize("name", ["letter", "walk", "zone"])
def test_a_method_given_as_a_value_keeps_its_own_settings(name: str) -> None:
    mine = Ours(high=small_planner())
    config, method = preset(name).settings(mine)
    assert method is mine
    assert config == config_of(name)  # by name the planner alone differs
    for value in (LTL2ACTION, OPTION):
        assert preset(name).settings(value) == preset(name).settings(value.name)
    for value in (MYOPIC_LOW, NO_ER):  # whose planner is the paper's, whatever the recipe
        assert preset(name).settings(value)[1].high == ImplicitPlanner()


def test_a_method_of_ones_own_configures_the_recipe() -> None:
    @dataclasses.dataclass(frozen=True)
    class Short(Ours):
        name: ClassVar[str] = "short"

        def configure(self, config: Config) -> Config:
            return dataclasses.replace(config, num_steps=16)

    config, method = preset_for(Corridor()).settings(Short())
    assert (config.num_steps, method.name) == (16, "short")


def test_unknown_names_are_refused_with_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"^unknown environment 'lettre', expected one of: letter, letter12, walk, "):
        preset("lettre")
    with pytest.raises(ValueError, match=r"^unknown method 'our', expected one of: ours, ltl2action, option, "):
        preset("letter").settings("our")
