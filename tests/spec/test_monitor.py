"""The monitor against a plain-Python reading of its rules, and its soundness against the exact semantics."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hrlspec.spec import (
    RUNNING,
    SATISFIED,
    VIOLATED,
    Achieve,
    And,
    Choice,
    Condition,
    Ensuring,
    Formula,
    Not,
    Or,
    Prop,
    SpecError,
    SpecWarning,
    TaskTree,
    Then,
    advance,
    compile_task,
    forbidden,
    initial,
    open_edges,
    parse,
    satisfies,
)
from tests.spec.tasks import NAMES, conditions, formulas, nesting, random_formula

NUM_TRACES, LENGTH, MAX_NODES = 70, 12, 24


class Pairs(NamedTuple):
    """F formulas with R traces each of T steps."""

    formulas: list[Formula]
    trees: TaskTree  # NumPy leaves, leading axis F
    labels: np.ndarray  # bool [F, R, T, P]
    assigned: np.ndarray  # int32 [F, R, T]


class Run(NamedTuple):
    """What the monitor said after each step."""

    node: np.ndarray  # int32 [F, R, T]
    status: np.ndarray  # int32 [F, R, T]
    blocked: np.ndarray  # bool [F, R, T, N]


@pytest.fixture(scope="module", params=[200, pytest.param(1500, marks=pytest.mark.slow)])
def pairs(request: pytest.FixtureRequest) -> Pairs:
    """As many formulas as the parameter says."""
    rng = np.random.default_rng(7)
    kept: list[Formula] = []
    trees: list[TaskTree] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SpecWarning)
        while len(kept) < request.param:
            formula = random_formula(rng, 5)
            if nesting(formula) < 3:
                continue
            try:
                trees.append(compile_task(formula, NAMES, MAX_NODES, on_host=True))
            except SpecError:
                continue  # too large, or forbids what it has to reach
            kept.append(formula)
    density = rng.uniform(0.05, 0.4, size=(len(kept), NUM_TRACES, 1, 1))
    labels = rng.random((len(kept), NUM_TRACES, LENGTH, len(NAMES))) < density
    assigned = rng.integers(-1, 10, size=labels.shape[:3]).astype(np.int32)
    return Pairs(kept, jax.tree.map(lambda *x: np.stack(x), *trees), labels, assigned)


@pytest.fixture(scope="module")
def run(pairs: Pairs) -> Run:
    def one(tree: TaskTree, labels: jax.Array, assigned: jax.Array) -> Run:
        def step(state, inputs):
            state = advance(tree, state, *inputs)
            return state, Run(state.node, state.status, state.blocked)

        return jax.lax.scan(step, initial(tree), (labels, assigned))[1]

    over_traces = jax.vmap(one, in_axes=(None, 0, 0))
    return jax.device_get(jax.jit(jax.vmap(over_traces))(pairs.trees, pairs.labels, pairs.assigned))


def test_pairs_are_many_and_varied(pairs: Pairs, run: Run) -> None:
    final = run.status[..., -1]
    assert final.size >= 14_000
    assert (final == SATISFIED).mean() >= 0.2
    assert (final == VIOLATED).mean() >= 0.2
    assert (final == RUNNING).mean() >= 0.02
    assert min(map(nesting, pairs.formulas)) >= 3
    assert (pairs.labels.sum(-1) > 1).mean() >= 0.2
    assert run.blocked[..., :-1, :].any(-1)[run.status[..., :-1] == RUNNING].mean() >= 0.05
    assert len(set(pairs.formulas)) >= 0.9 * len(pairs.formulas)


class Edge(NamedTuple):
    index: int
    reach: frozenset[int]
    avoid: frozenset[int]


def reading(tree: TaskTree, trace: list[frozenset[int]], assigned: list[int]) -> Iterator[tuple[int, int, set[int]]]:
    """The rules in words, one after the other: node, status and blocked edges after each step.

    ``tree`` is one task with NumPy leaves.
    """
    edges_from: dict[int, list[Edge]] = {}
    for k in range(1, int(tree.valid.sum())):
        members = [frozenset(np.flatnonzero(row[k]).tolist()) for row in (tree.reach, tree.avoid)]
        edges_from.setdefault(int(tree.parent[k]), []).append(Edge(k, *members))
    accepting = set(np.flatnonzero(tree.accepting).tolist())
    node, status, blocked = 0, "running", set()
    numbers = {"running": RUNNING, "satisfied": SATISFIED, "violated": VIOLATED}
    for now, wish in zip(trace, assigned, strict=True):
        if status == "running":
            out = edges_from[node]
            for edge in out:
                if edge.avoid & now:
                    blocked.add(edge.index)
            met = [edge for edge in out if edge.index not in blocked and edge.reach <= now]
            if met:
                wanted = [edge for edge in met if edge.index == wish]
                most = max(len(edge.reach) for edge in met)
                specific = [edge for edge in met if len(edge.reach) == most]
                node, blocked = (wanted or specific)[0].index, set()
                status = "satisfied" if node in accepting else "running"
            elif all(edge.index in blocked for edge in out):
                status = "violated"
        yield node, numbers[status], blocked


def test_monitor_equals_the_rules(pairs: Pairs, run: Run) -> None:
    bits = 1 << np.arange(len(NAMES))
    sets = [frozenset(p for p in range(len(NAMES)) if code >> p & 1) for code in range(1 << len(NAMES))]
    codes = (pairs.labels @ bits).tolist()
    powers = 1 << np.arange(MAX_NODES, dtype=np.int64)
    blocked = (run.blocked @ powers).tolist()
    node, status, assigned = run.node.tolist(), run.status.tolist(), pairs.assigned.tolist()
    for f in range(len(pairs.formulas)):
        tree = jax.tree.map(lambda x, f=f: x[f], pairs.trees)
        for r in range(NUM_TRACES):
            expected = [
                (n, s, sum(1 << k for k in b))
                for n, s, b in reading(tree, [sets[code] for code in codes[f][r]], assigned[f][r])
            ]
            assert list(zip(node[f][r], status[f][r], blocked[f][r], strict=True)) == expected, (f, r)


def test_satisfied_for_the_monitor_is_satisfied(pairs: Pairs, run: Run) -> None:
    names = [{NAMES[p] for p in range(len(NAMES)) if code >> p & 1} for code in range(1 << len(NAMES))]
    codes = (pairs.labels @ (1 << np.arange(len(NAMES)))).tolist()
    final = run.status[..., -1]
    converse = 0
    for f, formula in enumerate(pairs.formulas):
        for r in range(NUM_TRACES):
            # The implication is empty where the monitor is not satisfied; a part of those shows the converse.
            if final[f, r] == SATISFIED:
                assert satisfies(formula, [names[code] for code in codes[f][r]]), (f, r)
            elif final[f, r] == VIOLATED and f % 10 == 0:
                converse += satisfies(formula, [names[code] for code in codes[f][r]])
    assert converse > 0, "the committed reading is stricter; were it not, these pairs would show little"


def test_advance_compiles_once() -> None:
    chex.clear_trace_counter()
    step = jax.jit(chex.assert_max_traces(advance, n=1))
    labels = jnp.zeros(len(NAMES), bool)
    for text in ["achieve a", "achieve a; achieve b ensuring not c", "achieve a or achieve b"]:
        tree = compile_task(parse(text), NAMES, 16)
        state = initial(tree)
        for proposition in range(3):
            state = step(tree, state, labels.at[proposition].set(True), jnp.int32(1))


def _walk(text: str, trace: list[str], assigned: int = TaskTree.NO_NODE) -> tuple[int, int]:
    tree = compile_task(parse(text), NAMES, 16)
    state = initial(tree)
    for now in trace:
        labels = jnp.array([name in now for name in NAMES])
        state = advance(tree, state, labels, assigned)
    return int(state.node), int(state.status)


@pytest.mark.parametrize(
    ("text", "trace", "assigned", "node", "status"),
    [
        ("achieve a", ["", "b"], -1, 0, RUNNING),
        ("achieve a", ["a"], -1, 1, SATISFIED),
        ("achieve a; achieve b", ["ab"], -1, 1, RUNNING),
        ("achieve a; achieve b", ["ab", "b"], -1, 2, SATISFIED),
        ("achieve a ensuring not b", ["ab"], -1, 0, VIOLATED),
        ("achieve a ensuring not b", ["b", "a"], -1, 0, VIOLATED),
        ("achieve a ensuring not b", ["a", "b"], -1, 1, SATISFIED),
        ("achieve a ensuring not b or achieve c", ["b", "a"], -1, 0, RUNNING),
        ("achieve a ensuring not b or achieve c", ["b", "c"], -1, 2, SATISFIED),
        ("achieve a or achieve b", ["ab"], -1, 1, SATISFIED),
        ("achieve a or achieve b", ["ab"], 2, 2, SATISFIED),
        ("achieve a or achieve b", ["a"], 2, 1, SATISFIED),
        ("achieve a; achieve b ensuring not c", ["ac", "", "b"], -1, 2, SATISFIED),
        ("achieve a; achieve b ensuring not c", ["a", "c"], -1, 1, VIOLATED),
    ],
)
def test_rules_by_example(text: str, trace: list[str], assigned: int, node: int, status: int) -> None:
    assert _walk(text, trace, assigned) == (node, status)


@pytest.mark.parametrize(
    ("trace", "node", "status"),
    [
        (["a", "a"], 0, RUNNING),
        (["a", "a", "b", "a", "a"], 0, RUNNING),  # begun anew
        (["a", "a", "a"], 1, RUNNING),
        (["a", "a", "a", "a", ""], 1, VIOLATED),  # once it has held for long enough there is no second try
        (["a", "a", "a", "", "a", "a"], 1, VIOLATED),
        (["b", "a", "a", "a", "ab", "a"], 2, SATISFIED),
        (["a", "a", "c"], 0, VIOLATED),  # avoiding comes first
    ],
)
def test_holding(trace: list[str], node: int, status: int) -> None:
    """a for three steps in a row, clear of c; then for two more."""
    tree = compile_task(parse("achieve a ensuring not c; achieve a"), NAMES, 4)
    tree = dataclasses.replace(tree, hold=jnp.array([1, 3, 2, 1], jnp.int32))
    state = initial(tree)
    for now in trace:
        state = advance(tree, state, jnp.array([name in now for name in NAMES]), TaskTree.NO_NODE)
    assert (int(state.node), int(state.status)) == (node, status)


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
def test_most_specific_edge_wins_unless_another_is_assigned() -> None:
    text = "(achieve a; achieve c) or (achieve a and b; achieve d)"
    assert _walk(text, ["ab"])[0] == 2
    assert _walk(text, ["ab"], assigned=1)[0] == 1
    assert _walk(text, ["a"], assigned=2)[0] == 1


def test_open_edges_are_those_not_blocked() -> None:
    tree = compile_task(parse("achieve a ensuring not c or achieve b"), NAMES, 8)
    state = initial(tree)
    assert np.flatnonzero(open_edges(tree, state)).tolist() == [1, 2]
    state = advance(tree, state, jnp.array([False, False, True, False, False]), 1)
    assert np.flatnonzero(open_edges(tree, state)).tolist() == [2]


def _literally(formula: Formula, steps: tuple[frozenset[str], ...]) -> bool:
    """Rules 1 to 4 word for word, on one whole segment; exponential."""

    def true(condition: Condition, now: frozenset[str]) -> bool:
        match condition:
            case Prop(name=name):
                return name in now
            case Not(operand=operand):
                return not true(operand, now)
            case And(parts=parts):
                return all(true(part, now) for part in parts)
            case Or(parts=parts):
                return any(true(part, now) for part in parts)
        raise AssertionError

    match formula:
        case Achieve(goal=goal):
            return any(true(goal, now) for now in steps)
        case Ensuring(task=task, condition=condition):
            return _literally(task, steps) and all(true(condition, now) for now in steps)
        case Choice(parts=parts):
            return any(_literally(part, steps) for part in parts)
        case Then(parts=parts):
            rest = Then(parts[1:]) if len(parts) > 2 else parts[1]
            return any(_literally(parts[0], steps[:i]) and _literally(rest, steps[i:]) for i in range(len(steps)))
    raise AssertionError


def _traces(max_size: int) -> st.SearchStrategy[list[frozenset[str]]]:
    return st.lists(st.frozensets(st.sampled_from(NAMES[:3])), max_size=max_size)


@settings(max_examples=200, deadline=None)
@given(formulas(NAMES[:3]), _traces(6))
def test_exact_semantics_are_the_four_rules(formula: Formula, trace: list[frozenset[str]]) -> None:
    steps = tuple(trace)
    assert satisfies(formula, trace) == any(_literally(formula, steps[:i]) for i in range(len(steps) + 1))


@settings(max_examples=100, deadline=None)
@given(conditions(NAMES[:3]), _traces(8), st.frozensets(st.sampled_from(NAMES)))
def test_a_longer_trace_satisfies_what_its_prefix_does(
    condition: Condition, trace: list[frozenset[str]], more: frozenset[str]
) -> None:
    formula = Then((Achieve(condition), Ensuring(Achieve(Prop("a")), Not(Prop("c")))))
    assert satisfies(formula, [*trace, more]) >= satisfies(formula, trace)


def test_long_traces_are_read_in_time() -> None:
    formula = Then(tuple(Ensuring(Achieve(Prop(name)), Not(Prop("e"))) for name in "abcd" * 3))
    assert not satisfies(formula, [{"abcd"[i * i % 4]} for i in range(500)])
    assert satisfies(formula, [{"a"}, *[{"abcd"[i % 4]} for i in range(500)]])


@pytest.mark.parametrize("trace", [["ab"], [b"a"]])
def test_steps_are_sets(trace: list) -> None:
    with pytest.raises(TypeError, match="set of names"):
        satisfies(Achieve(Prop("a")), trace)


def test_state_is_a_pytree_of_fixed_types() -> None:
    tree = compile_task(parse("achieve a"), NAMES, 4)
    state = initial(tree)
    after = jax.jit(partial(advance, tree))(state, jnp.ones(len(NAMES), bool), 0)
    chex.assert_trees_all_equal_shapes_and_dtypes(state, after)


def test_what_is_forbidden_violates_the_task_and_nothing_else_does(pairs: Pairs) -> None:
    """Each proposition alone, at each node, while all edges are open."""

    def violates(tree: TaskTree, edge: jax.Array, label: jax.Array) -> jax.Array:
        start = initial(tree).replace(node=tree.parent[edge])
        return advance(tree, start, label, edge).status == VIOLATED

    over_labels = jax.vmap(violates, in_axes=(None, None, 0))
    over_trees = jax.vmap(jax.vmap(over_labels, in_axes=(None, 0, None)), in_axes=(0, None, None))
    trees = jax.tree.map(lambda x: x[:200], pairs.trees)
    found = np.asarray(over_trees(trees, jnp.arange(MAX_NODES), jnp.eye(len(NAMES), dtype=bool)))
    told, edges = np.asarray(jax.vmap(forbidden)(trees)), np.asarray(trees.edges)
    np.testing.assert_array_equal(told[edges], found[edges])
    assert not told[~edges].any()
    assert told.sum() > 100 < (trees.avoid & ~told).sum()
