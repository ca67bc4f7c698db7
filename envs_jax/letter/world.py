"""Letter: an n×n torus with lettered cells, seen from the agent's own cell.

Axes: **n** rows and columns, **P** letters (the propositions), **S** = n·n cells, **A** = 4 moves.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import string

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int, Int8, Int32, Key, Shaped, UInt32

from envs_jax.arrays import Array
from envs_jax.base import (
    Box,
    ContestedLayouts,
    Discrete,
    EnvParams,
    FiniteGraph,
    Rearrangeable,
    StepResult,
    Symmetric,
    Symmetries,
    Thing,
    at_most_one,
)
from envs_jax.letter.contested import most_contested, myopia_regret
from envs_jax.scenes import GridScene

NO_LETTER = -1
MOVES = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]], np.int32)
"""Row and column offsets of the actions: up, down, left, right."""

MOST_ROWS = 32
"""A row of cells is kept in one 32-bit word while layouts are checked."""

CONTESTED_TRIES = 8
"""Pairs of letters among which a contested layout is chosen: the more, the more often nearest-first loses."""

LEAST_ACCEPTANCE = 0.01
"""Sizes are refused when fewer random layouts than this share have all letters reachable."""


@struct.dataclass
class LetterState:
    """A running episode.

    Attributes:
        position: int32 ``[2]``, row and column of the agent.
        layout: int8 ``[n, n]``, the letter of each cell, ``NO_LETTER`` for none.
        time: int32 ``[]``, steps taken.
    """

    position: Int32[Array, "*lead 2"]
    layout: Int8[Array, "*lead n n"]
    time: Int32[Array, "*lead"]


@dataclasses.dataclass(frozen=True)
class Letter(Symmetric, FiniteGraph, ContestedLayouts, Rearrangeable):
    """The Letter world.

    Layout: int8 ``[n, n]``; ``num_cells / num_letters`` cells for each letter, placed uniformly over the cells
    other than (0, 0) and drawn anew until every letter has a cell that can be reached from (0, 0) over
    letter-free cells. Start: (0, 0). Observation: float32 ``[n, n, P + 1]`` of zeros and ones, the agent in the
    middle cell ``(n // 2, n // 2)``, channel i the cells of letter i, the last channel the agent. Action: 0 up
    (row - 1), 1 down, 2 left, 3 right, modulo n. Reward: 0. Never terminated; truncated after ``horizon`` steps.

    Attributes:
        size: n.
        num_letters: P, at most 26.
        num_cells: cells that bear a letter, a multiple of ``num_letters``.
        horizon: steps in an episode.
        name: the preset's name.

    Raises:
        ValueError: if the sizes do not fit together or leave letters out of reach nearly always.
    """

    size: int = 7
    num_letters: int = 5
    num_cells: int = 10
    horizon: int = 75
    name: str = "letter"

    def __post_init__(self) -> None:
        if not 2 <= self.size <= MOST_ROWS:
            raise ValueError(f"Letter: size is {self.size}, expected 2 to {MOST_ROWS}")
        if not 1 <= self.num_letters <= len(string.ascii_lowercase):
            raise ValueError(f"Letter: num_letters is {self.num_letters}, expected 1 to 26")
        if self.num_cells < self.num_letters or self.num_cells % self.num_letters:
            raise ValueError(
                f"Letter: num_cells is {self.num_cells}, expected a multiple of num_letters = {self.num_letters}"
            )
        if self.num_cells >= self.size**2:
            raise ValueError(
                f"Letter: num_cells is {self.num_cells}, expected fewer than the {self.size**2} cells of the grid"
            )
        if self.horizon < 1:
            raise ValueError(f"Letter: horizon is {self.horizon}, expected at least 1")
        if _acceptance(self.size, self.num_letters, self.num_cells) < LEAST_ACCEPTANCE:
            raise ValueError(
                f"Letter: {self.num_cells} lettered cells on a {self.size}×{self.size} grid leave some of "
                f"{self.num_letters} letters out of reach nearly always; use fewer cells or a larger grid"
            )

    @property
    def propositions(self) -> tuple[str, ...]:
        """``('a', 'b', ...)``."""
        return tuple(string.ascii_lowercase[: self.num_letters])

    @property
    def possible_labels(self) -> tuple[frozenset[str], ...]:
        """A cell has one letter at most."""
        return at_most_one(self.propositions)

    @property
    def num_actions(self) -> int:
        """A = 4."""
        return len(MOVES)

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """``(n, n, P + 1)``."""
        return (self.size, self.size, self.num_letters + 1)

    @property
    def observation_space(self) -> Box:
        """Zeros and ones."""
        return Box(low=0.0, high=1.0, shape=self.observation_shape)

    @property
    def action_space(self) -> Discrete:
        """Up, down, left, right."""
        return Discrete(n=self.num_actions)

    @functools.cached_property
    def symmetries(self) -> Symmetries | None:
        """The eight turns and reflections of a grid whose middle cell is the agent's; of odd sizes only."""
        if self.size % 2 == 0:
            return None
        actions = []
        for axes, rows, columns in itertools.product(([0, 1], [1, 0]), (1, -1), (1, -1)):
            turned = MOVES[:, axes] * np.array([rows, columns])
            actions.append(tuple(int(np.flatnonzero((move == MOVES).all(1))[0]) for move in turned))
        return Symmetries(actions=tuple(actions))

    def sample_layout(self, key: Key[Array, ""], params: EnvParams) -> Int8[Array, "n n"]:
        """A random layout, int8 ``[n, n]``: uniform over those in which every letter can be reached."""
        nothing = jnp.full((self.size, self.size), NO_LETTER, jnp.int8)
        return self.resample_layout(key, nothing, jnp.bool_(True), params)

    def contested_layout(
        self, key: Key[Array, ""], first: Bool[Array, " P"], second: Bool[Array, " P"], params: EnvParams
    ) -> Int8[Array, "n n"]:
        """A random layout for a task that wants one letter and then another, chosen for what nearest-first would lose.

        The letters of a random layout trade places, so that the pair of letters on which nearest-first loses most,
        among ``CONTESTED_TRIES`` random pairs, becomes the pair wanted.

        Args:
            key: consumed.
            first: bool ``[P]``, the letter wanted first; if it is empty any layout will do.
            second: bool ``[P]``, the letter wanted after it; likewise.
            params: unused here.
        """
        layout_key, pair_key = jax.random.split(key)
        layout = self.sample_layout(layout_key, params)
        if self.num_letters < 2:
            return layout
        pair = most_contested(pair_key, myopia_regret(layout, self.num_letters), CONTESTED_TRIES)
        name = jnp.arange(self.num_letters, dtype=jnp.int32)
        for found, wanted in zip(pair, (jnp.argmax(first), jnp.argmax(second)), strict=True):
            found = name[found]  # it may have been renamed by the first exchange
            name = jnp.where(name == found, wanted, jnp.where(name == wanted, found, name))
        renamed = jnp.where(layout == NO_LETTER, NO_LETTER, name[layout]).astype(jnp.int8)
        return jnp.where(first.any() & second.any(), renamed, layout)

    def resample_layout(
        self, key: Key[Array, ""], layout: Int[Array, "n n"], needed: Bool[Array, ""], params: EnvParams
    ) -> Int8[Array, "n n"]:
        """A random layout other than ``layout`` where ``needed``, else ``layout``.

        The loop starts out finished where nothing is needed: a vmapped step at which no episode ends draws nothing.
        """
        del params
        previous = layout

        def draw(carry: tuple[Array, Array, Array]) -> tuple[Key[Array, ""], Int8[Array, "n n"], Bool[Array, ""]]:
            key, _, _ = carry
            key, draw_key = jax.random.split(key)
            candidate = self._place_letters(draw_key)
            return key, candidate, self._all_reachable(candidate) & (candidate != previous).any()

        return jax.lax.while_loop(lambda carry: ~carry[2], draw, (key, layout, ~needed))[1]

    def check_layout(self, layout: Int[np.ndarray, "n n"]) -> None:
        """Raises ``ValueError`` unless cells hold known letters and (0, 0) holds none.

        Letter counts and reachability are not asked of given layouts: a hand-made one may break them on purpose.
        """
        if ((layout < NO_LETTER) | (layout >= self.num_letters)).any():
            raise ValueError(
                f"letter numbers from {layout.min()} to {layout.max()}, expected -1 to {self.num_letters - 1}"
            )
        if layout[0, 0] != NO_LETTER:
            raise ValueError("the start cell (0, 0) bears a letter")

    def reset_to(
        self, layout: Int[Array, "n n"], key: Key[Array, ""], params: EnvParams
    ) -> tuple[Float32[Array, "..."], LetterState]:
        """Starts at (0, 0) in a given layout (int ``[n, n]``)."""
        del key
        state = LetterState(
            position=jnp.zeros(2, jnp.int32), layout=jnp.asarray(layout).astype(jnp.int8), time=jnp.int32(0)
        )
        return self.observation(state, params), state

    def step_env(
        self, key: Key[Array, ""], state: LetterState, action: Int[Array, ""], params: EnvParams
    ) -> StepResult:
        """One move; see :meth:`Environment.step_env`."""
        del key
        state = LetterState(
            position=(state.position + jnp.asarray(MOVES)[action]) % self.size,
            layout=state.layout,
            time=state.time + 1,
        )
        truncated = state.time >= params.horizon
        return self.observation(state, params), state, jnp.float32(0.0), jnp.bool_(False), truncated, {}

    def labels(self, state: LetterState, params: EnvParams) -> Bool[Array, " P"]:
        """The letter of the agent's cell, bool ``[P]``, at most one of them true."""
        del params
        return state.layout[state.position[0], state.position[1]] == jnp.arange(self.num_letters, dtype=jnp.int32)

    def observation(self, state: LetterState, params: EnvParams) -> Float32[Array, "..."]:
        """The grid around the agent, float32 ``[n, n, P + 1]``."""
        del params
        offsets = np.arange(self.size) - self.size // 2
        rows = (state.position[0] + offsets) % self.size
        columns = (state.position[1] + offsets) % self.size
        seen = state.layout[rows[:, None], columns[None, :]]
        letters = seen[..., None] == jnp.arange(self.num_letters, dtype=jnp.int8)
        agent = np.zeros((self.size, self.size, 1), bool)
        agent[self.size // 2, self.size // 2] = True
        return jnp.concatenate([letters, agent], axis=-1).astype(jnp.float32)

    def proposition_view(
        self, observation: Float32[Array, "..."]
    ) -> tuple[Float32[Array, "P ..."], Float32[Array, " F0"]]:
        """Each letter's plane, float32 ``[P, n, n]``; nothing is shared (float32 ``[0]``).

        The agent's own plane is the same always, so it is left out.
        """
        return jnp.moveaxis(observation[..., : self.num_letters], -1, 0), jnp.zeros(0, jnp.float32)

    def transition_table(
        self, layout: Int[Array, "n n"], params: EnvParams
    ) -> tuple[Int32[Array, "S A"], Bool[Array, "S P"], Int32[Array, ""]]:
        """The world as a finite labelled graph, for exact solvers.

        Args:
            layout: int ``[n, n]``.
            params: unused here.

        Returns:
            ``(successors int32 [S, A], labels bool [S, P], start int32 [])``; cell (row, column) is state
            ``row * n + column``.
        """
        del params
        labels = jnp.asarray(layout).reshape(-1, 1) == jnp.arange(self.num_letters, dtype=jnp.int32)
        return jnp.asarray(_successors(self.size)), labels, jnp.int32(0)

    def graph_state(self, state: LetterState) -> Int32[Array, ""]:
        """The agent's cell as a state of :meth:`transition_table`, int32 ``[]``."""
        return state.position[0] * self.size + state.position[1]

    def scene(self, layout: Int[Array, "n n"]) -> GridScene:
        """The grid of letters."""
        letters = np.asarray(layout).tolist()
        return GridScene(tuple(tuple(self.propositions[i] if i >= 0 else "" for i in row) for row in letters))

    def position(self, state: LetterState) -> Shaped[Array, " _"]:
        """Row and column, int32 ``[2]``."""
        return state.position

    def things(self, layout: Int[np.ndarray, "n n"]) -> tuple[Thing, ...]:
        """The letters. The start is not among them: on a torus moving all letters is the same."""
        return tuple(Thing(self.propositions[layout[row, column]], (row, column)) for row, column in _lettered(layout))

    def rearranged(self, layout: Int[np.ndarray, "n n"], places: Float[np.ndarray, "_ 2"]) -> Int8[np.ndarray, "n n"]:
        """See :meth:`Rearrangeable.rearranged`; each letter has a cell for itself, and the start has none."""
        cells = places.astype(int)
        if not ((cells >= 0) & (cells < self.size)).all():
            raise ValueError(f"a letter lies outside of the grid of {self.size}×{self.size} cells")
        moved = np.full_like(layout, NO_LETTER)
        moved[tuple(cells.T)] = layout[tuple(_lettered(layout).T)]
        if (moved != NO_LETTER).sum() < len(cells):
            raise ValueError("two letters are in one cell")
        self.check_layout(moved)
        return moved

    def _place_letters(self, key: Key[Array, ""]) -> Int8[Array, "n n"]:
        """Letters on uniformly drawn cells other than (0, 0), int8 ``[n, n]``.

        The rank of a cell among random numbers says which letter it bears: comparisons only, since a sort
        inside a vmapped loop is slow on a CPU.
        """
        index = np.arange(self.size**2 - 1, dtype=np.uint32)
        low_bits = np.uint32(2 ** int(index[-1]).bit_length() - 1)
        # The cell's index in the low bits makes the numbers distinct.
        drawn = (jax.random.bits(key, index.shape, jnp.uint32) & ~low_bits) | index
        rank = (drawn[None, :] < drawn[:, None]).sum(-1, dtype=jnp.int32)
        letter = jnp.where(rank < self.num_cells, rank // (self.num_cells // self.num_letters), NO_LETTER)
        return (
            jnp.concatenate([jnp.full(1, NO_LETTER, jnp.int32), letter]).reshape(self.size, self.size).astype(jnp.int8)
        )

    def _all_reachable(self, layout: Int[Array, "n n"]) -> Bool[Array, ""]:
        """Whether each letter has a cell next to those reachable from (0, 0) over letter-free cells, bool ``[]``."""
        # A row is one word, a cell one bit: the fill is a handful of integer operations on n words.
        bit = jnp.uint32(1) << jnp.arange(self.size, dtype=jnp.uint32)
        free = jnp.where(layout == NO_LETTER, bit, jnp.uint32(0)).sum(-1, dtype=jnp.uint32)
        start = jnp.zeros(self.size, jnp.uint32).at[0].set(1)

        def spread(rows: UInt32[Array, " n"]) -> UInt32[Array, " n"]:
            left = ((rows << 1) | (rows >> (self.size - 1))) & jnp.uint32(2**self.size - 1)
            right = (rows >> 1) | ((rows & 1) << (self.size - 1))
            return rows | left | right | jnp.roll(rows, 1) | jnp.roll(rows, -1)

        def grow(carry: tuple[Array, Array]) -> tuple[UInt32[Array, " n"], UInt32[Array, " n"]]:
            reached, _ = carry
            # Four rounds a turn: the test for a fixed point costs more than a round.
            wider = reached
            for _ in range(4):
                wider = spread(wider) & free
            return wider, reached

        reached, _ = jax.lax.while_loop(
            lambda carry: (carry[0] != carry[1]).any(), grow, (start, jnp.zeros_like(start))
        )
        touched = (spread(reached)[:, None] & bit) != 0
        letters = jnp.arange(self.num_letters, dtype=layout.dtype)
        return ((layout[..., None] == letters) & touched[..., None]).any((0, 1)).all()


def _with_neighbours(cells: Bool[np.ndarray, "*lead n n"]) -> Bool[np.ndarray, "*lead n n"]:
    """The given cells and those one move away, bool ``[..., n, n]``."""
    rows = np.roll(cells, 1, -2) | np.roll(cells, -1, -2)
    columns = np.roll(cells, 1, -1) | np.roll(cells, -1, -1)
    return cells | rows | columns


def _lettered(layout: Int[np.ndarray, "n n"]) -> Int[np.ndarray, "_ 2"]:
    """Row and column of the cells that bear a letter."""
    return np.argwhere(layout != NO_LETTER)


def _successors(size: int) -> Int32[np.ndarray, "S A"]:
    """The cell each move leads to, int32 ``[S, A]``."""
    cells = np.stack(np.divmod(np.arange(size**2), size), -1)
    moved = (cells[:, None] + MOVES) % size
    return (moved[..., 0] * size + moved[..., 1]).astype(np.int32)


@functools.cache
def _acceptance(size: int, num_letters: int, num_cells: int, num_samples: int = 400) -> float:
    """Estimates the share of random layouts in which every letter can be reached (numpy, fixed seed)."""
    rng = np.random.default_rng(0)
    rank = np.argsort(rng.random((num_samples, size**2 - 1)), axis=-1)
    letter = np.where(rank < num_cells, rank // (num_cells // num_letters), NO_LETTER)
    layout = np.concatenate([np.full((num_samples, 1), NO_LETTER), letter], 1).reshape(-1, size, size)
    free = layout == NO_LETTER
    reached = np.zeros_like(free)
    reached[:, 0, 0] = True
    while not np.array_equal(wider := _with_neighbours(reached) & free, reached):
        reached = wider
    touched = _with_neighbours(reached)
    present = [((layout == i) & touched).any((1, 2)) for i in range(num_letters)]
    return float(np.mean(np.all(present, axis=0)))
