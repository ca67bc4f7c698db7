"""Text of linear temporal logic, there and back, and what is refused."""

from __future__ import annotations

import csv
from pathlib import Path

import hypothesis
import pytest
from hypothesis import strategies as st

from hrlspec.spec import SpecError
from hrlspec.spec.ltl import Formula, ltl_text, parse_ltl, propositions_of
from hrlspec.spec.ltl.syntax import MAX_DEPTH, Binary, Constant, Nary, Proposition, Unary, subformulas
from hrlspec.spec.syntax import MAX_TEXT

PEERS = list(
    csv.DictReader((Path(__file__).parents[2] / "data" / "peers_ltl.csv").read_text(encoding="utf-8").splitlines())
)
A, B, C, D = (Proposition(name) for name in "abcd")


@pytest.mark.parametrize(
    ("text", "tree"),
    [
        ("a", A),
        ("true | false", Nary("|", (Constant(True), Constant(False)))),
        ("!a U b", Binary("U", Unary("!", A), B)),
        ("X a & b", Nary("&", (Unary("X", A), B))),
        ("a & b | c & d", Nary("|", (Nary("&", (A, B)), Nary("&", (C, D))))),
        ("a & b & c", Nary("&", (A, B, C))),
        ("(a & b) & c", Nary("&", (Nary("&", (A, B)), C))),
        ("a U b | c", Nary("|", (Binary("U", A, B), C))),
        ("a U (b R c)", Binary("U", A, Binary("R", B, C))),
        ("a W b & c M d", Nary("&", (Binary("W", A, B), Binary("M", C, D)))),
        ("GF a", Unary("G", Unary("F", A))),
        ("FG(a)", Unary("F", Unary("G", A))),
        ("G!a", Unary("G", Unary("!", A))),
        ("XXF a", Unary("X", Unary("X", Unary("F", A)))),
        ("aUb", Proposition("aUb")),
        ("a => b", Binary("->", A, B)),
        ("a <-> b", Binary("<->", A, B)),
        ("a -> b U c", Binary("->", A, Binary("U", B, C))),
        ("a -> !b U (c -> d)", Binary("->", A, Binary("U", Unary("!", B), Binary("->", C, D)))),
        ("region_a U\n\tx2", Binary("U", Proposition("region_a"), Proposition("x2"))),
    ],
)
def test_how_it_is_read(text: str, tree: Formula) -> None:
    assert parse_ltl(text) == tree
    assert parse_ltl(ltl_text(tree)) == tree


def test_formulas_of_the_field_come_back_as_they_were() -> None:
    assert len(PEERS) == 554
    for row in PEERS:
        formula = parse_ltl(row["formula"])
        assert parse_ltl(ltl_text(formula)) == formula
        assert propositions_of(formula) == tuple(sorted(row["propositions"].split()))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1, column 1: found the end of the text, expected a formula, such as 'F (a & F b)'"),
        ("a &", "line 1, column 4: found the end of the text, expected a proposition, '!', 'X', 'F', 'G' or '('"),
        ("a b", "line 1, column 3: found 'b', expected an operator between two formulas or the end of the text"),
        ("a &\n & b", "line 2, column 2: found '&', expected a proposition"),
        ("U a", "line 1, column 1: found 'U', expected a proposition"),
        ("a UF", "line 1, column 5: found the end of the text"),
        ("(a | b", "expected an operator between two formulas or ')' for the '(' at line 1, column 1"),
        ("a)", "line 1, column 2: found ')'"),
        ("a $ b", "line 1, column 3: found '$'"),
        ("2a", "line 1, column 1: found '2'"),
        ("a && b", "line 1, column 4: found '&', expected a proposition"),
        ("a U b U c", "line 1, column 7: 'U' beside 'U' is read in two ways; use parentheses"),
        ("a U b W c", "line 1, column 7: 'W' beside 'U' is read in two ways; use parentheses"),
        ("a & b => c", "line 1, column 7: '->' beside '&' is read in two ways; use parentheses"),
        ("a => b | c", "line 1, column 3: '->' beside '|' is read in two ways; use parentheses"),
        ("a U b => c", "line 1, column 7: '->' beside 'U' is read in two ways; use parentheses"),
        ("a => b => c", "line 1, column 3: '->' beside '->' is read in two ways; use parentheses"),
        ("a => b U c U d", "line 1, column 3: '->' beside 'U' is read in two ways; use parentheses"),
        ("!" * (MAX_DEPTH + 1) + "a", f"nested more than {MAX_DEPTH} deep"),
        ("(" * (MAX_DEPTH + 1) + "a", f"nested more than {MAX_DEPTH} deep"),
        ("a" * (MAX_TEXT + 1), f"the text has {MAX_TEXT + 1:,} characters"),
        ("a|" * (MAX_TEXT // 2), "line 1, column 20001: found the end of the text"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(text: str, message: str) -> None:
    with pytest.raises(SpecError) as raised:
        parse_ltl(text)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["", "a b", "true", "GF", "U", "1x"])
def test_names_that_propositions_cannot_have(name: str) -> None:
    with pytest.raises(SpecError, match="cannot name a proposition in LTL"):
        Proposition(name)


def test_only_text_is_read() -> None:
    with pytest.raises(TypeError, match="takes a string, found int"):
        parse_ltl(3)  # type: ignore[arg-type]


WORDS = st.sampled_from("a b ab true ! X F G U R W M & | -> => <-> ( )".split())


@hypothesis.settings(max_examples=200, deadline=None)
@hypothesis.given(st.one_of(st.text(max_size=40), st.lists(WORDS, max_size=16).map(" ".join)))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        formula = parse_ltl(text)
    except SpecError:
        return
    assert parse_ltl(ltl_text(formula)) == formula
    assert all(isinstance(node, Formula) for node in subformulas(formula))
