"""The contract between environments and whatever trains on them.

An environment is a static, hashable value (sizes, names) whose methods are pure functions of arrays. All of
them are written for one unbatched item: ``vmap`` at the edge. Keys are consumed.

What only some environments can do is a capability: an abstract class below :class:`Environment`. A world inherits
those it has, and who needs one asks ``isinstance(env, FiniteGraph)``.

Axes: **P** atomic propositions, **S** states of a finite environment, **A** its actions, **X**, **Y** places of a grid.
"""

from __future__ import annotations

import abc
import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int, Int32, Key, Shaped

from envs_jax.arrays import Array
from envs_jax.scenes import Scene

Layout = Any
"""What a reset may vary (where the letters or zones lie): a pytree of arrays."""

State = Any
"""Everything that changes within an episode and the layout it takes place in: a pytree of arrays."""

Info = dict[str, Shaped[Array, "..."]]
StepResult = tuple[Float32[Array, "..."], State, Float32[Array, ""], Bool[Array, ""], Bool[Array, ""], Info]


@struct.dataclass
class EnvParams:
    """What may be traced, so that changing it compiles nothing anew.

    Attributes:
        horizon: int32 ``[]``, steps after which an episode is truncated.
    """

    horizon: Int32[Array, "*lead"]


@struct.dataclass
class Discrete:
    """A space of the integers ``0 .. n - 1``.

    Attributes:
        n: the number of elements.
    """

    n: int = struct.field(pytree_node=False)
    shape: ClassVar[tuple[int, ...]] = ()
    dtype: ClassVar[Any] = np.int32

    def sample(self, key: Key[Array, ""]) -> Int32[Array, ""]:
        """A uniform element, int32 ``[]``."""
        return jax.random.randint(key, (), 0, self.n, jnp.int32)

    def contains(self, x: Any) -> bool:
        """Whether ``x`` is one integer in range."""
        value = np.asarray(x)
        return value.shape == () and np.issubdtype(value.dtype, np.integer) and bool(0 <= value < self.n)


@struct.dataclass
class Box:
    """A box of real arrays, the same bounds in every coordinate.

    Attributes:
        low: the least value of a coordinate.
        high: the largest.
        shape: the arrays' shape.
    """

    low: float = struct.field(pytree_node=False)
    high: float = struct.field(pytree_node=False)
    shape: tuple[int, ...] = struct.field(pytree_node=False)
    dtype: ClassVar[Any] = np.float32

    def sample(self, key: Key[Array, ""]) -> Float32[Array, "..."]:
        """A uniform element, float32 ``shape``."""
        return jax.random.uniform(key, self.shape, jnp.float32, self.low, self.high)

    def contains(self, x: Any) -> bool:
        """Whether ``x`` has the shape and lies within the bounds (bounds included)."""
        value = np.asarray(x)
        return value.shape == self.shape and bool(np.all((value >= self.low) & (value <= self.high)))


def at_most_one(propositions: Sequence[str]) -> tuple[frozenset[str], ...]:
    """Nothing, or one proposition alone: the labels of worlds whose goals lie apart."""
    return (frozenset(), *(frozenset({name}) for name in propositions))


@dataclasses.dataclass(frozen=True)
class Symmetries:
    """Says that a world of square images stays the same world when it is turned or reflected.

    Turn k = 4t + 2r + c transposes the image if t, then reverses its rows if r, and its columns if c. Hashable, so that
    it can be a static attribute of a network.

    Attributes:
        actions: for each of the 8 turns, which action does in the turned world what action a does now, for all A.
    """

    actions: tuple[tuple[int, ...], ...]


@dataclasses.dataclass(frozen=True)
class Reflections:
    """Says that a world of vectors stays the same world, or nearly, when it is reflected in the agent's axes.

    Reflection k reads feature i of each proposition at ``features[k][i]`` and shared feature j at ``shared[k][j]``,
    times ``signs[k][j]``; an action a in the reflected world is ``actions[k] · a`` in the world itself. Hashable, as
    `Symmetries`.

    Attributes:
        features: K orders of a proposition's L features; the first reflection changes nothing.
        shared: K orders of the F0 shared features.
        signs: their signs, K by F0.
        actions: signs of the A coordinates of an action, K by A.
        sector: L weights, largest for features that lie in the sector which is to hold what the agent is turned to.
        heading: F0 weights of shared features, large where the agent moves the way that is to count as forward.
    """

    features: tuple[tuple[int, ...], ...]
    shared: tuple[tuple[int, ...], ...]
    signs: tuple[tuple[float, ...], ...]
    actions: tuple[tuple[float, ...], ...]
    sector: tuple[float, ...]
    heading: tuple[float, ...]


