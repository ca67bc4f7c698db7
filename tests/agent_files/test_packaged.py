"""The agents that come along: small, readable, described on their page, and as good as their cards say."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import pytest
import scipy.stats

import hrlspec
from experiments.pretrain import AGENTS, tables
from hrlspec.agent_files import PACKAGED, packaged_agents, read_agent, read_params
from hrlspec.api import TrainedAgent
from hrlspec.run.commands.run import check_beginning
from hrlspec.run.run_flags import experiments_of, parse_run
from tests.agent_files.made import same
from tests.probes import random_params

PAGE = Path(__file__).parents[2] / "docs" / "pretrained.md"
FALSE_ALARM = 1e-7
EPISODES = 100


def enough(successes: int, bound: float) -> bool:
    """Whether so many of EPISODES agree with a success rate of the bound or more.

    If that is the rate, fewer have a probability below FALSE_ALARM. Tasks differ in how often they succeed, which makes
    the sum of independent episodes vary less than the binomial does (Hoeffding, 1956).
    """
    return bool(scipy.stats.binom.cdf(successes, EPISODES, bound) > FALSE_ALARM)


def successes(trained: TrainedAgent, name: str) -> int:
    """In an episode of each of some tasks of the suite ``dag``, so that they are independent; or more, of few tasks."""
    suite = read_agent(name).preset.suite("dag")
    some = suite.take(range(0, len(suite), max(1, len(suite) // EPISODES)))
    score = hrlspec.evaluate(jax.random.key(3), trained, some, episodes=EPISODES, seed=3).total
    assert score.episodes == EPISODES
    return round(score.success_rate.estimate * EPISODES)


# Compiling what an agent does takes seconds; the others' programs differ from Letter's in their sizes.
SAMPLED = [name if name == "letter" else pytest.param(name, marks=pytest.mark.slow) for name in packaged_agents()]


@pytest.mark.parametrize("name", SAMPLED)
def test_an_agent_is_as_good_as_its_card_says(name: str) -> None:
    bound = read_agent(name).card.success_at_least["dag"]
    assert bound > 0.8
    assert enough(successes(hrlspec.pretrained(name), name), bound)


def test_what_is_enough() -> None:
    """Few failures are chance, many are none; the numbers are of the binomial distribution."""
    assert enough(100, 0.998)
    assert enough(97, 0.998)
    assert not enough(90, 0.998)
    assert enough(80, 0.95)
    assert not enough(70, 0.95)


@pytest.mark.slow
def test_an_agent_that_was_not_trained_is_found_out() -> None:
    trained = hrlspec.pretrained("letter")
    params = random_params(trained.agent, 0)
    assert not enough(successes(TrainedAgent(trained.agent, params, trained.rewards), "letter"), 0.9)


@pytest.mark.parametrize("name", packaged_agents())
def test_training_can_begin_with_an_agent(name: str) -> None:
    flags = parse_run([*AGENTS[name], "--from", name])
    ((experiment, _),) = experiments_of(flags)
    file = check_beginning(flags, experiment)
    assert file is not None
    assert file.path == read_agent(name).path


@pytest.mark.parametrize("name", packaged_agents())
def test_an_agent_is_what_its_card_says(name: str) -> None:
    file = read_agent(name)
    assert name in AGENTS
    assert (file.preset.name, file.card.config["method"], file.seed) == (name, "ours", 0)
    assert file.card.licence == "Apache-2.0"
    assert re.fullmatch(r"[0-9a-f]{40}", file.card.trained["commit"]), "of a checkout without changes"
    suites = {suite for suite in file.preset.suite_names if not suite.endswith("_validation")}
    assert file.card.results.keys() == file.card.success_at_least.keys() == suites
    for suite, bound in file.card.success_at_least.items():
        assert 0 <= file.card.results[suite]["success_rate_interval"][0] - bound < 1e-3
    assert same(read_params(file), hrlspec.pretrained(file.path).params)


def test_they_are_small() -> None:
    assert packaged_agents()
    assert sum(file.stat().st_size for file in PACKAGED.iterdir()) <= 8 * 2**20


def test_the_page_has_what_the_cards_say() -> None:
    assert PAGE.read_text().endswith(tables([read_agent(name) for name in packaged_agents()]))
