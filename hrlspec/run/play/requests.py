"""What the page asks for: plain values out of JSON, each of its type and within its bounds."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
from jaxtyping import Float

from hrlspec.run.replay.tasks import Language

MOST_TEXT = 2_000
"""Characters of a task."""
_MOST_SEED = 2**31 - 1
_MOST_THINGS, _FARTHEST = 1_000, 1e6


class RequestError(ValueError):
    """A request that cannot be meant. The message says what was found and what was expected."""


@dataclasses.dataclass(frozen=True, eq=False)
class Arrangement:
    """A layout: one that was drawn, and perhaps changed by hand.

    Attributes:
        seed: of the drawn one.
        places: float ``[T, 2]``, x and y in its outline of the things that can be moved; ``None`` for where they are.
    """

    seed: int
    places: Float[np.ndarray, "T 2"] | None

    @staticmethod
    def read(request: Mapping[str, Any]) -> Arrangement:
        """The arrangement of a request.

        Raises:
            RequestError: there is none.
        """
        return Arrangement(_number(request, "seed"), _places(request.get("places")))


@dataclasses.dataclass(frozen=True, eq=False)
class Attempt:
    """A task that is to be carried out.

    Attributes:
        where: the layout.
        language: that the task is written in.
        task: its text.
        forever: whether a formula in LTL is to be satisfied for ever.
        draw: seed of the agent's and the world's random numbers.
    """

    where: Arrangement
    language: Language
    task: str
    forever: bool
    draw: int

    @staticmethod
    def read(request: Mapping[str, Any]) -> Attempt:
        """The attempt of a request.

        Raises:
            RequestError: there is none.
        """
        language: Any = request.get("language")
        if language not in get_args(Language):
            raise RequestError(f"language is {_shown(language)}, expected {' or '.join(get_args(Language))}")
        task, forever = request.get("task"), request.get("forever", False)
        if not isinstance(task, str):
            raise RequestError(f"task is {_shown(task)}, expected text")
        if len(task) > MOST_TEXT:
            raise RequestError(f"the task has {len(task)} characters, {MOST_TEXT} are possible")
        if not isinstance(forever, bool) or (forever and language != "ltl"):
            raise RequestError("forever goes with ltl")
        return Attempt(Arrangement.read(request), language, task, forever, _number(request, "draw"))


def read_json(body: bytes) -> Mapping[str, Any]:
    """The one object that a body holds.

    Raises:
        RequestError: it holds something else.
    """
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise RequestError("the body is not JSON") from error
    if not isinstance(found, dict):
        raise RequestError("the body is not an object")
    return found


def _number(request: Mapping[str, Any], name: str) -> int:
    value = request.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _MOST_SEED:
        raise RequestError(f"{name} is {_shown(value)}, expected a whole number from 0 to {_MOST_SEED}")
    return value


def _places(value: Any) -> Float[np.ndarray, "T 2"] | None:
    if value is None:
        return None
    if not isinstance(value, list) or len(value) > _MOST_THINGS:
        raise RequestError("places are no list of pairs")
    for pair in value:
        if not isinstance(pair, list) or len(pair) != 2 or not all(map(_is_place, pair)):
            raise RequestError(f"a place is {_shown(pair)}, expected two numbers")
    return np.array(value, float).reshape(-1, 2)


def _is_place(number: Any) -> bool:
    return isinstance(number, int | float) and not isinstance(number, bool) and -_FARTHEST <= number <= _FARTHEST


def _shown(value: Any) -> str:
    """A value in a message."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