class Environment(abc.ABC):
    """A world with labels. Rewards come from tasks, so environments pay 0 and end episodes by truncation only.

    Attributes:
        name: the preset's name.
        propositions: names of the P propositions, in the order of ``labels``.
        horizon: steps after which an episode is truncated, unless ``params`` says otherwise.
        observation_shape: shape of an observation.
    """

    name: str
    horizon: int

    @property
    @abc.abstractmethod
    def propositions(self) -> tuple[str, ...]:
        """Names of the P propositions, in the order of ``labels``."""

    @property
    @abc.abstractmethod
    def observation_shape(self) -> tuple[int, ...]:
        """Shape of an observation (float32)."""

    @property
    @abc.abstractmethod
    def observation_space(self) -> Box:
        """Where observations lie."""

    @property
    @abc.abstractmethod
    def action_space(self) -> Discrete | Box:
        """Where actions lie."""

    @property
    def num_propositions(self) -> int:
        """P."""
        return len(self.propositions)

    @property
    def possible_labels(self) -> tuple[frozenset[str], ...]:
        """The sets of propositions that can hold together; all of them, unless a world knows better.

        The fewer there are, the smaller the automata of tasks and the more is known of what to avoid. In layouts that
        were made by hand others may occur; an automaton then stays where it is.
        """
        sizes = range(self.num_propositions + 1)
        some = itertools.chain.from_iterable(itertools.combinations(self.propositions, size) for size in sizes)
        return tuple(map(frozenset, some))

    @property
    def default_params(self) -> EnvParams:
        """The traced parameters as the preset has them."""
        return EnvParams(horizon=jnp.int32(self.horizon))

    def check_installed(self) -> None:  # noqa: B027  # most need none
        """Raises ``ImportError``, naming what to install, if a library that its steps need is missing."""

    @abc.abstractmethod
    def resample_layout(
        self, key: Key[Array, ""], layout: Layout, needed: Bool[Array, ""], params: EnvParams
    ) -> Layout:
        """A layout that differs from ``layout`` where ``needed`` (bool ``[]``) is true, else ``layout`` itself.

        Written so that under ``vmap`` a step at which no episode ends costs (nearly) nothing.
        """

    @abc.abstractmethod
    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> Layout:
        """A random layout; ``vmap`` over keys for a pool."""

    @abc.abstractmethod
    def check_layout(self, layout: Layout) -> None:
        """Raises ``ValueError`` if a given layout (numpy) cannot be used; shapes and dtypes are taken as right."""

    @abc.abstractmethod
    def reset_to(self, layout: Layout, key: Key[Array, ""], params: EnvParams) -> tuple[Float32[Array, "..."], State]:
        """Starts an episode in a given layout: ``(observation, state)``."""

    @abc.abstractmethod
    def step_env(
        self, key: Key[Array, ""], state: State, action: Int[Array, ""] | Float[Array, " A"], params: EnvParams
    ) -> StepResult:
        """One raw step, without auto-reset.

        Actions are not checked: numbers beyond a box count as its nearest, and a NaN goes into the state and stays.

        Returns:
            ``(observation, state, reward, terminated, truncated, info)``: reward float32 ``[]``, ``terminated``
            and ``truncated`` bool ``[]``. Values bootstrap on truncation, never on termination.
        """

    @abc.abstractmethod
    def labels(self, state: State, params: EnvParams) -> Bool[Array, " P"]:
        """The propositions that hold in a state, bool ``[P]``."""

    @abc.abstractmethod
    def observation(self, state: State, params: EnvParams) -> Float32[Array, "..."]:
        """What the agent sees, float32 ``observation_shape``."""

    @abc.abstractmethod
    def proposition_view(
        self, observation: Float32[Array, "..."]
    ) -> tuple[Float32[Array, "P ..."], Float32[Array, " F0"]]:
        """Splits an observation into what belongs to each proposition and what is shared by all.

        Returns:
            ``(per_proposition, shared)``: float32 ``[P, ...]`` and float32 ``[F0]`` (may be empty).
        """

    def reset(self, key: Key[Array, ""], params: EnvParams) -> tuple[Float32[Array, "..."], State]:
        """Starts an episode in a new layout: ``(observation, state)``."""
        layout_key, start_key = jax.random.split(key)
        return self.reset_to(self.sample_layout(layout_key, params), start_key, params)

    def step(
        self, key: Key[Array, ""], state: State, action: Int[Array, ""] | Float[Array, " A"], params: EnvParams
    ) -> StepResult:
        """:meth:`step_env` with auto-reset into a layout that differs from the one that ended.

        Where the episode ended, the returned observation and state are the next episode's first ones, and
        ``info["final_observation"]`` is what the step led to; elsewhere it equals the observation.
        """
        step_key, layout_key, start_key = jax.random.split(key, 3)
        final_observation, stepped, reward, terminated, truncated, info = self.step_env(step_key, state, action, params)
        done = terminated | truncated
        layout = self.resample_layout(layout_key, stepped.layout, done, params)
        fresh_observation, fresh = self.reset_to(layout, start_key, params)
        observation = jnp.where(done, fresh_observation, final_observation)
        state = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, stepped)
        info = {**info, "final_observation": final_observation}
        return observation, state, reward, terminated, truncated, info


