"""What an agent is shown in each state of an automaton, and automata put together for acting."""

from __future__ import annotations

import itertools
import random

import jax
import numpy as np
import pytest

import envs_jax
from hrlspec.spec import RUNNING, SATISFIED, VIOLATED, TaskTree, compile_task, parse, subtask_avoid
from hrlspec.spec.automata import automata_of
from hrlspec.spec.ltl import Automaton, parse_ltl, satisfies_ltl, to_automaton, to_buchi
from hrlspec.spec.unfold import Unfolded, unfold
from tests.spec.ltl.test_automaton import random_formula
from tests.spec.ltl.test_buchi import random_round

NAMES = ("a", "b", "c", "d")
ONE = (frozenset(), *(frozenset({name}) for name in NAMES))
ALL = tuple(frozenset(some) for size in range(3) for some in itertools.combinations(NAMES[:3], size))


def automaton(text: str, labels: tuple[frozenset[str], ...] = ONE) -> Automaton:
    return to_automaton(parse_ltl(text), NAMES, labels)


def edges(text: str, state: int = 0, max_nodes: int = 16) -> list[tuple[int, str, str]]:
    """Of the tree shown in a state: parent, p₊ and p₋ without what the edges beside it reach."""
    tree = jax.tree.map(lambda x: x[state], unfold(automaton(text), NAMES, max_nodes).trees)
    nodes = np.flatnonzero(tree.valid)[1:]

    def names(row: np.ndarray) -> str:
        return "".join(np.array(NAMES)[row])

    return [(int(tree.parent[node]), names(tree.reach[node]), names(tree.avoid[node])) for node in nodes]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("F a", [(0, "a", "")]),
        ("!b U a", [(0, "a", "b")]),
        ("F (a & F b)", [(0, "a", ""), (1, "b", "")]),
        ("F a & F b", [(0, "a", ""), (0, "b", ""), (1, "b", ""), (2, "a", "")]),
        ("F (a | b)", [(0, "a", ""), (0, "b", "")]),
        ("F (a & F b) | F c", [(0, "c", ""), (0, "a", ""), (2, "b", ""), (2, "c", "")]),
        # When c comes before d, b is owed again, and a is forbidden again.
        ("!a U (b & (!c U d))", [(0, "b", "a"), (1, "d", "c")]),
        ("false", []),
    ],
)
def test_what_is_shown_at_first(text: str, expected: list[tuple[int, str, str]]) -> None:
    found = edges(text)
    assert sorted(found) == sorted(expected) or found == expected


def test_moves_that_only_lose_are_not_shown() -> None:
    """After b, a takes the second try away: the way on is d, with or without it."""
    some = automaton("!a U (b & (!c U d))")
    after_b = int(some.successors[0, some.labels.index(frozenset("b"))])
    assert edges("!a U (b & (!c U d))", after_b) == [(0, "d", "c")]


def test_where_labels_overlap_what_does_not_count_is_avoided() -> None:
    some = unfold(to_automaton(parse_ltl("F (a & !b)"), NAMES, ALL), NAMES, 4)
    tree = jax.tree.map(lambda x: x[0], some.trees)
    assert tree.reach[1].tolist() == [True, False, False, False]
    assert tree.avoid[1].tolist() == [False, True, False, False]
    both = unfold(to_automaton(parse_ltl("F (a & b)"), NAMES, ALL), NAMES, 4).trees
    assert both.reach[0, 1].tolist() == [True, True, False, False]


@pytest.mark.parametrize(("text", "reach", "avoid"), [("!blue U red", "red", "blue"), ("!blue U aqua", "aqua", "blue")])
def test_of_overlapping_labels_only_what_does_harm_is_avoided(text: str, reach: str, avoid: str) -> None:
    world = envs_jax.make("flatworld")
    some = to_automaton(parse_ltl(text), world.propositions, world.possible_labels)
    tree = jax.tree.map(lambda x: x[0], unfold(some, world.propositions, 4).trees)
    assert [world.propositions[i] for i in np.flatnonzero(tree.reach[1])] == [reach]
    assert [world.propositions[i] for i in np.flatnonzero(tree.avoid[1])] == [avoid]


def test_where_rounds_go_by_nothing_need_be_done() -> None:
    """F a for ever: once a was met every step is a round, whatever holds."""
    for text in ("F a", "G !c"):
        assert not unfold(to_buchi(parse_ltl(text), NAMES, ONE), NAMES, 4).silent.any()


