from __future__ import annotations

import time
import warnings

import jax
import numpy as np
import pytest

from hrlspec.spec import (
    Achieve,
    And,
    Choice,
    Condition,
    Ensuring,
    Formula,
    Or,
    Prop,
    SpecError,
    SpecWarning,
    TaskTree,
    Then,
    compile_task,
    parse,
    subtasks,
    task_hash,
    tree_to_formula,
    tree_to_text,
)
from hrlspec.spec.compiler import MAX_NODES
from hrlspec.spec.graph import MAX_STEPS
from hrlspec.spec.syntax import MAX_TEXT
from tests.spec.tasks import NAMES, random_formula

Edge = tuple[frozenset[str], frozenset[str]]


def compiled(text: str, max_nodes: int = 16) -> TaskTree:
    return compile_task(parse(text), NAMES, max_nodes)


def paths_of_tree(tree: TaskTree) -> set[tuple[Edge, ...]]:
    """Every way from the root to an accepting node, as what its edges reach and avoid."""
    tree = jax.tree.map(np.asarray, tree)
    found = set()
    for leaf in np.flatnonzero(tree.accepting):
        path: list[Edge] = []
        node = leaf
        while node != TaskTree.ROOT:
            sets = [frozenset(NAMES[p] for p in np.flatnonzero(row[node])) for row in (tree.reach, tree.avoid)]
            path.insert(0, (sets[0], sets[1]))
            node = tree.parent[node]
        found.add(tuple(path))
    return found


def paths_of_formula(formula: Formula) -> set[tuple[Edge, ...]]:
    """The same, spelled out from the formula without any sharing; possibly with undoable and superfluous ones."""

    def alternatives(condition: Condition) -> set[frozenset[str]]:
        match condition:
            case Prop(name=name):
                return {frozenset([name])}
            case Or(parts=parts):
                sets = set().union(*map(alternatives, parts))
            case And(parts=parts):
                sets = {frozenset()}
                for part in parts:
                    sets = {x | y for x in sets for y in alternatives(part)}
        return {x for x in sets if not any(y < x for y in sets)}

    def names(condition: Condition) -> frozenset[str]:
        # Only negations and De Morgan forms are drawn, so that every name inside is forbidden.
        return (
            frozenset([condition.name])
            if isinstance(condition, Prop)
            else frozenset().union(*map(names, getattr(condition, "parts", None) or (condition.operand,)))
        )

    match formula:
        case Achieve(goal=goal):
            return {((reach, frozenset()),) for reach in alternatives(goal)}
        case Ensuring(task=task, condition=condition):
            harm = names(condition)
            return {tuple((reach, avoid | harm) for reach, avoid in path) for path in paths_of_formula(task)}
        case Choice(parts=parts):
            return set().union(*map(paths_of_formula, parts))
        case Then(parts=parts):
            paths: set[tuple[Edge, ...]] = {()}
            for part in parts:
                paths = {x + y for x in paths for y in paths_of_formula(part)}
            return paths
    raise AssertionError


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
def test_tree_is_the_set_of_ways_to_satisfy_the_formula() -> None:
    rng = np.random.default_rng(0)
    checked = 0
    while checked < 200:
        formula = random_formula(rng, 4)
        try:
            tree = compile_task(formula, NAMES, 64)
        except SpecError:
            continue
        paths = {path for path in paths_of_formula(formula) if not any(reach & avoid for reach, avoid in path)}
        shortest = {path for path in paths if not any(path[:i] in paths for i in range(len(path)))}
        assert paths_of_tree(tree) == shortest
        check_shape(tree)
        checked += 1


