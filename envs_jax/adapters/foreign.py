"""An environment that somebody else wrote, as an `Environment`; what `from_gymnax` and `from_brax` have in common.

Axes: **P** atomic propositions, **F** numbers in an observation.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int, Int32, Key

from envs_jax.arrays import Array
from envs_jax.base import Box, Discrete, Environment, EnvParams, StepResult

Observation = Any
"""What a foreign environment shows: an array, or a pytree of arrays."""

Inner = Any
"""A foreign environment's own state: a pytree of arrays."""

Labelling = Callable[[Inner], Mapping[str, Any] | jax.Array]
"""The propositions that hold in a foreign state: bool ``[]`` by name, or bool ``[P]``."""

View = Callable[[Observation], tuple[jax.Array, jax.Array]]
"""Splits a foreign observation (float32) as `Environment.proposition_view` does."""

RESERVED = frozenset({"achieve", "ensuring", "and", "or", "not"})
"""Words of the task language, which no proposition can have for a name."""

MOST_DRAWS = 8
"""Starts drawn for one that differs from the last: where they are all alike there is none."""

LARGEST_BOUND = 1e6
"""Bounds beyond it only say that there is none."""


@struct.dataclass
class ForeignParams(EnvParams):
    """What may be traced.

    Attributes:
        inner: the foreign environment's own parameters, a pytree.
    """

    inner: Any


@struct.dataclass
class Start:
    """A layout: how an episode starts, whole, so that it can be saved and started again exactly.

    Attributes:
        inner: the foreign environment's first state.
        observation: float32 ``observation_shape``, the first one.
    """

    inner: Inner
    observation: jax.Array


@struct.dataclass
class ForeignState:
    """A running episode.

    Attributes:
        inner: the foreign environment's state.
        observation: float32 ``observation_shape``, what it showed of it.
        layout: how the episode started.
        time: int32 ``[]``, steps taken.
    """

    inner: Inner
    observation: jax.Array
    layout: Start
    time: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class Source:
    """A foreign environment as pure functions of one unbatched item. Keys are uint32 ``[2]``, and consumed.

    Attributes:
        name: what error messages call it.
        params: its own parameters, a pytree.
        action_space: where the actions lie that ``step`` takes: discrete, or a box ``[A]`` from -1 to 1.
        reset: ``(key, params)`` to ``(observation, state)``.
        step: ``(key, state, action, params)`` to ``(observation, state, ended, timed_out)``, bool ``[]`` each.
        ends_by_time: ``ended`` is also true where its own time limit is reached.
        bounds: least and largest value of each observed number; ``None`` if unknown.
    """

    name: str
    params: Any
    action_space: Discrete | Box
    reset: Callable[[jax.Array, Any], tuple[Observation, Inner]]
    step: Callable[[jax.Array, Inner, jax.Array, Any], tuple[Observation, Inner, jax.Array, jax.Array]]
    ends_by_time: bool = False
    bounds: tuple[Any, Any] | None = None


