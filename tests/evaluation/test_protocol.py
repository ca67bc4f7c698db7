"""Whole evaluations: of agents written by hand, whose scores are known, and of an untrained one."""

from __future__ import annotations

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.agent.networks.planner import PlannerConfig
from hrlspec.config import Config, NetworkConfig
from hrlspec.evaluation import (
    ChoiceEvaluation,
    Suite,
    SuiteEvaluation,
    choice_evaluation,
    episodes,
    evaluate_suite,
    final_evaluation,
    make_cases,
    periodic_evaluation,
    return_evaluation,
    run_episodes,
    suite_from_text,
    suite_from_trees,
)
from hrlspec.exact.contested import contested_suite
from hrlspec.methods import OURS
from hrlspec.tasks.rewards import reward_machine
from hrlspec.tasks.sampling import sample_sequences
from tests.bare import Bare
from tests.evaluation.scripted import manner, walker

LETTER = envs_jax.make("letter")
COMPLETION = reward_machine(LETTER.propositions)
WALKER = walker(LETTER)
NEAREST, AHEAD = manner(), manner(look_ahead=True)
KEY = jax.random.key(0)


def _sequences(level: int, num_tasks: int, max_avoid: int) -> Suite:
    trees = sample_sequences(
        np.random.default_rng(level),
        level=level,
        num_tasks=num_tasks,
        num_propositions=5,
        max_nodes=8,
        max_avoid=max_avoid,
    )
    return suite_from_trees("sequences", trees, LETTER.propositions)