def check_shape(tree: TaskTree) -> None:
    """The invariants that TaskTree promises."""
    tree = jax.tree.map(np.asarray, tree)
    size = tree.valid.sum()
    assert tree.valid[:size].all()
    assert not tree.valid[size:].any()
    assert tree.parent[0] == TaskTree.NO_NODE
    edges = np.arange(1, size)
    assert (tree.parent[edges] < edges).all()
    assert (tree.parent[edges] >= 0).all()
    assert (tree.depth[edges] == tree.depth[tree.parent[edges]] + 1).all()
    assert tree.depth[0] == 0
    assert not tree.accepting[0]
    inner = np.isin(np.arange(size), tree.parent)
    assert (tree.accepting[:size] == ~inner).all()
    assert tree.reach[1:size].any(-1).all()
    assert not (tree.reach & tree.avoid).any()
    for row in (tree.reach, tree.avoid, tree.accepting):
        assert not row[size:].any()
    assert (tree.parent[size:] == TaskTree.NO_NODE).all()
    assert (tree.depth[size:] == 0).all()
    assert {x.dtype for x in (tree.parent, tree.depth)} == {np.dtype(np.int32)}


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
def test_tree_to_text_and_back() -> None:
    rng = np.random.default_rng(1)
    checked = 0
    while checked < 100:
        try:
            tree = compile_task(random_formula(rng, 4), NAMES, 64)
        except SpecError:
            continue
        again = compile_task(parse(tree_to_text(tree, NAMES)), NAMES, 64)
        assert int(task_hash(again)) == int(task_hash(tree))
        assert jax.tree.all(jax.tree.map(np.array_equal, tree, again))
        checked += 1


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("achieve a or b", "achieve a or achieve b"),
        ("achieve (a or b) and c", "achieve a and c or achieve b and c"),
        ("achieve not (not a or not b)", "achieve a and b"),
        ("achieve a or (a and b)", "achieve a"),
        ("achieve a ensuring not (b or c)", "achieve a ensuring not b and not c"),
        ("achieve a ensuring not b ensuring not c", "achieve a ensuring not b and not c"),
        ("(achieve a; achieve b) ensuring not c", "achieve a ensuring not c; achieve b ensuring not c"),
        ("achieve a; achieve b or achieve a; achieve c", "achieve a; (achieve b or achieve c)"),
        ("(achieve a or achieve b); achieve c", "achieve a; achieve c or achieve b; achieve c"),
        ("achieve a or achieve a; achieve b", "achieve a"),
        ("(achieve a or achieve a; achieve b); achieve c", "achieve a; (achieve c or achieve b; achieve c)"),
        ("achieve a; (achieve b; achieve c)", "(achieve a; achieve b); achieve c"),
    ],
)
def test_equal_tasks(text: str, same: str) -> None:
    assert int(task_hash(compiled(text))) == int(task_hash(compiled(same)))


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("achieve not a", (1, 13), ["negation of 'a'", "ensuring not a"]),
        ("achieve not (a and b)", (1, 14), ["negation of 'a'"]),
        ("achieve a ensuring b", (1, 20), ["found 'b'", "not b"]),
        ("achieve a\nensuring not b or not c", (2, 10), ["disjunction", "not a and not b"]),
        ("achieve a ensuring not (b and c)", (1, 25), ["disjunction"]),
        ("achieve a; achieve z", (1, 20), ["unknown proposition 'z'", "a, b, c, d, e"]),
        ("achieve A", (1, 9), ["unknown proposition 'A'"]),
        ("achieve a ensuring not a", (1, 11), ["can never be done"]),
        ("(achieve a; achieve b) ensuring not b or achieve c", (1, 24), ["can never be done"]),
        ("achieve a; achieve b; achieve a; achieve b", (1, 1), ["5 nodes", "max_nodes is 4"]),
        ("; ".join(["(achieve a or achieve b)"] * 100), (1, 2), ["more than 1,000,000,000 nodes"]),
        ("; ".join(["achieve a"] * (MAX_STEPS + 1)), (1, 1), [f"more than {MAX_STEPS} sub-tasks"]),
    ],
)
def test_refusals_say_where_and_why(text: str, place: tuple[int, int], words: list[str]) -> None:
    with pytest.raises(SpecError) as caught:
        compiled(text, max_nodes=4)
    assert (caught.value.line, caught.value.column) == place, str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_unknown_names_suggest_a_close_one() -> None:
    with pytest.raises(SpecError, match=r"expected one of kitchen, office \(did you mean 'kitchen'\?\)"):
        compile_task(parse("achieve kitchn"), ["kitchen", "office"], 4)


@pytest.mark.parametrize("propositions", [["a", "a"], ["a", "not"], ["é", "e\u0301"], [""]])
def test_bad_vocabularies(propositions: list[str]) -> None:
    with pytest.raises(SpecError):
        compile_task(parse("achieve a"), propositions, 4)