@dataclasses.dataclass(frozen=True)
class Form:
    """How the arrays of a foreign observation lie in one.

    Attributes:
        structure: the observation's, as a pytree.
        shapes: its arrays'.
    """

    structure: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, observation: Observation) -> Form:
        """The form of an observation, or of its shapes."""
        leaves, structure = jax.tree.flatten(observation)
        return cls(structure, tuple(tuple(leaf.shape) for leaf in leaves))

    @property
    def shape(self) -> tuple[int, ...]:
        """A single array keeps its shape (images are ``[H, W, C]``); a number and several arrays become ``[F]``."""
        if len(self.shapes) == 1 and self.shapes[0]:
            return self.shapes[0]
        return (sum(map(math.prod, self.shapes)),)

    def pack(self, observation: Observation) -> jax.Array:
        """The observation in one array, float32 :attr:`shape`."""
        parts = [jnp.asarray(leaf, jnp.float32).reshape(-1) for leaf in jax.tree.leaves(observation)]
        return jnp.concatenate(parts).reshape(self.shape)

    def unpack(self, packed: jax.Array) -> Observation:
        """The observation again, its arrays float32."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])
        parts = jnp.split(packed.reshape(-1), ends[:-1])
        leaves = [part.reshape(shape) for part, shape in zip(parts, self.shapes, strict=True)]
        return jax.tree.unflatten(self.structure, leaves)


@dataclasses.dataclass(frozen=True, eq=False)
class Foreign(Environment):
    """A foreign environment with labels; made by `from_gymnax` and `from_brax`. Equal to itself alone.

    Layout: a :class:`Start`. Observation: the foreign one, float32; several arrays one after the other. Action: as the
    foreign environment's where that is discrete, otherwise float32 ``[A]`` in [-1, 1] (clipped to it). Labels: what
    ``labelling`` says of the foreign state. Reward: 0; the foreign one is not used, since tasks pay. Terminated where
    the foreign environment says that the episode has ended, unless ``terminates`` is false; truncated after
    ``horizon`` steps.

    Attributes:
        source: the foreign environment.
        labelling: the propositions that hold in a foreign state.
        names: the P propositions.
        horizon: steps in an episode.
        terminates: whether ends that the foreign environment declares end an episode, as failures.
        view: splits observations; ``None``: nothing of them belongs to a proposition.
        name: the world's name.
    """

    source: Source
    labelling: Labelling
    names: tuple[str, ...]
    horizon: int
    name: str
    terminates: bool = True
    view: View | None = None

    @property
    def propositions(self) -> tuple[str, ...]:
        """The names given, or those of the labels in alphabetical order."""
        return self.names

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """See :attr:`Form.shape`."""
        return self.form.shape

    @property
    def observation_space(self) -> Box:
        """The hull of the foreign bounds, infinite where they are unknown."""
        low, high = self._bounds
        return Box(low=float(low.min()), high=float(high.max()), shape=self.observation_shape)

    @property
    def action_space(self) -> Discrete | Box:
        """Discrete, or float32 ``[A]`` in [-1, 1]."""
        return self.source.action_space

    @property
    def default_params(self) -> ForeignParams:
        """The horizon, and the foreign environment's own parameters."""
        return ForeignParams(horizon=jnp.int32(self.horizon), inner=self.source.params)

    @functools.cached_property
    def form(self) -> Form:
        """How the foreign observation lies in one array."""
        return Form.of(self._first[0])

    @functools.cached_property
    def template(self) -> Inner:
        """Shapes and dtypes of the foreign state after a step. A first state often has Python numbers for arrays."""
        key = jax.eval_shape(lambda: jnp.zeros(2, jnp.uint32))
        action = jax.eval_shape(self.action_space.sample, jax.random.key(0))
        observation, inner, ended, timed_out = jax.eval_shape(
            self.source.step, key, self._first[1], action, self.source.params
        )
        if Form.of(observation) != self.form or Form.of(inner) != Form.of(self._first[1]):
            raise ValueError(
                f"{self.source.name}: a step gives an observation or a state of other arrays than a reset does, "
                "expected the same structure and shapes"
            )
        if ended.shape or timed_out.shape:
            raise ValueError(
                f"{self.source.name}: ends have shape {list(ended.shape)}, expected []; give the environment for one "
                "item, without wrappers that batch it"
            )
        return inner

    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> Start:
        """A start, as the foreign environment draws it."""
        observation, inner = self.source.reset(_raw(key), _inner(params))
        return Start(inner=_like(inner, self.template), observation=self.form.pack(observation))

    def resample_layout(self, key: Key[Array, ""], layout: Start, needed: Bool[Array, ""], params: EnvParams) -> Start:
        """A start other than ``layout`` where ``needed``, unless ``MOST_DRAWS`` draws in a row give the same.

        The loop starts out finished where nothing is needed: a vmapped step at which no episode ends draws nothing.
        """
        layout = jax.tree.map(jnp.asarray, layout)

        def draw(carry: tuple[Any, ...]) -> tuple[Any, ...]:
            key, _, draws, _ = carry
            key, draw_key = jax.random.split(key)
            drawn = self.sample_layout(draw_key, params)
            differs = jax.tree.map(lambda new, old: (new != old).any(), drawn, layout)
            return key, drawn, draws + 1, functools.reduce(jnp.logical_or, jax.tree.leaves(differs))

        def wanting(carry: tuple[Any, ...]) -> jax.Array:
            return jnp.logical_and(~carry[3], carry[2] < MOST_DRAWS)

        drawn: Start = jax.lax.while_loop(wanting, draw, (key, layout, jnp.int32(0), ~needed))[1]
        return drawn

    def check_layout(self, layout: Start) -> None:
        """Raises ``ValueError`` where something observed is no finite number; no more is known of a foreign state."""
        if not np.isfinite(layout.observation).all():
            raise ValueError("the first observation is not finite")

    def reset_to(
        self, layout: Start, key: Key[Array, ""], params: EnvParams
    ) -> tuple[Float32[Array, "..."], ForeignState]:
        """Starts as in a given layout."""
        del key, params
        layout = jax.tree.map(jnp.asarray, layout)
        state = ForeignState(inner=layout.inner, observation=layout.observation, layout=layout, time=jnp.int32(0))
        return state.observation, state

    def step_env(
        self, key: Key[Array, ""], state: ForeignState, action: Int[Array, ""] | Float[Array, " A"], params: EnvParams
    ) -> StepResult:
        """One step; see :meth:`Environment.step_env`."""
        # Rebuilt, since some environments write into their state's dictionaries.
        before = jax.tree.map(lambda x: x, state.inner)
        observation, inner, ended, timed_out = self.source.step(_raw(key), before, action, _inner(params))
        stepped = ForeignState(
            inner=_like(inner, self.template),
            observation=self.form.pack(observation),
            layout=state.layout,
            time=state.time + 1,
        )
        late = stepped.time >= params.horizon
        terminated = ended & ~late if self.source.ends_by_time else ended
        terminated = terminated if self.terminates else jnp.zeros_like(terminated)
        return stepped.observation, stepped, jnp.float32(0.0), terminated, late | timed_out, {}

    def labels(self, state: ForeignState, params: EnvParams) -> Bool[Array, " P"]:
        """What the labelling function says of the foreign state, bool ``[P]``."""
        del params
        found = self.labelling(state.inner)
        if isinstance(found, Mapping):
            return jnp.stack([jnp.asarray(found[name]) for name in self.names])
        return jnp.asarray(found)

    def observation(self, state: ForeignState, params: EnvParams) -> Float32[Array, "..."]:
        """What the foreign environment showed, float32 ``observation_shape``."""
        del params
        return state.observation

    def proposition_view(
        self, observation: Float32[Array, "..."]
    ) -> tuple[Float32[Array, "P ..."], Float32[Array, " F0"]]:
        """As ``view`` splits it. Without one: nothing (float32 ``[P, 0]``), and all that is seen in a row, ``[F]``.

        Shared numbers are scaled to [-1, 1] by their bounds where these are known.
        """
        if self.view is not None:
            return self.view(self.form.unpack(observation))
        middle, scale = self._scaling
        shared = (observation.reshape(-1) - middle) * scale
        return jnp.zeros((self.num_propositions, 0), jnp.float32), shared

    @functools.cached_property
    def _first(self) -> tuple[Observation, Inner]:
        """Shapes of the first observation and state."""
        first: tuple[Observation, Inner] = jax.eval_shape(
            self.source.reset, jax.ShapeDtypeStruct((2,), jnp.uint32), self.source.params
        )
        return first

    @functools.cached_property
    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of each observed number, float64 ``[F]``; infinite where they are unknown."""
        given = (-np.inf, np.inf) if self.source.bounds is None else self.source.bounds
        low, high = (np.broadcast_to(np.asarray(x, np.float64), self.form.shape).reshape(-1) for x in given)
        return np.where(low < -LARGEST_BOUND, -np.inf, low), np.where(high > LARGEST_BOUND, np.inf, high)

    @functools.cached_property
    def _scaling(self) -> tuple[np.ndarray, np.ndarray]:
        """What is taken from each observed number, and what it is then multiplied by, float32 ``[F]`` each."""
        low, high = self._bounds
        middle, scale = np.zeros_like(low), np.ones_like(low)
        known = np.isfinite(low) & np.isfinite(high) & (low < high)
        middle[known] = (low[known] + high[known]) / 2
        scale[known] = 2 / (high[known] - low[known])
        return middle.astype(np.float32), scale.astype(np.float32)


def adopt(
    source: Source,
    labels: Labelling,
    *,
    propositions: Sequence[str] | None,
    horizon: int,
    terminates: bool,
    view: View | None,
    name: str,
) -> Foreign:
    """The environment, once everything that was given has been checked.

    Raises:
        ValueError: if something does not fit together.
    """
    if horizon < 1:
        raise ValueError(f"{source.name}: horizon is {horizon}, expected at least 1")
    nameless = Foreign(source, labels, (), horizon, name, terminates, view)
    found = jax.eval_shape(labels, nameless.template)
    names = _checked_names(source.name, found, propositions)
    env = dataclasses.replace(nameless, names=names)
    _check_view(env)
    return env


def _checked_names(where: str, found: Any, given: Sequence[str] | None) -> tuple[str, ...]:
    """The propositions' names.

    Raises:
        ValueError: unless the labels are booleans, one for each name, and tasks can use the names.
    """
    names = _names(where, found, given)
    for name in names:
        if not name.isidentifier() or name in RESERVED:
            raise ValueError(
                f"{where}: no proposition can be called {name!r}, expected letters, digits and underscores and none of "
                f"the words {', '.join(sorted(RESERVED))}"
            )
    if len(set(names)) < len(names) or not names:
        raise ValueError(f"{where}: propositions are {list(names)}, expected one or more different names")
    values = found if isinstance(found, Mapping) else {"labels": found}
    shape = () if isinstance(found, Mapping) else (len(names),)
    for name, value in values.items():
        if value.dtype != jnp.bool_ or value.shape != shape:
            raise ValueError(
                f"{where}: the label function gives {value.dtype} {list(value.shape)} for {name}, "
                f"expected bool {list(shape)}"
            )
    return names


def _names(where: str, found: Any, given: Sequence[str] | None) -> tuple[str, ...]:
    """The names given, or the labels' own.

    Raises:
        ValueError: if there are none, or they are at odds.
    """
    if isinstance(found, Mapping):
        if given is not None and set(given) != set(found):
            raise ValueError(f"{where}: propositions are {list(given)}, but labels are called {sorted(found)}")
        return tuple(sorted(found) if given is None else given)
    if not isinstance(found, jax.ShapeDtypeStruct):
        raise ValueError(
            f"{where}: the label function gives a {type(found).__name__}, expected a dictionary of bool [] by name, "
            "or an array bool [P]"
        )
    if given is None:
        raise ValueError(
            f"{where}: the label function gives an array; name its entries by propositions=..., or let it give a "
            "dictionary"
        )
    return tuple(given)


def _check_view(env: Foreign) -> None:
    """Raises ``ValueError`` unless ``proposition_view`` gives what it should."""
    if env.view is None:
        return
    found = jax.eval_shape(env.proposition_view, jax.ShapeDtypeStruct(env.observation_shape, jnp.float32))
    leaves = jax.tree.leaves(found)
    shapes = [(str(leaf.dtype), leaf.shape) for leaf in leaves]
    if (
        not isinstance(found, tuple)
        or len(leaves) != 2
        or {dtype for dtype, _ in shapes} != {"float32"}
        or leaves[0].shape[:1] != (env.num_propositions,)
        or leaves[1].ndim != 1
    ):
        given = ", ".join(f"{dtype} {list(shape)}" for dtype, shape in shapes)
        raise ValueError(
            f"{env.source.name}: the view function gives {given}, expected float32 [{env.num_propositions}, ...], one "
            "entry for each proposition, and float32 [F0], what they share"
        )


def _raw(key: Key[Array, ""]) -> jax.Array:
    """The key as uint32 ``[2]``: states may hold one, and are saved as arrays of numbers."""
    return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key


def _inner(params: EnvParams) -> Any:
    """The foreign environment's parameters."""
    assert isinstance(params, ForeignParams)
    return params.inner


def _like(tree: Inner, template: Inner) -> Inner:
    """The arrays with the template's dtypes."""
    return jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), tree, template)
