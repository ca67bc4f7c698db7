"""Automata in the Hanoi Omega-Automata format, version 1, as Spot, Owl and Rabinizer print them: in and out.

What is read: Büchi automata with acceptance on transitions or on states, complete or not, deterministic or not, such as
limit-deterministic ones. Choices become jumps: to where an edge without a label leads, as Rabinizer prints what takes
no step; or, where several edges are open to a label, to a state that takes another one of them.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence

import numpy as np

from hrlspec.spec.choices import Edge, Guard, Label, with_jumps
from hrlspec.spec.ltl.automaton import Automaton
from hrlspec.spec.ltl.merging import merged
from hrlspec.spec.ltl.translate import MAX_STATES, minimal
from hrlspec.spec.syntax import Position, SpecError
from hrlspec.spec.tokens import END, Cursor, Token

MAX_TEXT = 10_000_000
"""Most characters that are read."""
_DEPTH = 200
_TOKEN = re.compile(
    r'--(?:BODY|END|ABORT)--|"(?:\\.|[^"\\])*"|[A-Za-z_][\w-]*:|@?[A-Za-z_][\w-]*|\d+|[!&|(){}\[\]]', re.ASCII
)
_SPACE = re.compile(r"(?:\s+|/\*.*?\*/)+", re.DOTALL)
_BUCHI = ["1", "Inf", "(", "0", ")"]


def from_hoa(text: str, propositions: Sequence[str], possible_labels: Iterable[Collection[str]]) -> Automaton:
    """Reads an automaton whose accepting transitions count.

    Args:
        text: of one automaton.
        propositions: all that labels may name.
        possible_labels: the sets of propositions that can hold together.

    Raises:
        SpecError: with line and column: what is no HOA, accepts otherwise than Büchi, or names other propositions; or
            there are too many states.
    """
    if len(text) > MAX_TEXT:
        raise SpecError(f"the text has {len(text):,} characters, at most {MAX_TEXT:,} are read", 1, 1)
    start, states = _Parser(_tokens(text), propositions).whole()
    labels = tuple(dict.fromkeys(map(frozenset, possible_labels)))
    successors, marks, jumps, rejecting = merged(*with_jumps(start, states, labels))
    return Automaton(labels, successors, None, rejecting, marks, jumps if any(jumps) else ())


def until_accepting(automaton: Automaton) -> Automaton:
    """The minimal automaton of the finite task that is satisfied with the first accepting transition.

    Args:
        automaton: with accepting transitions.

    Raises:
        SpecError: it has jumps.
    """
    assert automaton.marks is not None
    if automaton.jumps:
        raise SpecError("the automaton leaves choices, which are for tasks that go on for ever")
    # Its states are numbered anew: 0 is the initial one, 1 where it is satisfied.
    number = np.array([0, *range(2, automaton.num_states + 1)])
    table = np.where(automaton.marks, 1, number[automaton.successors])
    rows = np.vstack([table[:1], np.ones_like(table[:1]), table[1:]])
    successors, accepting, rejecting = minimal(rows)
    return Automaton(automaton.labels, successors, accepting, rejecting)


def to_hoa(automaton: Automaton, name: str = "") -> str:
    """Text of an automaton; of a finite task every transition into the accepting state accepts, and so all that follow.

    Labels that cannot occur have no transition; jumps are edges without a label.
    """
    names = sorted(frozenset().union(*automaton.labels))
    place = {proposition: number for number, proposition in enumerate(names)}
    marks = automaton.successors == automaton.accepting if automaton.marks is None else automaton.marks

    def guard(label: Label) -> str:
        literals = (str(place[x]) if x in label else f"!{place[x]}" for x in names)
        return "&".join(literals) or "t"

    lines = ["HOA: v1", *([f'name: "{name}"'] if name else []), f"States: {automaton.num_states}", "Start: 0"]
    lines += [" ".join(["AP:", str(len(names)), *(f'"{x}"' for x in names)])]
    kind = "" if automaton.jumps else " deterministic"
    lines += ["acc-name: Buchi", "Acceptance: 1 Inf(0)", f"properties: trans-acc{kind}", "--BODY--"]
    for state in range(automaton.num_states):
        lines.append(f"State: {state}")
        groups: dict[tuple[int, bool], list[str]] = {}
        for column, label in enumerate(automaton.labels):
            key = int(automaton.successors[state, column]), bool(marks[state, column])
            groups.setdefault(key, []).append(guard(label))
        for (target, marked), guards in groups.items():
            lines.append(f"[{' | '.join(guards)}] {target}{' {0}' if marked else ''}")
        lines += [str(target) for target in (automaton.jumps[state] if automaton.jumps else ())]
    return "\n".join([*lines, "--END--", ""])


def _tokens(text: str) -> list[Token]:
    found: list[Token] = []
    line, line_start, i = 1, 0, 0
    while i < len(text):
        if space := _SPACE.match(text, i):
            i = space.end()
            if newlines := space[0].count("\n"):
                line, line_start = line + newlines, text.rindex("\n", 0, i) + 1
            continue
        position = Position(line, i - line_start + 1)
        match = _TOKEN.match(text, i)
        if match is None:
            raise position.error(f"found {text[i]!r}, expected a word of the HOA format")
        found.append(Token(match[0], position))
        i = match.end()
    found.append(Token(END, Position(line, i - line_start + 1)))
    return found


class _Parser(Cursor[Token]):
    """Header and body of one automaton."""

    def __init__(self, tokens: Sequence[Token], propositions: Sequence[str]) -> None:
        super().__init__(tokens)
        self.known = propositions
        self.names: list[str] | None = None
        self.aliases: dict[str, Guard] = {}
        self.start: int | None = None
        self.all_accept = False

    def take(self, expected: str = "", text: str | None = None) -> Token:
        """The next token, which must be ``text`` if that is given."""
        token = self.token
        if token.text == END or (text is not None and token.text != text):
            raise token.unexpected(expected or repr(text))
        self.index += 1
        return token

    def number(self, what: str) -> int:
        token = self.take(what)
        if not token.text.isdigit() or len(token.text) > 9:
            raise token.unexpected(what)
        return int(token.text)

    def whole(self) -> tuple[int, list[list[Edge]]]:
        """The initial state, and the edges of each state."""
        self.take("'HOA:', with which an automaton begins", "HOA:")
        version = self.take("v1")
        if version.text != "v1":
            raise version.unexpected("v1, the version that is read")
        while self.token.text != "--BODY--":
            self.item()
        body = self.take()
        if self.start is None:
            raise body.unexpected("'Start:' in the header")
        states = self.body()
        self.take("'--END--'", "--END--")
        if self.token.text != END:
            raise self.token.unexpected("the end of the text: one automaton")
        if self.start not in states:
            raise body.position.error(f"found no state {self.start}, with which it starts")
        targets = {edge.target for edges in states.values() for edge in edges}
        for target in sorted(targets - states.keys()):
            raise body.position.error(f"found no state {target}, to which a transition leads")
        if max(states) >= MAX_STATES:
            raise body.position.error(f"the automaton has states beyond {MAX_STATES:,}")
        return self.start, [states.get(number, []) for number in range(max(states) + 1)]

    def item(self) -> None:
        """One line of the header; those that say nothing about the automaton itself are skipped."""
        header = self.take("'--BODY--'")
        if not header.text.endswith(":"):
            raise header.unexpected("a header, such as 'AP:', or '--BODY--'")
        match header.text:
            case "Start:":
                if self.start is not None:
                    raise header.unexpected("one initial state: deterministic")
                self.start = self.number("the number of a state")
                if self.token.text == "&":
                    raise self.token.unexpected("one initial state: no alternation")
            case "AP:":
                self.propositions()
            case "Alias:":
                name = self.take("a name that begins with @").text
                self.aliases[name] = self.guard()
            case "Acceptance:":
                self.acceptance(header)
            case _:
                self.rest()

    def rest(self) -> list[str]:
        """What remains of a header's line."""
        words = []
        while self.token.text not in (END, "--BODY--") and not self.token.text.endswith(":"):
            words.append(self.take().text)
        return words

    def propositions(self) -> None:
        count, names = self.number("how many propositions there are"), []
        for _ in range(count):
            token = self.take("the name of a proposition in quotes")
            name = token.text[1:-1]
            if not token.text.startswith('"'):
                raise token.unexpected("the name of a proposition in quotes")
            if name not in self.known:
                raise token.position.error(f"{name!r} is no proposition, expected some of {', '.join(self.known)}")
            names.append(name)
        self.names = names

    def acceptance(self, header: Token) -> None:
        words = self.rest()
        self.all_accept = words == ["0", "t"]
        if words != _BUCHI and not self.all_accept:
            found = " ".join(words) or "nothing"
            raise header.position.error(f"found the acceptance {found}, expected Büchi: 1 Inf(0)")

    def body(self) -> dict[int, list[Edge]]:
        states: dict[int, list[Edge]] = {}
        while self.token.text == "State:":
            header = self.take()
            common = self.bracketed() if self.token.text == "[" else None
            state = self.number("the number of a state")
            if state in states:
                raise header.position.error(f"state {state} is there twice")
            if self.token.text.startswith('"'):
                self.take()
            marked = self.marked()
            states[state] = edges = list(self.edges(common, marked))
            if edges and all(edge.guard is None for edge in edges):
                raise edges[0].position.error("no transition of the state has a label: implicit ones are not read")
        if not states:
            raise self.token.unexpected("'State:'")
        return states

    def edges(self, common: Guard | None, marked: bool) -> Iterator[Edge]:
        while self.token.text == "[" or self.token.text.isdigit():
            position = self.token.position
            own = self.bracketed() if self.token.text == "[" else None
            target = self.number("the number of a state")
            if self.token.text == "&":
                raise self.token.unexpected("one state: no alternation")
            accepts = self.marked() or marked
            guard = own or common
            if guard is None and accepts:
                raise position.error("a transition without a label takes no step and cannot accept")
            yield Edge(position, guard, target, guard is not None and (accepts or self.all_accept))

    def marked(self) -> bool:
        """Whether a set of acceptance sets follows, which can be that of the first alone."""
        if self.token.text != "{":
            return False
        self.take()
        found = False
        while self.token.text != "}":
            token = self.token
            found = True
            if self.number("0, the acceptance set of a Büchi automaton") != 0:
                raise token.unexpected("0, the acceptance set of a Büchi automaton")
        self.take()
        return found

    def bracketed(self) -> Guard:
        self.take(text="[")
        guard = self.guard()
        self.take("']'", "]")
        return guard

    def guard(self, depth: int = 0) -> Guard:
        """A disjunction of conjunctions."""
        parts = [self.conjunction(depth)]
        while self.token.text == "|":
            self.take()
            parts.append(self.conjunction(depth))
        return parts[0] if len(parts) == 1 else lambda label: any(part(label) for part in parts)

    def conjunction(self, depth: int) -> Guard:
        parts = [self.literal(depth)]
        while self.token.text == "&":
            self.take()
            parts.append(self.literal(depth))
        return parts[0] if len(parts) == 1 else lambda label: all(part(label) for part in parts)

    def literal(self, depth: int) -> Guard:
        token = self.take("a label")
        if depth > _DEPTH:
            raise token.position.error(f"labels nested more than {_DEPTH} deep")
        if token.text == "!":
            inner = self.literal(depth + 1)
            return lambda label: not inner(label)
        if token.text == "(":
            inner = self.guard(depth + 1)
            self.take("')'", ")")
            return inner
        if token.text in ("t", "f"):
            return lambda label: token.text == "t"
        if token.text in self.aliases:
            return self.aliases[token.text]
        if token.text.isdigit() and self.names is not None and int(token.text) < len(self.names):
            name = self.names[int(token.text)]
            return lambda label: name in label
        raise token.unexpected(f"a label: t, f, !, an alias, or a number below {len(self.names or ())}")
