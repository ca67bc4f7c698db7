"""What ``--env`` and ``--method`` name: an entry of the library, or anybody's value as ``module:attribute``."""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
import sys
from collections.abc import Iterator
from typing import Any

from envs_jax import Environment
from hrlspec.methods import METHODS, Method
from hrlspec.presets import KNOWN, Preset, find_preset, preset_for
from hrlspec.run.errors import UserError, in_words
from hrlspec.spec import SpecError, parse


@functools.cache
def preset_named(name: str) -> Preset:
    """A preset of the library, the one at ``module:attribute``, or one made for the environment there.

    Raises:
        UserError: there is nothing of that name, or it is neither of them.
    """
    if ":" in name:
        expected = "an environment that keeps the contract in envs_jax/base.py, or a Preset"
        found: Environment | Preset = _load(name, (Environment, Preset), expected)
        some = found if isinstance(found, Preset) else preset_for(found)
        with _not_ours(name):
            env = some.make()
            if not isinstance(env, Environment):
                raise UserError(f"{name} makes a value of type {type(env).__name__}, expected an environment")
            hash(env)  # as static arguments must be
        for proposition in env.propositions:
            try:
                parse(f"achieve {proposition}")
            except SpecError as error:
                raise UserError(f"{name}: tasks cannot name the proposition {proposition!r}: {error}") from None
        return some
    try:
        known = find_preset(name)
    except ValueError as error:
        raise UserError(str(error)) from None
    if known is None:
        raise UserError(f"unknown environment {name!r}, expected one of {KNOWN}, or module:factory")
    return known


@functools.cache
def method_named(name: str) -> Method:
    """A method of the library, or the value at ``module:attribute``.

    Raises:
        UserError: there is nothing of that name, or it is no method.
    """
    if ":" in name:
        method: Method = _load(name, (Method,), "a value of a subclass of hrlspec.methods.Method")
        with _not_ours(name):
            hash(method)
        return method
    if name not in METHODS:
        raise UserError(f"unknown method {name!r}, expected one of {', '.join(METHODS)}, or module:VALUE")
    return METHODS[name]


def search_here() -> None:
    """Lets modules in the current directory be imported, as ``python -m`` does and console scripts do not."""
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())


def _load(name: str, kinds: tuple[type, ...], expected: str) -> Any:
    """The value at ``module:attribute``, or what it returns when called. The current directory is searched first.

    Raises:
        UserError: it cannot be had, or is of another kind.
    """
    module_name, _, attribute = name.partition(":")
    search_here()
    with _not_ours(name):
        found = importlib.import_module(module_name)
        for part in attribute.split("."):
            found = getattr(found, part)
        value = found if isinstance(found, kinds) or not callable(found) else found()
        if not isinstance(value, kinds):
            raise UserError(f"{name} is of type {type(value).__name__}, expected {expected}")
    return value


@contextlib.contextmanager
def _not_ours(name: str) -> Iterator[None]:
    """Whatever somebody else's code raises becomes a `UserError`."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # anything, since it is not our code
        raise UserError(f"{name} cannot be used: {in_words(error)}") from error
