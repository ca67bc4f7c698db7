from __future__ import annotations

import copy
import pickle

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hrlspec.spec import (
    Achieve,
    And,
    Choice,
    Ensuring,
    Formula,
    Not,
    Or,
    Prop,
    SpecError,
    Then,
    compile_task,
    parse,
    satisfies,
    to_text,
)
from hrlspec.spec.syntax import MAX_NESTING, MAX_TEXT
from tests.spec.tasks import NAMES, formulas

A, B, C, D = map(Prop, "abcd")


@settings(max_examples=100, deadline=None)
@given(formulas())
@example(Then((Then((Achieve(A), Achieve(B))), Achieve(C))))
@example(Choice((Achieve(A), Choice((Achieve(Or((A, B))), Achieve(C))))))
@example(Ensuring(Ensuring(Achieve(Or((And((A, Or((B, C)))), D))), Not(Not(A))), Not(And((B, C)))))
def test_text_reads_back(formula: Formula) -> None:
    text = to_text(formula)
    assert parse(text) == formula
    assert to_text(parse(text)) == text


@pytest.mark.parametrize(
    ("text", "formula"),
    [
        ("achieve a", Achieve(A)),
        ("achieve a and b or c", Achieve(Or((And((A, B)), C)))),
        ("achieve a or achieve b", Choice((Achieve(A), Achieve(B)))),
        ("achieve a or (achieve b)", Choice((Achieve(A), Achieve(B)))),
        ("achieve a or (b)", Achieve(Or((A, B)))),
        ("achieve a; achieve b; achieve c", Then((Achieve(A), Achieve(B), Achieve(C)))),
        ("achieve a; (achieve b; achieve c)", Then((Achieve(A), Then((Achieve(B), Achieve(C)))))),
        ("achieve a; achieve b or achieve c", Choice((Then((Achieve(A), Achieve(B))), Achieve(C)))),
        ("achieve a; achieve b ensuring not c", Then((Achieve(A), Ensuring(Achieve(B), Not(C))))),
        ("achieve a ensuring not b or achieve c", Choice((Ensuring(Achieve(A), Not(B)), Achieve(C)))),
        ("achieve a ensuring not b or not c", Ensuring(Achieve(A), Or((Not(B), Not(C))))),
        ("achieve a ensuring not b and not c", Ensuring(Achieve(A), And((Not(B), Not(C))))),
        ("achieve a ensuring not b ensuring not c", Ensuring(Ensuring(Achieve(A), Not(B)), Not(C))),
        ("(achieve a;\n achieve b) # both\r\n ensuring not c#end", Ensuring(Then((Achieve(A), Achieve(B))), Not(C))),
        ("\ufeffachieve\u00a0a", Achieve(A)),
        ("achieve e\u0301", Achieve(Prop("\u00e9"))),
    ],
)
def test_precedence_and_layout(text: str, formula: Formula) -> None:
    assert parse(text) == formula


@pytest.mark.parametrize(
    ("text", "line", "column", "words"),
    [
        ("", 1, 1, ["end of the text", "'achieve a"]),
        ("  # nothing\n ", 2, 2, ["end of the text"]),
        ("achieve", 1, 8, ["end of the text", "a proposition"]),
        ("achieve a;", 1, 11, ["end of the text", "'achieve' or '('"]),
        ("achieve a\n; b", 2, 3, ["found 'b'", "'achieve b'"]),
        ("achieve a\r\n\r\n  $", 3, 3, ["found '$'"]),
        ("achieve a\rachieve", 2, 1, ["found 'achieve'", "';'"]),
        ("(achieve a", 1, 11, ["end of the text", "')'", "line 1, column 1"]),
        ("achieve a)", 1, 10, ["found ')'", "end of the text"]),
        ("achieve (a; b)", 1, 11, ["found ';'", "')'"]),
        ("achieve a and achieve b", 1, 15, ["found 'achieve'", "joined by"]),
        ("achieve or", 1, 9, ["found 'or'", "a proposition"]),
        ("achieve a ensuring", 1, 19, ["end of the text"]),
        ("achieve a ensuring not", 1, 23, ["end of the text"]),
        ("achieve 1a", 1, 9, ["found '1'"]),
        ("Achieve a", 1, 1, ["found 'Achieve'", "expected 'achieve'"]),
        ("achieve a or", 1, 13, ["end of the text"]),
        ("achieve \ud800", 1, 9, ["\\ud800"]),
        ("achieve \x00", 1, 9, ["\\x00"]),
        ("(" * (MAX_NESTING + 1) + "achieve a", 1, MAX_NESTING + 1, [f"more than {MAX_NESTING} deep"]),
        ("achieve " + "(" * 15_000 + "a", 1, 9 + MAX_NESTING, [f"more than {MAX_NESTING} deep"]),
        ("achieve " + "not " * 4000 + "a", 1, 9 + 4 * (MAX_NESTING - 1), ["times 'not'"]),
        ("achieve a" + " ensuring not b" * 1000, 1, 11 + 15 * (MAX_NESTING - 1), ["times 'ensuring'"]),
        ("achieve a" + " " * MAX_TEXT, 1, 1, [f"{MAX_TEXT:,}"]),
    ],
)
def test_errors_say_where_and_what(text: str, line: int, column: int, words: list[str]) -> None:
    with pytest.raises(SpecError) as caught:
        parse(text)
    error = caught.value
    assert (error.line, error.column) == (line, column), str(error)
    assert str(error).startswith(f"line {line}, column {column}: ")
    assert "\n" not in str(error)
    assert len(str(error)) < 300
    for word in words:
        assert word in str(error)


