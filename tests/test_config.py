"""Settings that cannot be meant are refused where they are made, and changed all at once or not at all."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from hrlspec.agent.networks.planner import PlannerConfig
from hrlspec.config import (
    Config,
    ConfigError,
    CurriculumConfig,
    NetworkConfig,
    OptimiserConfig,
    PPOConfig,
    RelabelConfig,
    ShieldConfig,
    evolve,
    from_plain,
)
from hrlspec.methods import ImplicitPlanner, Ours
from hrlspec.methods.option import LogicValueIteration
from tests.probes import Corridor, small_agent, small_config, small_planner

INF = math.inf
ONE = OptimiserConfig(minibatches=1)
"""Settings of the optimiser that any number of rows can be shared by."""

BOUNDS: dict[type, dict[str, tuple[float, float]]] = {
    Config: {
        "num_envs": (1, INF),
        "num_steps": (2, INF),
        "blocks": (1, INF),
        "total_steps": (1, 2**40),
        "discount": (0, 1),
        "noise_correlation": (0, 0.999),
        "final_noise_correlation": (0, 0.999),
        "steps_per_slot": (1, INF),
        "group": (1, INF),
    },
    NetworkConfig: {
        "latent": (1, INF),
        "conv_channels": (1, INF),
        "chart": (1, INF),
        "encoder_mlp": (1, INF),
        "task_features": (1, INF),
        "task_rounds": (0, INF),
        "actor": (1, INF),
        "critic": (1, INF),
        "reach_critic": (1, INF),
        "task_scale": (1e-3, 1e3),
        "near": (0, 1e6),
        "waves": (0, 16),
        "lookahead": (0, INF),
        "memory": (0, INF),
    },
    OptimiserConfig: {
        "learning_rate": (0, 1e6),
        "final_learning_rate": (0, 1e6),
        "epochs": (1, INF),
        "minibatches": (1, INF),
        "max_grad_norm": (1e-9, 1e9),
    },
    PPOConfig: {
        "clip": (0, 1e6),
        "dual_clip": (1, 1e9),
        "entropy": (0, 1e6),
        "final_entropy": (0, 1e6),
        "entropy_floor": (0, 1e6),
        "final_entropy_floor": (0, 1e6),
        "value_coefficient": (0, 1e6),
        "gae_lambda": (0, 1),
        "advantage_scale": (0, 1e6),
    },
    CurriculumConfig: {
        "levels": (1, INF),
        "promotion": (0, 1),
        "window": (0, INF),
        "earlier": (0, 1),
        "tree_share": (0, 1),
        "joint": (0, 1),
        "contested": (0, 1),
        "retry": (0, 1),
        "stay": (0, 1),
        "longest_stay": (2, INF),
        "hold_before_jump": (2, INF),
        "max_branching": (1, INF),
        "max_avoid": (0, INF),
        "tasks_per_level": (1, INF),
        "max_nodes": (3, INF),  # 2 is in its range, and too few for the one level that there must be
    },
    RelabelConfig: {"share": (0, 1), "branch": (0, 1)},
    ShieldConfig: {"threshold": (0, 1), "discount": (0, 1)},
    PlannerConfig: {
        "features": (1, INF),
        "hidden": (1, INF),
        "policy": (1, INF),
        "rounds": (0, INF),
        "advice": (0, 1e6),
    },
    ImplicitPlanner: {
        "steps_per_sample": (1, INF),
        "transe": (0, 1e6),
        "transe_margin": (0, 1e6),
        "advised": (1, INF),
        "inverse_temperature": (0, 1e6),
    },
    LogicValueIteration: {"sharpness": (0, 1e6), "decay": (0, 1)},
}
"""The least and the most that each number, or each entry of a tuple, may be; both included."""

BESIDE: dict[tuple[type, str], dict[str, Any]] = {
    (PPOConfig, "clip"): {"dual_clip": 1e9},
    (PPOConfig, "dual_clip"): {"clip": 0.0},
    (CurriculumConfig, "max_nodes"): {"levels": 1},
    (Config, "num_envs"): {"low": PPOConfig(optimiser=ONE), "shield": ShieldConfig(optimiser=ONE)},
}
"""What else must be set for a value at a bound to be accepted."""

FIELDS = [(kind, name) for kind, fields in BOUNDS.items() for name in fields]
NAMES = [f"{kind.__name__}.{name}" for kind, name in FIELDS]


def make(kind: type, name: str, value: float) -> Any:
    """Settings with a number, or a tuple that ends with it."""
    given = (8, value) if isinstance(getattr(kind, name), tuple) else value
    return kind(**BESIDE.get((kind, name), {}), **{name: given})


def test_every_number_has_bounds() -> None:
    for kind, fields in BOUNDS.items():
        numbers = [
            field.name
            for field in dataclasses.fields(kind)
            if isinstance(field.default, int | float | tuple) and not isinstance(field.default, bool)
        ]
        assert sorted(fields) == sorted(numbers)


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=NAMES)
def test_bounds_are_included_and_nothing_beyond_them_is(kind: type, name: str) -> None:
    least, most = BOUNDS[kind][name]
    whole = isinstance(least, int) and "int" in str(kind.__dataclass_fields__[name].type)
    for bound, direction in ((least, -INF), (most, INF)):
        if math.isinf(bound):
            continue
        make(kind, name, bound)
        beyond = bound + int(math.copysign(1, direction)) if whole else float(np.nextafter(bound, direction))
        with pytest.raises(ConfigError, match=rf"^{kind.__name__}\.{name} is .*, expected "):
            make(kind, name, beyond)
    if not whole:
        with pytest.raises(ConfigError, match=rf"^{kind.__name__}\.{name} is nan, expected "):
            make(kind, name, math.nan)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Config(num_envs=0), "Config.num_envs is 0, expected at least 1"),
        (lambda: Config(num_envs=1.5), "Config.num_envs is 1.5, expected a whole number"),
        (lambda: Config(num_envs=True), "Config.num_envs is True, expected a whole number"),
        (lambda: PPOConfig(clip="0.2"), "PPOConfig.clip is '0.2', expected a number"),
        (
            lambda: NetworkConfig(actor=[64, 64]),
            r"NetworkConfig.actor is \[64, 64\], expected a tuple, each entry a whole number",
        ),
        (lambda: NetworkConfig(roles=1), "NetworkConfig.roles is 1, expected True or False"),
        (lambda: Config(low={}), "Config.low is {}, expected PPOConfig"),
        (lambda: Config(discount=1.5), "Config.discount is 1.5, expected a number from 0 to 1"),
        (lambda: NetworkConfig(actor=(64, -64)), r"NetworkConfig.actor is \(64, -64\), expected at least 1"),
        (lambda: PPOConfig(dual_clip=1.1), r"PPOConfig.dual_clip is 1.1, expected at least 1 \+ clip, 1.2"),
        (lambda: PPOConfig(clip=0.5, dual_clip=1.4), r"dual_clip is 1.4, expected at least 1 \+ clip, 1.5"),
        (
            lambda: CurriculumConfig(levels=15),
            r"CurriculumConfig.max_nodes is 16, expected at least levels \+ 2, 17",
        ),
        (
            lambda: Config(num_envs=10, relabel=RelabelConfig(share=0.0), low=PPOConfig(optimiser=OptimiserConfig())),
            "Config.low.optimiser.minibatches is 16, expected a divisor of 10, the number of environments and copies",
        ),
        (
            lambda: Config(num_envs=12, low=PPOConfig(optimiser=ONE)),
            "Config.shield.optimiser.minibatches is 8, expected a divisor of 12, the number of environments",
        ),
        (lambda: LogicValueIteration(decay=-0.1), "LogicValueIteration.decay is -0.1, expected a number from 0 to 1"),
    ],
)
def test_one_line_says_what_is_wrong(wrong: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=f"{message}$") as raised:
        wrong()
    assert "\n" not in str(raised.value)


def test_settings_that_go_with_each_other_are_accepted() -> None:
    assert PPOConfig(clip=0.5, dual_clip=1.5).dual_clip == 1.5
    assert CurriculumConfig(levels=14).max_nodes == 16
    # 8 environments and 4 copies in three parts; the reach critic learns from no copies.
    low = PPOConfig(optimiser=OptimiserConfig(minibatches=3))
    assert Config(num_envs=8, low=low).copies_per_block == 4
    # Without a shield nothing has to share the environments.
    assert not Config(num_envs=12, low=PPOConfig(optimiser=ONE), shield=ShieldConfig(enabled=False)).shield.enabled


def test_what_follows_from_the_settings() -> None:
    config = Config(
        num_envs=32,
        num_steps=10,
        total_steps=961,
        steps_per_slot=3,
        low=PPOConfig(optimiser=ONE),
        relabel=RelabelConfig(share=0.25),
    )
    assert (config.copies_per_block, config.steps_per_iteration, config.episode_slots) == (8, 320, 3)
    assert config.num_iterations == 4  # three have 960 steps
    assert dataclasses.replace(config, steps_per_slot=50).episode_slots == 2


@pytest.mark.parametrize(
    ("minibatches", "message"),
    [
        # 32 environments of 24 steps, one decision in four steps: 192.
        (7, "expected a divisor of 192, the number of planner samples"),
        (384, "expected a divisor of 192, the number of planner samples"),
    ],
)
def test_an_agent_refuses_a_method_that_does_not_go_with_its_settings(minibatches: int, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"ppo.optimiser.minibatches is {minibatches}, {message}"):
        small_agent(Corridor(), small_config(), Ours(high=small_planner(ppo__optimiser__minibatches=minibatches)))


# --- Changes ---


def test_changes_by_dotted_names() -> None:
    before = Config()
    after = evolve(before, {"num_envs": 64, "low.optimiser.learning_rate": 0.5, "low.clip": 0.1, "network.actor": (7,)})
    assert (after.num_envs, after.low.optimiser.learning_rate, after.low.clip, after.network.actor) == (
        64,
        0.5,
        0.1,
        (7,),
    )
    back = dataclasses.replace(
        after,
        num_envs=before.num_envs,
        network=before.network,
        low=dataclasses.replace(after.low, clip=before.low.clip, optimiser=before.low.optimiser),
    )
    assert back == before == Config()  # nothing else has changed, and what it came from has not
    assert evolve(before, {}) == before


def test_all_changes_are_made_before_they_are_checked() -> None:
    before = Config(num_envs=16, relabel=RelabelConfig(share=0.0))
    together = {"num_envs": 15, "low.optimiser.minibatches": 5, "shield.optimiser.minibatches": 3}
    for name in together:
        with pytest.raises(ConfigError, match="expected a divisor of"):
            evolve(before, {name: together[name]})
    for order in (list(together), list(together)[::-1]):
        after = evolve(before, {name: together[name] for name in order})
        assert (after.num_envs, after.low.optimiser.minibatches, after.shield.optimiser.minibatches) == (15, 5, 3)
    ppo = evolve(PPOConfig(dual_clip=3.0), {"clip": 4.0, "dual_clip": 5.0})
    assert (ppo.clip, ppo.dual_clip) == (4, 5)


def test_a_part_is_replaced_before_it_is_changed() -> None:
    for names in (("low", "low.clip"), ("low.clip", "low")):
        after = evolve(Config(), {name: PPOConfig(entropy=0.5) if name == "low" else 0.1 for name in names})
        assert (after.low.entropy, after.low.clip) == (0.5, 0.1)


def test_changes_of_a_method() -> None:
    planner = evolve(ImplicitPlanner(), {"network.features": 5, "ppo.optimiser.epochs": 7})
    assert (planner.network.features, planner.ppo.optimiser.epochs) == (5, 7)
    assert planner.network.hidden == ImplicitPlanner().network.hidden
    assert Ours().replace(transe=0.5) == Ours(high=evolve(ImplicitPlanner(), {"transe": 0.5}))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("num_evns", "unknown setting 'num_evns' of Config, expected one of: num_envs, num_steps"),
        ("lwo.clip", "unknown setting 'lwo' of Config, expected one of: "),
        ("low.learning_rate", "unknown setting 'learning_rate' of PPOConfig, expected one of: optimiser, clip"),
        ("num_envs.first", "unknown setting 'first' of int, which has none"),
        ("num_iterations", "unknown setting 'num_iterations' of Config"),  # follows from others
        ("", "unknown setting '' of Config"),
    ],
)
def test_unknown_names_are_refused(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        evolve(Config(), {"discount": 0.5, name: 1})


def test_a_change_out_of_range_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"OptimiserConfig.learning_rate is -1, expected a number from 0 to 1000000"):
        evolve(Config(), {"low.optimiser.learning_rate": -1})


def test_settings_can_be_static_arguments() -> None:
    """Equal ones are one compiled program, and none is changed afterwards."""
    assert hash(Config()) == hash(evolve(Config(), {"discount": Config.discount}))
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().discount = 0.5  # type: ignore[misc]


def test_a_record_may_lack_a_later_setting_and_no_other() -> None:
    network = NetworkConfig(latent=8, chart=(4, 2))
    record = dataclasses.asdict(network)
    assert from_plain(NetworkConfig(), record) == network
    del record["chart"]
    assert from_plain(network, record) == dataclasses.replace(network, chart=())  # as it was before there were any
    del record["latent"]
    with pytest.raises(ConfigError, match=r"^the setting 'network.latent' is not in both$"):
        from_plain(network, record, prefix="network.")
