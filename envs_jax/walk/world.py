"""Walk: a point in a square with round regions, of which only its own position is observed.

Axes: **P** propositions, **K** discs of a proposition, **X**, **Y** places of a grid of steps.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int, Int32, Key, Shaped

from envs_jax.arrays import Array
from envs_jax.base import Box, EnvParams, GridMap, Rearrangeable, StepResult, Thing
from envs_jax.scenes import DiscScene, Region

NO_DISC = -1.0
"""Radius of the entries that pad a proposition with fewer discs than others."""

MOST_DRAWS = 1000
"""Random layouts drawn before sizes are refused."""

LEAST_FREE = 0.01
"""Worlds with random starts are refused when less of the square is free: starts are drawn until one is."""

Disc = tuple[str, float, float, float]
"""A proposition, the centre's x and y, the radius; lengths in the world's units."""

PAPER_DISCS: tuple[Disc, ...] = (
    ("a", 5.1, 3.1, 1.0),
    ("b", 8.5, 4.0, 1.0),
    ("c", 8.6, -0.3, 1.0),
    ("d", 1.5, 8.8, 1.0),
    ("e", 0.4, 4.4, 1.0),
)
"""The paper's figure."""

FLATWORLD_DISCS: tuple[Disc, ...] = (
    ("aqua", 0.8, 0.2, 0.3),
    ("blue", 0.1, 0.0, 0.8),
    ("green", 0.7, 0.7, 0.5),
    ("green", 1.5, -0.75, 0.4),
    ("magenta", -1.1, 1.1, 0.5),
    ("orange", -1.53, -0.5, 0.32),
    ("red", -1.4, 0.55, 0.4),
    ("red", 0.5, -1.3, 0.35),
    ("yellow", -1.0, -1.2, 0.3),
)
"""DeepLTL's FlatWorld: blue, green and aqua overlap pairwise, and so do red and magenta."""


@struct.dataclass
class WalkLayout:
    """Where regions lie and an episode starts, in the world's units.

    Attributes:
        start: float32 ``[2]``, x and y.
        discs: float32 ``[3, P, K]``: the centres' x, their y, the radii; ``NO_DISC`` as the radius of padding.
    """

    start: Float[Array, "*lead 2"]
    discs: Float[Array, "*lead 3 P K"]