def test_errors_survive_pickling() -> None:
    with pytest.raises(SpecError) as caught:
        parse("achieve")
    again = pickle.loads(pickle.dumps(caught.value))
    assert (str(again), again.line, again.column) == (str(caught.value), 1, 8)


def test_only_text_is_parsed() -> None:
    with pytest.raises(TypeError, match="string"):
        parse(b"achieve a")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["", "a b", "not", "1", "a-b", "a;"])
def test_names_that_could_not_be_read_back_are_refused(name: str) -> None:
    with pytest.raises(SpecError):
        Prop(name)


def _tower(height: int) -> Formula:
    formula: Formula = Achieve(A)
    for _ in range(height):
        formula = Then((formula, Achieve(B)))
    return formula


def _doubling(times: int) -> Formula:
    formula: Formula = Achieve(A)
    for _ in range(times):
        formula = Choice((formula, formula))
    return formula


@pytest.mark.parametrize(
    "formula",
    [
        _tower(5000),
        _doubling(50),
        Then((Achieve(A),)),
        Then([Achieve(A), Achieve(B)]),  # type: ignore[arg-type]
        Choice(()),
        Achieve(Achieve(A)),  # type: ignore[arg-type]
        Achieve("a"),  # type: ignore[arg-type]
        Achieve(None),  # type: ignore[arg-type]
        Ensuring(A, A),  # type: ignore[arg-type]
        Formula(),
        "achieve a",
    ],
    ids=lambda formula: type(formula).__name__,
)
def test_malformed_trees_are_refused_by_every_reader(formula: Formula) -> None:
    with pytest.raises(SpecError):
        to_text(formula)
    with pytest.raises(SpecError):
        compile_task(formula, NAMES, 16)
    with pytest.raises(SpecError):
        satisfies(formula, [{"a"}])


def test_deepest_legal_trees_work() -> None:
    formula = _tower(MAX_NESTING - 2)
    text = to_text(formula)
    assert parse(text) == formula == copy.deepcopy(formula)
    assert hash(parse(text)) == hash(formula)
    assert int(compile_task(formula, NAMES, 100).valid.sum()) == MAX_NESTING
    assert satisfies(formula, [{"a", "b"}] * MAX_NESTING)


_WORDS = ["achieve", "ensuring", "and", "or", "not", ";", "(", ")", "a", "b", "é", "#", "\n", "\r\n", "@", "x", "0"]


def _survives(text: str) -> None:
    """Reads, or says why not; what it reads can be written, and compiled or refused."""
    place: tuple[int | None, int | None] = (1, 1)
    try:
        formula = parse(text)
        assert parse(to_text(formula)) == formula
        satisfies(formula, [{"a"}, {"b", "x"}])
        compile_task(formula, NAMES, 64)
    except SpecError as error:
        place = error.line, error.column
    assert all(number is not None and 1 <= number <= len(text) + 1 for number in place), place


@settings(max_examples=300, deadline=1000)
@given(st.text(max_size=60))
def test_any_text_survives(text: str) -> None:
    _survives(text)


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
@settings(max_examples=300, deadline=2000)
@given(st.lists(st.sampled_from(_WORDS), max_size=40).map(" ".join))
def test_any_soup_of_words_survives(text: str) -> None:
    _survives(text)


@pytest.mark.filterwarnings("ignore::hrlspec.spec.SpecWarning")
@settings(max_examples=300, deadline=2000)
@given(formulas(NAMES).map(to_text), st.data())
def test_damaged_formulas_survive(text: str, data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(start, min(len(text), start + 12)))
    insert = data.draw(st.sampled_from(["", *_WORDS]))
    _survives(f"{text[:start]} {insert} {text[end:]}")