@pytest.mark.parametrize("max_nodes", [-1, 0, 1, MAX_NODES + 1])
def test_bad_sizes(max_nodes: int) -> None:
    with pytest.raises(ValueError, match="max_nodes"):
        compiled("achieve a", max_nodes)


def test_warnings() -> None:
    with pytest.warns(SpecWarning, match=r"shadows another: \{a\} beside \{a, b\}"):
        compiled("achieve a and b or achieve a")
    with pytest.warns(SpecWarning, match="line 1, column 18: alternatives left out"):
        tree = compiled("achieve (a or b) ensuring not a")
    assert tree_to_text(tree, NAMES) == "achieve b ensuring not a"
    with pytest.warns(SpecWarning, match="left out"):
        tree = compiled("(achieve a; achieve b or achieve c) ensuring not b")
    assert tree_to_text(tree, NAMES) == "achieve c ensuring not b"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compiled("(achieve a ensuring not b; achieve c) or (achieve a ensuring not d; achieve e)")


_OR_CHAIN = " or ".join(f"achieve {x} and {y}" for x in NAMES for y in NAMES)


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
@pytest.mark.parametrize(
    "text",
    [
        "; ".join(["(achieve a or (achieve a; achieve b) or (achieve a; achieve a))"] * 60),
        "; ".join([f"({_OR_CHAIN})"] * 35),
        "; ".join(
            "("
            + " or ".join(f"(achieve p{i} or achieve p{(7 * i + k) % 64}; achieve p{(i + k) % 64})" for i in range(9))
            + ")"
            for k in range(40)
        ),
        " or ".join(
            "achieve " + " and ".join(f"(p{(k + 2 * i) % 64} or p{(k + 2 * i + 1) % 64})" for i in range(8))
            for k in range(130)
        ),
        "achieve " + " and ".join(f"(p{2 * i % 64} or p{(2 * i + 1) % 64})" for i in range(1000)),
        "achieve " + " and ".join(f"({' or '.join(f'p{(i + 8 * k) % 64}' for i in range(8))})" for k in range(200)),
        " or ".join(f"achieve p{i % 64}; achieve p{i * 7 % 64}" for i in range(650)),
        "(" * 60 + "achieve a" + " ensuring not b); achieve c" * 60,
        "achieve " + "a" * (MAX_TEXT - 8),
    ],
    ids=range(9),
)
def test_hostile_formulas_end_soon(text: str) -> None:
    start = time.process_time()
    formula = parse(text[:MAX_TEXT])
    try:
        compile_task(formula, [*NAMES, *(f"p{i}" for i in range(64))], MAX_NODES)
    except SpecError as error:
        message = str(error)
    else:
        message = ""
    assert len(message) < 2000
    assert time.process_time() - start < 10


def test_subtasks_follow_equation_two() -> None:
    tree = compiled("(achieve a ensuring not d; achieve c) or achieve b and c")
    assert [tuple(x) for x in subtasks(tree, 0, NAMES)] == [(1, ("a",), ("b", "c", "d")), (2, ("b", "c"), ("a",))]
    assert [tuple(x) for x in subtasks(tree, 1, NAMES)] == [(3, ("c",), ())]
    assert subtasks(tree, 2) == []
    assert subtasks(tree, 1)[0].reach == ("2",)
    with pytest.raises(ValueError, match="no node"):
        subtasks(tree, 4)
    with pytest.raises(ValueError, match="names"):
        subtasks(tree, 0, ["a"])


def test_trees_that_are_no_tasks_have_no_text() -> None:
    tree = compiled("achieve a; achieve b")
    with pytest.raises(SpecError, match="names"):
        tree_to_formula(tree, ["a"])
    with pytest.raises(SpecError, match="reaches nothing"):
        tree_to_formula(tree.replace(reach=tree.reach & False), NAMES)
    with pytest.raises(SpecError, match="leaf"):
        tree_to_formula(tree.replace(accepting=tree.accepting & False), NAMES)
    with pytest.raises(SpecError, match="no edge"):
        tree_to_formula(tree.replace(valid=tree.valid & False), NAMES)