@struct.dataclass
class WalkState:
    """A running episode.

    Attributes:
        position: float32 ``[2]``, x and y.
        layout: where it takes place.
        time: int32 ``[]``, steps taken.
    """

    position: Float32[Array, "*lead 2"]
    layout: WalkLayout
    time: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class Walk(GridMap, Rearrangeable):
    """The Walk world: a square, round regions that may overlap, a point that moves where it is told.

    Only the position is observed, so an agent has to learn where the regions are: they are the same in every episode
    of an environment, as in any world that shows no more than the position. ``layout_seed`` chooses them. What
    varies between episodes is the start, where it is random. Layouts given to ``reset_to`` may have other regions.

    Layout: :class:`WalkLayout`. Observation: float32 ``[2]``, the position. Action: float32 ``[2]`` in [-1, 1]
    (clipped to it); the point moves by ``step_size`` times the action and is kept within the square. Labels: a
    proposition holds within its discs, edges included; several may hold at once. Reward: 0. Terminated only where
    ``ends_outside``; truncated after ``horizon`` steps. Lengths are in the units of the square, which have no name;
    time is in steps.

    Attributes:
        discs: the regions; one disc or more for each proposition.
        low: left and lower side of the square.
        high: right and upper side.
        step_size: the farthest a step leads along x, and along y.
        start: where episodes begin; ``None``: anew each time, uniformly outside of all regions.
        ends_outside: a step over a side ends the episode as a failure, at the side.
        horizon: steps in an episode.
        layout_seed: ``None`` for the regions as in ``discs``; otherwise they are moved to random places within the
            square, radii kept, so that free ground leads to a place of each proposition where it holds alone.
        name: the preset's name.

    Raises:
        ValueError: if sizes do not fit together, or no such places are found.
    """

    discs: tuple[Disc, ...] = PAPER_DISCS
    low: float = -1.0
    high: float = 10.0
    step_size: float = 0.1
    start: tuple[float, float] | None = (0.0, 0.0)
    ends_outside: bool = False
    horizon: int = 300
    layout_seed: int | None = None
    name: str = "walk"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"Walk: the square goes from {self.low} to {self.high}, expected low < high")
        if not 0 < self.step_size < self.high - self.low:
            raise ValueError(f"Walk: step_size is {self.step_size}, expected more than 0 and less than the square")
        if self.horizon < 1:
            raise ValueError(f"Walk: horizon is {self.horizon}, expected at least 1")
        if self.layout_seed is not None and self.layout_seed < 0:
            raise ValueError(f"Walk: layout_seed is {self.layout_seed}, expected 0 or more")
        if not self.discs:
            raise ValueError("Walk: there are no regions, expected one disc at least")
        for name, *numbers in self.discs:
            if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or numbers[2] <= 0:
                raise ValueError(f"Walk: the disc of {name!r} is {numbers}, expected x, y and a radius above 0")
        try:
            layout = self._layout()
            if self.start is not None:
                self.check_layout(layout)
        except ValueError as error:
            raise ValueError(f"Walk: {error}") from error
        labels, inside, _ = self.grid(layout)
        free = float((inside & ~labels.any(-1)).mean())
        if self.start is None and free < LEAST_FREE:
            raise ValueError(f"Walk: {free:.1%} of the square are free of regions, expected {LEAST_FREE:.0%} or more")

    @property
    def propositions(self) -> tuple[str, ...]:
        """The discs' propositions in alphabetical order."""
        return tuple(sorted({name for name, *_ in self.discs}))

    @property
    def possible_labels(self) -> tuple[frozenset[str], ...]:
        """Sets of propositions of which every two have discs that overlap."""
        discs = self._layout().discs
        regions = {name: discs[:, i, discs[2, i] > 0].T for i, name in enumerate(self.propositions)}
        apart = {
            frozenset({one, other})
            for one, other in itertools.combinations(regions, 2)
            if not any(math.dist(a[:2], b[:2]) < a[2] + b[2] for a in regions[one] for b in regions[other])
        }
        return tuple(label for label in super().possible_labels if not any(pair <= label for pair in apart))

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """``(2,)``."""
        return (2,)

    @property
    def observation_space(self) -> Box:
        """The square."""
        return Box(low=self.low, high=self.high, shape=(2,))

    @property
    def action_space(self) -> Box:
        """How far to go along x and y, as a share of ``step_size``."""
        return Box(low=-1.0, high=1.0, shape=(2,))

    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> WalkLayout:
        """The environment's regions, always the same, and a start."""
        return self.resample_layout(key, jax.tree.map(jnp.asarray, self._layout()), jnp.bool_(True), params)

    def resample_layout(
        self, key: Key[Array, ""], layout: WalkLayout, needed: Bool[Array, ""], params: EnvParams
    ) -> WalkLayout:
        """The same regions, since nothing shows where they are; another start where starts are random and ``needed``.

        The loop starts out finished where nothing is needed: a vmapped step at which no episode ends draws nothing.
        """
        del params
        if self.start is not None:
            return layout

        def draw(carry: tuple[Array, Array, Array]) -> tuple[Key[Array, ""], Float32[Array, " 2"], Bool[Array, ""]]:
            key, _, _ = carry
            key, draw_key = jax.random.split(key)
            candidate = self.observation_space.sample(draw_key)
            return key, candidate, ~_inside(layout.discs, candidate).any() & (candidate != layout.start).any()

        start = jax.lax.while_loop(lambda carry: ~carry[2], draw, (key, layout.start, ~needed))[1]
        return WalkLayout(start=start, discs=layout.discs)

    def check_layout(self, layout: WalkLayout) -> None:
        """Raises ``ValueError`` unless discs have a size, propositions a disc, and the start lies free in the square.

        Whether regions can be reached is not asked of given layouts: a hand-made one may be impossible on purpose.
        """
        radius, start = np.asarray(layout.discs)[2], np.asarray(layout.start)
        if not np.isfinite(layout.discs).all() or not ((radius > 0) | (radius == NO_DISC)).all():
            raise ValueError(f"radii {radius.tolist()}, expected finite numbers above 0, or {NO_DISC:g} for no disc")
        missing = [name for name, some in zip(self.propositions, (radius > 0).any(-1), strict=True) if not some]
        if missing:
            raise ValueError(f"there is no disc for {', '.join(missing)}")
        if not ((start >= self.low) & (start <= self.high)).all():
            raise ValueError(f"the start {start.tolist()} is outside of the square from {self.low} to {self.high}")
        held = _labels(layout.discs, start)
        if held.any():
            names = [name for name, holds in zip(self.propositions, held, strict=True) if holds]
            raise ValueError(f"the start {start.tolist()} is in the region of {', '.join(names)}")

    def reset_to(
        self, layout: WalkLayout, key: Key[Array, ""], params: EnvParams
    ) -> tuple[Float32[Array, "..."], WalkState]:
        """Starts at the start of a given layout."""
        del key
        layout = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layout)
        state = WalkState(position=layout.start, layout=layout, time=jnp.int32(0))
        return self.observation(state, params), state

    def step_env(
        self, key: Key[Array, ""], state: WalkState, action: Float[Array, " A"], params: EnvParams
    ) -> StepResult:
        """One step; see :meth:`Environment.step_env`."""
        del key
        moved = state.position + jnp.float32(self.step_size) * jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        position = jnp.clip(moved, self.low, self.high)
        state = WalkState(position=position, layout=state.layout, time=state.time + 1)
        out = (moved[0] != position[0]) | (moved[1] != position[1]) if self.ends_outside else jnp.bool_(False)
        truncated = state.time >= params.horizon
        return self.observation(state, params), state, jnp.float32(0.0), out, truncated, {}

    def labels(self, state: WalkState, params: EnvParams) -> Bool[Array, " P"]:
        """The regions that the point is in, bool ``[P]``."""
        del params
        return _inside(state.layout.discs, state.position)

    def observation(self, state: WalkState, params: EnvParams) -> Float32[Array, "..."]:
        """The position, float32 ``[2]``."""
        del params
        return state.position

    def proposition_view(
        self, observation: Float32[Array, "..."]
    ) -> tuple[Float32[Array, "P ..."], Float32[Array, " F0"]]:
        """Nothing is seen of any proposition (float32 ``[P, 0]``); shared is the position, scaled to [-1, 1]."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        shared = (observation - jnp.float32(middle)) * jnp.float32(1 / half)
        return jnp.zeros((self.num_propositions, 0), jnp.float32), shared

    def grid(
        self, layout: WalkLayout
    ) -> tuple[Bool[np.ndarray, "X Y P"], Bool[np.ndarray, "X Y"], Int[np.ndarray, " 2"]]:
        """The places that whole steps lead to, for planners: a grid of ``step_size`` through the start. On the host.

        A step leads to any of the eight neighbours or nowhere, so the way between two places takes exactly as many
        steps as it takes the point.

        Returns:
            ``(labels bool [X, Y, P], inside bool [X, Y], start int [2])``: the propositions that hold in each place,
            whether it lies in the square, and the start's place.
        """
        origin = np.asarray(layout.start, np.float64)
        tolerance = 1e-4  # in steps: float32 coordinates must not decide whether a side of the square is a place
        behind = np.floor((origin - self.low) / self.step_size + tolerance)
        size = math.floor((self.high - self.low) / self.step_size + tolerance) + 1
        x, y = (at + self.step_size * (np.arange(size) - steps) for at, steps in zip(origin, behind, strict=True))
        edge = self.high + tolerance * self.step_size
        places = np.stack(np.meshgrid(x, y, indexing="ij"), -1)
        return _labels(layout.discs, places), (x <= edge)[:, None] & (y <= edge), behind.astype(int)

    def scene(self, layout: WalkLayout) -> DiscScene:
        """The regions in the square."""
        discs = np.asarray(layout.discs)
        regions = [
            Region(name, *(float(number) for number in discs[:, i, k]))
            for i, name in enumerate(self.propositions)
            for k in range(discs.shape[2])
            if discs[2, i, k] > 0
        ]
        return DiscScene(tuple(regions), self.low, self.high)

    def position(self, state: WalkState) -> Shaped[Array, " _"]:
        """The point, float32 ``[2]``, x and y."""
        return state.position

    def things(self, layout: WalkLayout) -> tuple[Thing, ...]:
        """The start alone: an agent knows by heart where the regions are."""
        x, y = np.asarray(layout.start).tolist()
        return (Thing("", (x, y)),)

    def rearranged(self, layout: WalkLayout, places: Float[np.ndarray, "_ 2"]) -> WalkLayout:
        """See :meth:`Rearrangeable.rearranged`; the start must be free ground."""
        moved = WalkLayout(start=places[0].astype(np.float32), discs=layout.discs)
        self.check_layout(moved)
        return moved

    def _layout(self) -> WalkLayout:
        """The environment's own layout (numpy), with the square's corner for a start that is still to be drawn."""
        start = (self.low, self.low) if self.start is None else self.start
        return WalkLayout(start=np.asarray(start, np.float32), discs=_regions(self))  # type: ignore[arg-type]


def _inside(discs: Float32[Array, "3 P K"], position: Float32[Array, " 2"]) -> Bool[Array, " P"]:
    """The propositions that hold at a position ``[2]``, bool ``[P]``."""
    # Sums of products and few discs in turn: a reduction would leave the compiler's fast path for loops.
    dx, dy, radius = discs[0] - position[0], discs[1] - position[1], discs[2]
    within = dx * dx + dy * dy <= radius * jnp.abs(radius)  # A negative radius holds nothing.
    return functools.reduce(jnp.logical_or, [within[:, k] for k in range(within.shape[1])])


def _labels(discs: Float[Array, "3 P K"], places: Float[np.ndarray, "*lead 2"]) -> Bool[np.ndarray, "*lead P"]:
    """The propositions that hold at places ``[..., 2]``, bool ``[..., P]``, in double precision."""
    x, y, radius = np.asarray(discs, np.float64)
    distance = np.hypot(x - places[..., None, None, 0], y - places[..., None, None, 1])
    # float32 centres and radii: a place on the edge by the decimal numbers counts as inside.
    within = (distance <= radius + 1e-6) & (radius > 0)
    return np.asarray(within.any(-1))


@functools.cache
def _regions(env: Walk) -> Float32[np.ndarray, "3 P K"]:
    """The environment's discs, float32 ``[3, P, K]``."""
    grouped = [[disc[1:] for disc in env.discs if disc[0] == name] for name in env.propositions]
    discs = np.full((3, len(grouped), max(map(len, grouped))), NO_DISC, np.float32)
    for i, some in enumerate(grouped):
        discs[:, i, : len(some)] = np.transpose(some)
    if env.layout_seed is None:
        return discs
    rng = np.random.default_rng(env.layout_seed)
    radius = discs[2].clip(0)
    if 2 * radius.max() > env.high - env.low:
        raise ValueError(f"a disc of radius {radius.max():g} does not fit into the square")
    for _ in range(MOST_DRAWS):
        moved = discs.copy()
        moved[:2] = rng.uniform(env.low + radius, env.high - radius, (2, *radius.shape))
        if _all_alone(env, moved):
            return moved
    raise ValueError(f"no random layout of {MOST_DRAWS} lets every region be reached over free ground and hold alone")


