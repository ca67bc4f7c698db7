"""A task as a deterministic finite automaton over the sets of propositions that can hold together."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Iterable, Mapping

import numpy as np
from jaxtyping import Bool, Int32

from hrlspec.spec.monitor import RUNNING, SATISFIED, VIOLATED


@dataclasses.dataclass(frozen=True, eq=False)
class Automaton:
    """States 0 to Q - 1, of which 0 is where a trace begins; what has been accepted or rejected stays so.

    Of a task that goes on for ever accepting transitions count, and no state is accepting. Such a task may leave
    choices: a jump from one state to another takes no step, reads no label and never accepts.

    Axes: **Q** states, **L** labels.

    Attributes:
        labels: the L sets of propositions that can hold together; all others are impossible.
        successors: int32 ``[Q, L]``, the state that each label leads to.
        accepting: the state in which the task is satisfied; ``None`` if it can never be.
        rejecting: the state from which it cannot be satisfied any more; ``None`` if there is none.
        marks: bool ``[Q, L]``, the accepting transitions of a task that goes on for ever; else ``None``.
        jumps: the states to which each state may jump, one tuple a state; empty where there is no choice at all.
    """

    labels: tuple[frozenset[str], ...]
    successors: Int32[np.ndarray, "Q L"]
    accepting: int | None
    rejecting: int | None
    marks: Bool[np.ndarray, "Q L"] | None = None
    jumps: tuple[tuple[int, ...], ...] = ()

    @property
    def num_states(self) -> int:
        """Q."""
        return len(self.successors)

    def origins(self, state: int) -> tuple[int, ...]:
        """The states that may read the next label: the state itself, then all that jumps lead to."""
        found = [state]
        for origin in found if self.jumps else ():  # Grows while it is read.
            found += [target for target in self.jumps[origin] if target not in found]
        return tuple(found)

    @functools.cached_property
    def _column(self) -> Mapping[frozenset[str], int]:
        return {label: column for column, label in enumerate(self.labels)}

    def run(self, trace: Iterable[Collection[str]]) -> int:
        """How the task stands after a trace: the propositions that hold after the first action, and so on.

        No jump is taken.

        Returns:
            `RUNNING`, `SATISFIED` or `VIOLATED` of `hrlspec.spec`.

        Raises:
            ValueError: a label of the trace is impossible.
        """
        state = 0
        for step, label in enumerate(trace):
            column = self._column.get(frozenset(label))
            if column is None:
                shown = ", ".join(sorted(label))
                raise ValueError(f"step {step} of the trace has the label {{{shown}}}, which cannot occur")
            state = int(self.successors[state, column])
        if state == self.accepting:
            return SATISFIED
        return VIOLATED if state == self.rejecting else RUNNING