def test_what_begins_where_nothing_holds_is_said_to_be_left_out() -> None:
    assert unfold(automaton("F (!a & !b & !c & !d)"), NAMES, 4).silent.tolist()[0]
    assert not unfold(automaton("F a"), NAMES, 4).silent.any()


@pytest.mark.parametrize("text", ["achieve a; achieve b", "achieve a; (achieve b ensuring not c); achieve d"])
def test_the_twin_of_a_sequence_shows_its_tree(text: str) -> None:
    """In every state the tree of what is left; p₋ may name more than the formula: what takes b away is avoided too."""
    ltl = {"achieve a; achieve b": "F (a & F b)"}.get(text, "F (a & X (!c U (b & F d)))")
    shown = jax.tree.map(lambda x: x[0], unfold(automaton(ltl), NAMES, 8).trees)
    tree = jax.tree.map(np.asarray, compile_task(parse(text), NAMES, 8))
    for name in ("parent", "reach", "accepting", "valid", "depth"):
        np.testing.assert_array_equal(getattr(shown, name), getattr(tree, name))
    assert (np.asarray(subtask_avoid(shown)) >= np.asarray(subtask_avoid(tree))).all()


def _check(some: Automaton, tree: TaskTree, start: int) -> None:
    """Walks the tree: whoever does as its edges say, one label at a time, is led where it says, to acceptance."""
    where = {0: start}
    reach = np.asarray(tree.reach)
    for node in np.flatnonzero(tree.valid)[1:].tolist():
        label = frozenset(name for name, holds in zip(NAMES, reach[node], strict=True) if holds)
        where[node] = int(some.successors[where[int(tree.parent[node])], some.labels.index(label)])
    assert len({*where.values()}) > 1 or len(where) == 1
    for node in np.flatnonzero(tree.accepting).tolist():
        assert where[node] == some.accepting


@pytest.mark.parametrize("seed", range(30))
def test_leaves_accept_and_nothing_is_visited_twice(seed: int) -> None:
    formula = random_formula(random.Random(seed), 12)
    some = to_automaton(formula, NAMES, [label for label in ONE if label <= set(NAMES)])
    shown = unfold(some, NAMES, 24)
    for state in range(some.num_states):
        tree = jax.tree.map(lambda x, state=state: x[state], shown.trees)
        _check(some, tree, state)
        inner = np.isin(np.arange(24), tree.parent[tree.valid])
        leaves = tree.valid & ~inner & (np.arange(24) > 0)
        np.testing.assert_array_equal(leaves, tree.accepting)
        # Something is shown wherever a label that is not empty begins a way to acceptance.
        if state not in (some.accepting, some.rejecting) and not shown.cut[state]:
            assert tree.valid.sum() > 1 or shown.silent.any() or not _can_accept(some, state)


def _can_accept(some: Automaton, state: int) -> bool:
    """By labels that are not empty alone."""
    seen, queue = {state}, [state]
    columns = [column for column, label in enumerate(some.labels) if label]
    for here in queue:
        for after in some.successors[here, columns].tolist():
            if after not in seen:
                seen.add(after)
                queue.append(after)
    return some.accepting in seen


def test_a_tree_too_small_is_cut_and_says_so() -> None:
    text = "F a & F b & F c & F d"
    whole, cut = (unfold(automaton(text), NAMES, size) for size in (65, 12))
    assert (whole.cut[0], cut.cut[0]) == (False, True)
    assert whole.trees.valid[0].sum() == 1 + 4 + 12 + 24 + 24
    assert cut.trees.valid[0].sum() <= 12
    assert cut.trees.accepting[0].any()


def test_advancing_is_running_the_automata() -> None:
    """In one table, on random traces; a label that cannot occur changes nothing."""
    rng = np.random.default_rng(0)
    texts = ("F (a & F b)", "!a U (b & (!c U d))", "F a & F b & F c", "G !a & F d", "false", "F (c & X d)")
    each = [automaton(text) for text in texts]
    together, cut, silent = automata_of(each, NAMES, 16)
    assert not cut.any()
    assert silent.tolist() == [False] * 6
    advance = jax.jit(jax.vmap(together.advance))
    rows, traces = np.asarray(together.start), [[] for _ in each]
    assert np.asarray(together.status)[rows].tolist() == [RUNNING] * 4 + [VIOLATED, RUNNING]
    for _ in range(12):
        columns = rng.integers(len(ONE), size=len(each))
        labels = np.array([[name in ONE[column] for name in NAMES] for column in columns])
        rows, accepted = map(np.asarray, advance(rows, labels))
        assert not accepted.any()
        for i, some in enumerate(each):
            traces[i].append(ONE[columns[i]])
            assert int(np.asarray(together.status)[rows[i]]) == some.run(traces[i])
            accepted = satisfies_ltl(parse_ltl(texts[i]), traces[i])
            assert accepted == (int(np.asarray(together.status)[rows[i]]) == SATISFIED)
    both = np.ones((len(each), 4), bool)
    np.testing.assert_array_equal(advance(rows, both)[0], rows)