def _parameters(agent: Agent, seed: int) -> Params:
    """Random numbers of the right shapes: initialisers of the networks take longer to compile than all else here."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    return jax.tree.map(lambda x: rng.normal(0, 0.3, x.shape).astype(x.dtype), shapes)


@functools.cache
def _cases():
    return make_cases(LETTER, _sequences(4, 12, 2), layouts_per_task=10)


def test_episodes_can_be_jitted_and_vmapped():
    """Over parameters, in chunks of which the last is not full; each as alone."""
    cases = _cases()
    some = jax.tree.map(lambda x: x[:5], (cases.trees, cases.layouts))

    def run(params):
        return run_episodes(KEY, WALKER, params, COMPLETION, *some, greedy=True, chunk=3)

    both = jax.jit(jax.vmap(run))(jax.tree.map(lambda *x: jnp.stack(x), NEAREST, AHEAD))
    for i, alone in enumerate((run(NEAREST), run(AHEAD))):
        for name in ("success", "violated", "steps", "returns"):
            np.testing.assert_array_equal(getattr(both, name)[i], getattr(alone, name), err_msg=name)
    assert both.steps.shape == (2, 5)
    assert both.steps[1].sum() < both.steps[0].sum()


def test_the_agent_that_goes_to_the_nearest_goal_scores_what_the_reference_agent_does():
    cases = _cases()
    result = SuiteEvaluation(cases, greedy=True)(KEY, WALKER, NEAREST, COMPLETION)
    total = result.total
    assert total.episodes == 120
    assert total.success_rate.estimate == total.myopic_success_rate
    assert total.spl.estimate == pytest.approx(total.myopic_spl, abs=1e-6)
    assert total.spl.estimate < total.success_rate.estimate  # Or the comparison would show nothing here.
    assert total.return_mean.estimate == total.success_rate.estimate
    for each in result.per_task:
        assert each.score.spl.estimate == pytest.approx(each.score.myopic_spl, abs=1e-6), each.task


def test_the_agent_that_looks_ahead_is_optimal_on_two_sub_tasks():
    two = suite_from_text("two", "achieve a; achieve b\nachieve c; achieve d\nachieve e", LETTER.propositions)
    cases = make_cases(LETTER, two, layouts_per_task=40)
    assert cases.myopic.sum() > cases.optimum.sum()
    result = SuiteEvaluation(cases, greedy=True)(KEY, WALKER, AHEAD, COMPLETION)
    assert result.total.spl.estimate == 1.0
    assert result.total.steps_mean.estimate == pytest.approx(cases.optimum.mean())
    assert set(result.per_depth) == {1, 2}
    assert (result.per_depth[1].episodes, result.per_depth[2].episodes) == (40, 80)
    assert result.per_depth[1].myopic_spl == 1.0 > result.per_depth[2].myopic_spl


def test_contested_choices_of_both_agents():
    evaluation = ChoiceEvaluation(contested_suite(jax.random.key(2), LETTER, num_cases=60), greedy=True)
    myopic = evaluation(KEY, WALKER, NEAREST, COMPLETION)
    assert (myopic.contested.estimate, myopic.controls.estimate, myopic.score.estimate) == (0, 1, 0.5)
    ahead = evaluation(KEY, WALKER, AHEAD, COMPLETION)
    assert (ahead.contested.estimate, ahead.controls.estimate, ahead.score.estimate) == (1, 1, 1)
    assert ahead.failures == 0
    assert 0.9 < ahead.score.low < 1.0 == ahead.score.high
    json.dumps(ahead.to_json(), allow_nan=False)


def test_return_over_optimum_of_the_longest_and_of_the_shortest_branch():
    machine = reward_machine(LETTER.propositions, subtask=1.0)
    suite = suite_from_text("branches", "achieve a or achieve b; achieve c; achieve d", LETTER.propositions)
    evaluation = return_evaluation(LETTER, suite, machine, layouts_per_task=120, greedy=True)
    first, last = (evaluation(KEY, WALKER, manner(last=choice), machine) for choice in (False, True))
    assert (first.episodes, first.excluded) == (120, 0)
    assert first.ratio.estimate == pytest.approx(0.5)  # 1 sub-task + 1 of 3 sub-tasks + 1
    assert last.ratio.estimate == pytest.approx(last.longest_branch)
    assert last.ratio.estimate == pytest.approx(1)
    assert last.random_branch == pytest.approx(0.75)
    json.dumps(last.to_json(), allow_nan=False)


def test_an_untrained_agent_and_nothing_compiled_twice():
    network = NetworkConfig(latent=8, conv_channels=(), encoder_mlp=(8,), task_rounds=0)
    method = OURS.replace(network=PlannerConfig(features=8, hidden=8, rounds=0))
    agent = Agent(LETTER, Config(network=network), method)
    suite = _sequences(3, 15, 1)
    periodic = periodic_evaluation(LETTER, suite, episodes=20)
    before = episodes._run._cache_size()
    results = [periodic(KEY, agent, _parameters(agent, seed), COMPLETION) for seed in (0, 1)]
    assert episodes._run._cache_size() == before + 1
    for result in results:
        assert result.total.episodes == 20
        assert len(result.per_task) == 10
        assert set(result.metrics()) == {
            f"eval/{name}" for name in ("return_mean", "success_rate", "steps_mean", "spl")
        }
        assert json.loads(json.dumps(result.to_json(), allow_nan=False))["actions"] == "sampled"
    again = periodic(KEY, agent, _parameters(agent, 0), COMPLETION)
    assert again.to_json() == results[0].to_json()


def test_periodic_tasks_depend_on_the_seed_alone():
    suite = _sequences(4, 20, 2)
    one, same, other = (periodic_evaluation(LETTER, suite, seed=seed).cases for seed in (0, 0, 1))
    assert one.suite.formulas == same.suite.formulas != other.suite.formulas
    assert set(other.suite.formulas) <= set(suite.formulas)
    np.testing.assert_array_equal(one.layouts, same.layouts)
    assert len(one) == 100
    with pytest.raises(ValueError, match="multiple of the 10 tasks"):
        periodic_evaluation(LETTER, suite, episodes=15)


def test_the_final_evaluation_has_ten_layouts_or_more_and_enough_episodes():
    suite = _sequences(2, 20, 0)
    assert len(final_evaluation(LETTER, suite, episodes=100).cases) == 200
    assert len(final_evaluation(LETTER, suite, episodes=401).cases) == 420


def test_without_an_exact_solver_all_but_spl_is_there():
    env = Bare(LETTER)
    result = evaluate_suite(KEY, walker(env), NEAREST, COMPLETION, _sequences(4, 12, 2), greedy=True)
    assert result.total.spl is result.total.myopic_spl is result.total.myopic_success_rate is None
    assert result.total.success_rate.estimate > 0.9
    assert result.excluded == 0
    assert result.to_json()["spl"] is None
    assert "eval/spl" not in result.metrics()
    with pytest.raises(ValueError, match="no exact solver"):
        return_evaluation(env, _sequences(2, 2, 0), COMPLETION)
    with pytest.raises(ValueError, match="bare letter has no exact solver and no contested layouts"):
        choice_evaluation(env)