class Symmetric(Environment):
    """An environment that stays the same when all that is seen is turned or reflected, and actions with it."""

    @property
    @abc.abstractmethod
    def symmetries(self) -> Symmetries | Reflections | None:
        """How observations and actions are turned or reflected; ``None`` for sizes at which nothing can be."""


class FiniteGraph(Environment):
    """An environment that is a finite labelled graph with deterministic steps, for exact solvers."""

    @abc.abstractmethod
    def transition_table(
        self, layout: Layout, params: EnvParams
    ) -> tuple[Int32[Array, "S A"], Bool[Array, "S P"], Int32[Array, ""]]:
        """The graph of a layout.

        Returns:
            ``(successors int32 [S, A], labels bool [S, P], start int32 [])``: the state that each action leads to, the
            propositions that hold in each state, and the state in which episodes begin.
        """

    @abc.abstractmethod
    def graph_state(self, state: State) -> Int32[Array, ""]:
        """Which of the S states of :meth:`transition_table` the environment is in, int32 ``[]``."""


class GridMap(Environment):
    """An environment in the plane whose whole steps lead from places of a grid to their neighbours, or nowhere."""

    @abc.abstractmethod
    def grid(self, layout: Layout) -> tuple[Bool[np.ndarray, "X Y P"], Bool[np.ndarray, "X Y"], Int[np.ndarray, " 2"]]:
        """The places that whole steps lead to. On the host.

        Args:
            layout: unbatched, numpy leaves.

        Returns:
            ``(labels bool [X, Y, P], inside bool [X, Y], start int [2])``: the propositions that hold in each place,
            whether it may be entered, and the place where episodes begin.
        """


class ContestedLayouts(Environment):
    """An environment that draws layouts on which the nearest goal is often not the one to begin with."""

    @abc.abstractmethod
    def contested_layout(
        self, key: Key[Array, ""], first: Bool[Array, " P"], second: Bool[Array, " P"], params: EnvParams
    ) -> Layout:
        """A random layout for the task "first, then second" on which going to the nearest first costs steps later.

        Args:
            key: consumed.
            first: bool ``[P]``, what is to be reached first.
            second: bool ``[P]``, what is to be reached after it.
            params: of the environment.

        Returns:
            An unbatched layout; one of :meth:`sample_layout` where the task is not of two different propositions.
        """


class ContestedChoice(Environment):
    """An environment that knows how long the ways over the instances of a goal are; for those without an exact solver.

    Of each proposition there are I instances.
    """

    @property
    @abc.abstractmethod
    def contested_pairs(self) -> tuple[tuple[int, int], ...]:
        """Indices of (first, second) propositions that a choice between instances can be about."""

    @property
    @abc.abstractmethod
    def least_detour(self) -> float:
        """How much longer a way is that counts as longer, in the unit of `ways`."""

    @abc.abstractmethod
    def ways(
        self, layout: Layout, first: Bool[Array, " P"], second: Bool[Array, " P"]
    ) -> tuple[Float32[Array, " I"], Float32[Array, " I"]]:
        """How far the instances of one goal are, and how long the whole way is over each and on to another goal.

        Args:
            layout: unbatched.
            first: one-hot bool ``[P]``, what is to be reached first.
            second: one-hot bool ``[P]``, what is to be reached after it.

        Returns:
            Two float32 ``[I]``; a way that leads over another instance of the first goal is infinitely long.
        """

    @abc.abstractmethod
    def instance_at(self, state: State, goal: Bool[Array, " P"]) -> Int32[Array, ""]:
        """Which instance of a proposition (``goal``, one-hot bool ``[P]``) the agent is nearest to, int32 ``[]``."""


class Drawable(Environment):
    """An environment that can be drawn from above."""

    @abc.abstractmethod
    def scene(self, layout: Layout) -> Scene:
        """What there is to see in an unbatched layout (numpy leaves) besides the agent. On the host."""

    @abc.abstractmethod
    def position(self, state: State) -> Shaped[Array, " _"]:
        """Where the agent is, in the scene's coordinates, ``[2]``, or ``[3]`` with its heading in radians."""


@dataclasses.dataclass(frozen=True)
class Thing:
    """Something in a layout that can be moved.

    Attributes:
        name: the proposition that it stands for; empty for the agent, where it starts.
        place: in the scene's coordinates.
    """

    name: str
    place: tuple[float, float]


class Rearrangeable(Drawable):
    """An environment whose layouts can be changed by hand."""

    @abc.abstractmethod
    def things(self, layout: Layout) -> tuple[Thing, ...]:
        """What can be moved in an unbatched layout (numpy leaves). On the host."""

    @abc.abstractmethod
    def rearranged(self, layout: Layout, places: Float[np.ndarray, "_ 2"]) -> Layout:
        """The same layout (numpy leaves) with its things elsewhere. On the host.

        Args:
            layout: unbatched, numpy leaves.
            places: finite, in the scene's coordinates, one for each thing in the order of :meth:`things`.

        Raises:
            ValueError: they cannot lie there.
        """