def forever(text: str) -> tuple[Automaton, Unfolded]:
    some = to_buchi(parse_ltl(text), NAMES, ONE)
    return some, unfold(some, NAMES, 8)


def test_a_sub_task_may_begin_with_a_jump() -> None:
    """F G a: a, with the jump; in the copy nothing but a. Once c is met: before it, no jump is worth anything."""
    some, shown = forever("FG a & F c")
    (jumping,) = [state for state in range(some.num_states) if some.jumps[state]]
    (copy,) = some.jumps[jumping]
    for state, avoided, origin in ((jumping, "", copy), (copy, "bcd", copy)):
        tree = jax.tree.map(lambda x, state=state: x[state], shown.trees)
        assert tree.valid.sum() == 2
        assert [name for name, reached in zip(NAMES, tree.reach[1], strict=True) if reached] == ["a"]
        assert "".join(name for name, avoided in zip(NAMES, tree.avoid[1], strict=True) if avoided) == avoided
        assert shown.origin[state].tolist() == [state, origin, *[state] * 6]
    first = jax.tree.map(lambda x: x[0], shown.trees)
    assert first.reach[[1, 2]].tolist() == [[False, False, True, False], [True, False, False, False]]
    assert (shown.origin[0] == 0).all()


def test_a_jump_is_taken_where_its_sub_task_is_pursued_and_met() -> None:
    """Pursued in vain or met by chance, the task waits; after the jump it must hold."""
    _, shown = forever("FG a | FG b")
    together, *_ = automata_of([to_buchi(parse_ltl("FG a | FG b"), NAMES, ONE)], NAMES, 8)
    reach = shown.trees.reach[0]
    edge = {name: next(n for n in (1, 2) if reach[n, NAMES.index(name)]) for name in "ab"}

    def step(row: int, name: str, edge: int) -> tuple[int, bool]:
        after, accepted = together.advance(row, np.array([name == other for other in NAMES]), edge)
        return int(after), bool(accepted)

    assert step(0, "c", edge["a"]) == step(0, "b", edge["a"]) == step(0, "a", TaskTree.NO_NODE) == (0, False)
    row, accepted = step(0, "a", edge["a"])
    assert accepted
    assert step(row, "a", TaskTree.NO_NODE) == (row, True)
    after, accepted = step(row, "c", TaskTree.NO_NODE)
    assert not accepted
    assert int(together.status[after]) == RUNNING  # there is still b to stay in
    after, accepted = step(after, "b", 1)
    assert accepted
    assert int(together.status[step(after, "a", 1)[0]]) == VIOLATED


@pytest.mark.parametrize("seed", range(20))
def test_what_an_agent_makes_of_jumps_is_a_run_of_the_automaton(seed: int) -> None:
    """Whatever it pursues and whatever comes: each step reads the label where the task stands or after a jump."""
    rng = random.Random(seed)
    formula = random_round(rng, 2)
    some = to_buchi(formula, NAMES, ONE)
    together, *_ = automata_of([some], NAMES, 16)
    advance = jax.jit(together.advance)
    row, column_of = 0, {label: column for column, label in enumerate(some.labels)}
    for _ in range(40):
        edges = np.flatnonzero(together.trees.parent[row] == 0).tolist()
        edge, label = rng.choice([*edges, TaskTree.NO_NODE]), rng.choice(ONE)
        after, accepted = advance(row, np.array([name in label for name in NAMES]), edge)
        ways = [(origin, column_of[label]) for origin in (some.origins(row) if edge in edges else (row,))]
        assert (int(after), bool(accepted)) in [(some.successors[way], some.marks[way]) for way in ways]  # type: ignore[index]
        assert int(after) != some.rejecting or int(some.successors[row, column_of[label]]) == some.rejecting
        row = int(after)


def test_what_cannot_be_put_together() -> None:
    with pytest.raises(ValueError, match="different labels"):
        automata_of([automaton("F a"), to_automaton(parse_ltl("F a"), NAMES)], NAMES, 4)
    with pytest.raises(ValueError, match="found 17 propositions, automata take 16 at most"):
        automata_of([automaton("F a")], [f"p{i}" for i in range(17)], 4)