def _all_alone(env: Walk, discs: Float[np.ndarray, "3 P K"]) -> bool:
    """Whether from every start each proposition can be had alone, with room to stand, over ground without any."""
    from scipy import ndimage  # for random regions alone; half a second to import

    start = (env.low, env.low) if env.start is None else env.start
    labels, inside, place = env.grid(WalkLayout(start=np.asarray(start), discs=discs))  # type: ignore[arg-type]
    block = np.ones((3, 3), bool)
    pieces, number = ndimage.label(inside & ~labels.any(-1), block)
    piece = 1 if env.start is None else pieces[tuple(place)]
    if piece == 0 or (env.start is None and number != 1):
        return False
    ground = pieces == piece
    for own in np.moveaxis(labels, -1, 0):
        alone = own & inside & (labels.sum(-1) == 1)
        reached = ndimage.binary_propagation(ground, block, mask=ground | alone)
        if not (ndimage.binary_erosion(alone, block) & reached).any():
            return False
    return True


def flatworld(**overrides: Any) -> Walk:
    """DeepLTL's FlatWorld: [-2, 2]², nine circles of seven colours, random starts, leaving the square is a failure.

    A step leads at most 0.08 along each axis; 500 steps. The peer's square ends an episode with -1 and shows a
    position beyond the side; here rewards come from tasks, and the position stops at the side.
    """
    sizes: dict[str, Any] = {
        "discs": FLATWORLD_DISCS,
        "low": -2.0,
        "high": 2.0,
        "step_size": 0.08,
        "start": None,
        "ends_outside": True,
        "horizon": 500,
        "name": "flatworld",
    }
    return Walk(**(sizes | overrides))
