"""Acting on automata: as on the tree where one says the same, and with second tries where no tree can."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

import envs_jax
from envs_jax.base import EnvParams, StepResult
from envs_jax.letter.world import Letter, LetterState
from hrlspec.evaluation import evaluate_ltl, exact_suite, ltl, ltl_suite, run_episodes
from hrlspec.evaluation.episodes import Episodes, _run, trace_episodes
from hrlspec.presets.peers import go_on_for_ever, peer_formulas, peer_suites
from hrlspec.spec import SpecError, compile_task, parse
from hrlspec.spec.automata import Automata, automata_of
from hrlspec.spec.ltl import parse_ltl, satisfies_ltl, to_automaton
from hrlspec.spec.readings import monitor_automaton
from hrlspec.tasks.rewards import reward_machine
from tests.evaluation.scripted import manner, walker

LETTER = envs_jax.make("letter")
NAMES = LETTER.propositions
COMPLETION = reward_machine(NAMES)
WALKER = walker(LETTER)
KEY = jax.random.key(0)
MAX_NODES, COUNT = 16, 24
"""Sizes of trees and numbers of layouts that tests share, and with them the compiled programs."""


def tasks(*texts: str) -> Automata:
    labels = [frozenset(), *(frozenset({name}) for name in NAMES)]
    return automata_of([to_automaton(parse_ltl(text), NAMES, labels) for text in texts], NAMES, MAX_NODES)[0]


def layouts(seed: int = 0) -> np.ndarray:
    keys = jax.random.split(jax.random.key(seed), COUNT)
    return np.asarray(jax.vmap(LETTER.sample_layout, (0, None))(keys, LETTER.default_params))


@pytest.mark.parametrize("last", [False, True])
def test_step_for_step_as_on_the_tree(last: bool) -> None:
    """Where no second try is to be had."""
    twins = {
        "achieve a; achieve b": "F (a & F b)",
        "achieve a or achieve c": "F (a | c)",
        "achieve b ensuring not a": "!a U b",
    }
    some, which, how = layouts(), np.arange(COUNT) % len(twins), {"greedy": True}
    each = [compile_task(parse(text), NAMES, MAX_NODES, on_host=True) for text in twins]
    trees = jax.tree.map(lambda *x: np.stack([x[i] for i in which]), *each)
    on_trees, trace = trace_episodes(KEY, WALKER, manner(last=last), COMPLETION, trees, some, **how)
    together = tasks(*twins.values())
    on_automata, other = trace_episodes(KEY, WALKER, manner(last=last), COMPLETION, together, some, which=which, **how)
    jax.tree.map(np.testing.assert_array_equal, on_trees, on_automata)
    np.testing.assert_array_equal(trace.running, other.running)
    places = (np.asarray(one.env_state.position)[np.asarray(one.running)] for one in (trace, other))
    np.testing.assert_array_equal(*places)
    assert np.asarray(on_trees.success).all()


@pytest.mark.parametrize("last", [False, True])
def test_a_tree_as_an_automaton_is_carried_out_step_for_step_as_the_tree(last: bool) -> None:
    """Whichever edge the planner takes, with edges that become blocked; of edges met at once it is told nothing."""
    texts = (
        "(achieve a; achieve b) ensuring not c or achieve d; achieve e",
        "achieve a ensuring not b or achieve b ensuring not a; achieve c; achieve d ensuring not e",
        "(achieve a or achieve b or achieve c) ensuring not d; (achieve a or achieve e) ensuring not c",
        "achieve e or (achieve a; achieve b or achieve c; achieve d)",
    )
    trees = [compile_task(parse(text), NAMES, MAX_NODES, on_host=True) for text in texts]
    each = [monitor_automaton(tree, NAMES, LETTER.possible_labels) for tree in trees]
    shown = [trees for _, trees in each]
    together, *_ = automata_of([automaton for automaton, _ in each], NAMES, MAX_NODES, trees=shown)
    some, which = layouts(seed=11), np.arange(COUNT) % len(texts)
    stacked = jax.tree.map(lambda *x: np.stack([x[i] for i in which]), *trees)
    how = {"greedy": True}
    on_trees, trace = trace_episodes(KEY, WALKER, manner(last=last), COMPLETION, stacked, some, **how)
    on_automata, other = trace_episodes(KEY, WALKER, manner(last=last), COMPLETION, together, some, which=which, **how)
    jax.tree.map(np.testing.assert_array_equal, on_trees, on_automata)
    np.testing.assert_array_equal(trace.running, other.running)
    places = (np.asarray(one.env_state.position)[np.asarray(one.running)] for one in (trace, other))
    np.testing.assert_array_equal(*places)
    assert np.asarray(on_trees.success).mean() > 0.5


def test_a_task_that_no_tree_can_say_is_carried_out_in_its_exact_reading() -> None:
    """c after b: for the monitor it is over; here b is sought again."""
    text = "achieve a; ((achieve b; achieve d) ensuring not c)"
    suite = exact_suite("some", f"{text}\nachieve a ensuring not a", LETTER)
    assert suite.num_states.tolist() == [4, 1]
    found = evaluate_ltl(KEY, WALKER, manner(), COMPLETION, suite, episodes=40, greedy=True, chunk=COUNT)
    assert [score.success_rate.estimate for score in found.per_formula] == [1, 0]
    assert found.per_formula[0].formula == text
    with pytest.raises(SpecError, match="some, line 2, column 9: found ';'"):
        exact_suite("some", "achieve a\nachieve ;", LETTER)


def test_a_second_try() -> None:
    """No tree says this: c before d withdraws b, and an agent that steps on c must go for b again."""
    text = "!a U (b & (!c U d))"
    some = layouts(seed=3)
    which = np.zeros(COUNT, int)
    episodes, trace = trace_episodes(KEY, WALKER, manner(), COMPLETION, tasks(text), some, which=which, greedy=True)
    assert np.asarray(episodes.success).mean() > 0.9
    states = trace.env_state
    labels = np.asarray(jax.vmap(jax.vmap(lambda state: LETTER.labels(state, LETTER.default_params)))(states))
    for episode in range(COUNT):
        steps = int(episodes.steps[episode])
        # Entry t is the state before step t: entry 1 has the labels after the first action; the last are not there.
        seen = [{name for name, holds in zip(NAMES, labels[t, episode], strict=True) if holds} for t in range(1, steps)]
        assert not satisfies_ltl(parse_ltl(text), seen)
        if episodes.success[episode]:
            assert satisfies_ltl(parse_ltl(text), [*seen, {"d"}]) or satisfies_ltl(parse_ltl(text), [*seen, {"b"}])


def test_tasks_of_any_size_in_one_program() -> None:
    """Which task an episode has, whose states are rows of one table, does not change how it goes."""
    texts = ("F (a & F b)", "F a & F b & F c", "!a U (b & (!c U d))")
    together, some = tasks(*texts), layouts(seed=5)
    how = {"greedy": True}
    mixed = run_episodes(KEY, WALKER, manner(), COMPLETION, together, some, which=np.arange(COUNT) % 3, **how)
    for number, text in enumerate(texts):
        alone = run_episodes(KEY, WALKER, manner(), COMPLETION, tasks(text), some, which=np.zeros(COUNT, int), **how)
        for one, other in zip(jax.tree.leaves(mixed), jax.tree.leaves(alone), strict=True):
            np.testing.assert_array_equal(one[number::3], other[number::3])
    with pytest.raises(ValueError, match="which names task 3, there are 3"):
        run_episodes(KEY, WALKER, manner(), COMPLETION, together, some, which=np.full(COUNT, 3), **how)
    with pytest.raises(ValueError, match="found 3 tasks for 24 layouts, expected one for each"):
        run_episodes(KEY, WALKER, manner(), COMPLETION, together, some, **how)


def test_rounds_of_a_task_that_goes_on() -> None:
    """a, then b, then a again: counted from what the agent stepped on. It ends with the horizon, satisfied or not."""
    suite = ltl_suite("some", "GF a & GF b", LETTER, forever=True)
    some = layouts(seed=7)
    which = np.zeros(COUNT, int)
    episodes, trace = trace_episodes(KEY, WALKER, manner(), COMPLETION, suite.automata, some, which=which, greedy=True)
    labels = np.asarray(jax.vmap(jax.vmap(lambda state: LETTER.labels(state, LETTER.default_params)))(trace.env_state))
    assert np.asarray(episodes.steps).tolist() == [LETTER.horizon] * COUNT
    assert not np.asarray(episodes.success).any()
    for episode in range(COUNT):
        wanted, rounds = 0, 0
        for step in range(1, LETTER.horizon):  # what the last step led to is not in the trace
            if labels[step, episode, wanted]:
                wanted, rounds = 1 - wanted, rounds + wanted
        assert int(episodes.rounds[episode]) - rounds in (0, 1)
        assert rounds > 3
    found = evaluate_ltl(KEY, WALKER, manner(), COMPLETION, suite, episodes=COUNT, greedy=True)
    assert found.to_json()["rounds_mean"] == found.rounds_mean > 3
    assert found.per_formula[0].no_round_rate.estimate == 0


def test_what_persists_begins_with_a_jump() -> None:
    """On the first a it jumps, after which every step clear of c is a round; b, in its way, costs nothing."""
    suite = ltl_suite("some", "F (a & G !c)", LETTER, forever=True)
    some, which, how = layouts(seed=9), np.zeros(COUNT, int), {"greedy": True}
    episodes, trace = trace_episodes(KEY, WALKER, manner(), COMPLETION, suite.automata, some, which=which, **how)
    labels = np.asarray(jax.vmap(jax.vmap(lambda state: LETTER.labels(state, LETTER.default_params)))(trace.env_state))
    first = labels[:, :, NAMES.index("a")].argmax(0)  # entry t is what step t begins with
    steps, rounds = np.asarray(episodes.steps), np.asarray(episodes.rounds)
    np.testing.assert_array_equal(rounds + np.asarray(episodes.violated), steps - first + 1)
    assert (steps[~np.asarray(episodes.violated)] == LETTER.horizon).all()
    assert np.asarray(episodes.violated).mean() < 0.2


def test_a_suite_of_formulas() -> None:
    """One that nothing satisfies, one that is satisfied at once, and one with a bad end that is avoided."""
    text = "# formulas\nfalse\nF (a | b | c | d | e | !a)\n\n!a U b  # clear of a\n"
    suite = ltl_suite("some", text, LETTER)
    assert suite.formulas == ("false", "F (a | b | c | d | e | !a)", "!a U b")
    assert suite.num_states.tolist() == [1, 2, 3]
    found = evaluate_ltl(KEY, WALKER, manner(), COMPLETION, suite, episodes=40, greedy=True)
    rates = [score.success_rate.estimate for score in found.per_formula]
    assert rates == [0, 1, 1]
    assert found.per_formula[1].steps_mean.estimate == 1
    assert found.success_rate == pytest.approx(2 / 3)
    json.dumps(found.to_json(), allow_nan=False)
    again = evaluate_ltl(KEY, WALKER, manner(), COMPLETION, suite, episodes=40, greedy=True, chunk=COUNT)
    assert [score.success_rate for score in again.per_formula] == [score.success_rate for score in found.per_formula]


def test_episodes_and_seeds_have_layouts_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """None that another episode or seed has, and none drawn with a key that training with that seed begins with."""
    seen: list[np.ndarray] = []

    def noted(key: jax.Array, *args: object, **how: object) -> Episodes:
        seen.append(np.asarray(args[4]))
        none = np.zeros(len(seen[-1]), np.int32)
        return Episodes(none > 0, none > 0, none, none, none, none > 0)

    monkeypatch.setattr(ltl, "run_episodes", noted)
    suite = ltl_suite("some", "F a\nF b", LETTER)
    for seed in range(3):
        evaluate_ltl(KEY, WALKER, manner(), COMPLETION, suite, episodes=COUNT, seed=seed)
        first = jax.random.split(jax.random.key(seed), 2 * COUNT)
        seen.append(np.asarray(jax.vmap(LETTER.sample_layout, (0, None))(first, LETTER.default_params)))
    assert len({layout.tobytes() for layouts in seen for layout in layouts}) == 6 * 2 * COUNT


class Ending(Letter):
    """It ends every episode with the third step."""

    def step_env(self, key: jax.Array, state: LetterState, action: jax.Array, params: EnvParams) -> StepResult:
        observation, after, reward, _, truncated, info = super().step_env(key, state, action, params)
        return observation, after, reward, after.time >= 3, truncated, info


@pytest.mark.parametrize("ends", [False, True])
def test_how_episodes_fail(ends: bool) -> None:
    """Violated, or over: by the environment or with the horizon. What the last step satisfies is a success."""
    env = Ending() if ends else Letter(horizon=3)
    suite = ltl_suite("some", "false\nX X true\nX X X true", env)
    found = evaluate_ltl(KEY, walker(env), manner(), COMPLETION, suite, episodes=8, greedy=True)

    def each(name: str) -> list[float]:
        return [getattr(score, name).estimate for score in found.per_formula]

    assert each("success_rate") == [0, 1, 0]
    assert each("ended_rate") == [0, 0, ends]
    assert each("violation_rate") == [1, 0, ends]
    assert found.steps_mean == 3


def test_another_formula_needs_no_compilation() -> None:
    """Whatever the number of its automaton's states."""
    suites = [ltl_suite("some", text, LETTER) for text in ("F a", "F (a & F (b & F (c & F (d & F e))))", "!a U b")]
    assert len({int(suite.num_states[0]) for suite in suites}) == 3
    sizes = []
    for suite in suites:
        evaluate_ltl(KEY, WALKER, manner(), COMPLETION, suite, episodes=COUNT, greedy=True)
        sizes.append(_run._cache_size())
    assert sizes[0] == sizes[1] == sizes[2]


@pytest.mark.parametrize("name", peer_suites())
def test_published_formulas_can_be_carried_out(name: str) -> None:
    """In their world, whose labels are the peers'; nothing asks for a step on which nothing holds."""
    worlds = {
        "flatworld": "flatworld",
        "letter": "letter12",
        "deepltl/zone": "zone",
        "jaxolotl/zone": "zone-jaxolotl",
        "jaxolotl_blue/zone": "zone-nm",
    }
    env = envs_jax.make(next(world for part, world in worlds.items() if part in name))
    suite = ltl_suite(name, peer_formulas(name), env, forever=go_on_for_ever(name))
    assert len(suite) >= 2
    assert not suite.silent.any()
    starts = np.asarray(suite.automata.start)
    assert (np.asarray(suite.automata.trees.valid)[starts].sum(-1) > 1).all()
