"""Settings that all methods share, as frozen dataclasses that validate themselves where they are made.

All fields are static: they shape the compiled program. What may change inside a run (parameters, counters, curriculum
level) lives in :class:`hrlspec.learning.train.TrainState`; what belongs to one method lives with it, in
``hrlspec/methods``; tuned values live in ``hrlspec/presets``.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Callable, Mapping
from types import UnionType
from typing import Any, Literal, TypeVar

S = TypeVar("S")
Effort = Literal["least", "little", "most"]
"""How much time the compiler may take; see `hrlspec.run.platform.compiler_options`."""
_WORDS = {int: "a whole number", float: "a number", bool: "True or False", str: "text", type(None): "None"}


class ConfigError(ValueError):
    """A setting that cannot be meant. The message names it, what was found and what was expected."""


def setting(default: Any, *, least: float = -math.inf, most: float = math.inf, later: bool = False) -> Any:
    """A field with a default.

    Args:
        default: its value where none is given.
        least, most: the range that the value, or each entry of a tuple, must lie in (bounds included).
        later: whether it came after records were kept, which may lack it: its default is what the code did before.
    """
    return dataclasses.field(default=default, metadata={"range": (least, most), "later": later})


class Checked:
    """Base of settings: a value of another type than its field's, or out of its range, is refused at once."""

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            least, most = field.metadata.get("range", (-math.inf, math.inf))
            found, hint = getattr(self, field.name), hints[field.name]
            if not _fits(found, hint):
                raise ConfigError(f"{type(self).__name__}.{field.name} is {found!r}, expected {_words(hint)}")
            for value in found if isinstance(found, tuple) else (found,):
                if isinstance(value, int | float) and not least <= value <= most:
                    bounds = (
                        f"at least {least:g}" if most == math.inf else f"a number from {least:g} to {_plainly(most)}"
                    )
                    raise ConfigError(f"{type(self).__name__}.{field.name} is {found}, expected {bounds}")


def _plainly(number: float) -> str:
    """Whole numbers with all of their digits."""
    return str(number) if isinstance(number, int) else f"{number:.10g}"


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of a type: a class, a union, a literal, or a tuple of such. Of other types anything is."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return any(_fits(value, argument) for argument in arguments)
    if origin is Literal:
        return value in arguments
    if origin is tuple:
        return isinstance(value, tuple) and all(_fits(entry, arguments[0]) for entry in value)
    if hint in (int, float):
        return isinstance(value, int if hint is int else int | float) and not isinstance(value, bool)
    return not isinstance(hint, type) or isinstance(value, hint)


def _words(hint: Any) -> str:
    """A type in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return " or ".join(map(_words, arguments))
    if origin is Literal:
        return "one of " + ", ".join(map(str, arguments))
    if origin is tuple:
        return f"a tuple, each entry {_words(arguments[0])}"
    return _WORDS.get(hint, getattr(hint, "__name__", str(hint)))


@dataclasses.dataclass(frozen=True)
class NetworkConfig(Checked):
    """Sizes of the networks (paper, "Low-level Architecture"); the encoder's are those of the planner's too."""

    latent: int = setting(64, least=1)
    """Width of the encoders' output."""
    conv_channels: tuple[int, ...] = setting((16, 32, 64), least=1)
    """Channels of the 2x2 convolutions for image observations; none: images are encoded as vectors."""
    encoder_mlp: tuple[int, ...] = setting((128, 128), least=1)
    """Hidden units of the encoder for vectors."""
    task_features: int = setting(32, least=1)
    """Node features of the low level's GNN over the remaining tasks."""
    task_rounds: int = setting(8, least=0)
    """Rounds of message passing of the low level's GNN. 0: one sweep from the leaves to the root, which looks ahead
    without limit and costs an eighth."""
    actor: tuple[int, ...] = setting((64, 64, 64), least=1)
    critic: tuple[int, ...] = setting((64, 64), least=1)
    critic_encoder: bool = setting(False, later=True)
    """Whether the critic has an encoder, and a chart, of its own, which learn for the value alone."""
    reach_critic: tuple[int, ...] = setting((64, 64), least=1)
    """Hidden units of the critic behind the shield."""
    roles: bool = False
    """Task-conditioned encoding: the low level sees the observation by role (the goal p+, the forbidden p-, what comes
    1, 2, ... sub-tasks later) instead of by name. Off encodes the observation without the task, as in the paper."""
    names: bool = False
    """Whether the low level sees the observation by role and by name: where rewards depend on propositions that have no
    role in the task."""
    symmetric: bool = False
    """Whether the low level sees the world in one of its turned or reflected forms alone: its goal in one sector, or,
    where vectors are reflected, its own motion forward; in environments that say how, seen by role. What is
    learned in one direction is then known in all."""
    task_scale: float = setting(4.0, least=1e-3, most=1e3)
    """Scale of the sub-task features that condition the low level: unscaled, a few binary features carry little weight
    beside a hundred of the latent. The embedding of the remaining task is not scaled, or it would outweigh the
    sub-task. Without a sub-task, conditioned on the whole task, the embedding is scaled."""
    chart: tuple[int, ...] = setting((), least=1, later=True)
    """Layers of a chart: a network from the shared part of the observation to features of each proposition, as many as
    the last width says, which the low level sees by role beside what the world shows. For worlds that show the position
    alone: what is learned of a region in front of one goal is known of it in front of all others. Empty: no chart."""
    waves: int = setting(0, least=0, most=16, later=True)
    """Octaves of sines and cosines that the chart sees beside the shared part itself, the longest 4 of its units long
    (Fourier features; Tancik et al., 2020). Without them it is slow to learn what differs over short distances."""
    forbidden: bool = setting(False, later=True)
    """Whether what violates the task has a role of its own. It is a part of p-, whose rest ends the sub-task alone."""
    exclusions: bool = setting(False, later=True)
    """Whether the low level counts what is never entered after what, and adds to p-, and to what is forbidden, what
    would so put its goal, or what is owed later, out of reach."""
    near: float = setting(0.0, least=0, most=1e6, later=True)
    """Reading of a sensor at which something is near, such as at the edge of a zone. Vectors are then seen once more as
    (reading / near)^8, by role those of the goal, p- and what is forbidden, which tells apart what is near: a lidar
    that fades by exp(-d) also as one that fades by exp(-8 d). 0: not."""
    lookahead: int = setting(2, least=0)
    """How many later sub-tasks have a role of their own."""
    memory: int = setting(0, least=0)
    """How many of the sub-tasks completed last the low level is conditioned on: where a reward depends on their order,
    so does the value of the remaining task."""


@dataclasses.dataclass(frozen=True)
class OptimiserConfig(Checked):
    """Adam on minibatches, behind a clip of the gradient's global norm."""

    learning_rate: float = setting(1e-3, least=0, most=1e6)
    final_learning_rate: float = setting(0.0, least=0, most=1e6)
    """What the learning rate comes to in the end, linearly."""
    epochs: int = setting(2, least=1)
    minibatches: int = setting(16, least=1)
    max_grad_norm: float = setting(0.5, least=1e-9, most=1e9)


@dataclasses.dataclass(frozen=True)
class PPOConfig(Checked):
    """Proximal policy optimisation at one level."""

    optimiser: OptimiserConfig = OptimiserConfig()
    clip: float = setting(0.2, least=0, most=1e6)
    dual_clip: float = setting(math.exp(10.0), least=1, most=1e9)
    """Largest probability ratio that counts where the advantage is negative (dual clip); 1.0 + ``clip`` or more."""
    entropy: float = setting(0.002, least=0, most=1e6)
    final_entropy: float = setting(0.002, least=0, most=1e6)
    entropy_floor: float = setting(0.0, least=0, most=1e6)
    """Mean entropy (nats) that the policy is kept near or above at first: below it the entropy's weight grows by twice
    what is missing. 0: none, as for Gaussians, whose entropy may be negative."""
    final_entropy_floor: float = setting(0.0, least=0, most=1e6)
    value_coefficient: float = setting(0.5, least=0, most=1e6)
    gae_lambda: float = setting(0.95, least=0, most=1)
    advantage_scale: float = setting(0.0, least=0, most=1e6)
    """r: the policy's advantages are divided by r + |V|, in units of the critic, so that tasks that pay little are
    learned like tasks that pay much. 0: as they are."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.dual_clip < 1 + self.clip:
            raise ConfigError(f"PPOConfig.dual_clip is {self.dual_clip}, expected at least 1 + clip, {1 + self.clip:g}")


@dataclasses.dataclass(frozen=True)
class CurriculumConfig(Checked):
    """Tasks to collect on (paper, "Training Curriculum")."""

    levels: int = setting(4, least=1)
    """K, the longest sequence."""
    promotion: float = setting(0.85, least=0, most=1)
    """Success rate that promotes to the next level."""
    window: int = setting(512, least=0)
    """Finished episodes of the current level over which it is measured."""
    earlier: float = setting(0.2, least=0, most=1)
    """Share of episodes on levels already passed."""
    tree_share: float = setting(0.0, least=0, most=1)
    """Share of random trees, instead of sequences, in each level's tasks."""
    contested: float = setting(0.0, least=0, most=1)
    """Share of episodes in layouts made to teach look-ahead, where nearest-first loses; in environments that are
    `envs_jax.ContestedLayouts`."""
    retry: float = setting(0.0, least=0, most=1, later=True)
    """Probability with which an episode that failed is begun again, the same task in the same layout. Rare ways to fail
    are then practised about as many times more as there are tries, 1 / (1 - retry) at most."""
    joint: float = setting(0.0, least=0, most=1)
    """Share of sub-tasks that ask for propositions at once, in worlds where some can hold together."""
    stay: float = setting(0.0, least=0, most=1, later=True)
    """Share of tasks that end with staying where they are completed. The low level is told by the goal lying ahead of
    itself."""
    hold_before_jump: int = setting(30, least=2, later=True)
    """Steps in a row for which the goal must hold first; whoever leaves tries again. An agent that is trained to stay
    commits itself to what is to hold for ever after as many."""
    longest_stay: int = setting(200, least=2, later=True)
    """Most steps for which it must hold then; whoever leaves has failed. The number is random, the least is 2."""
    max_branching: int = setting(3, least=1)
    max_avoid: int = setting(3, least=0)
    tasks_per_level: int = setting(512, least=1)
    """Rows of the bank for each level; the bank is drawn anew between chunks."""
    max_nodes: int = setting(16, least=2)
    """N, the padded size of training tasks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_nodes < self.levels + 2:
            raise ConfigError(
                f"CurriculumConfig.max_nodes is {self.max_nodes}, expected at least levels + 2, {self.levels + 2}"
            )


@dataclasses.dataclass(frozen=True)
class RelabelConfig(Checked):
    """Experience relabelling into random trees (paper, "Experience Replay")."""

    share: float = setting(0.5, least=0, most=1)
    """Share of the environments whose trajectories are trained on a second time, relabelled. 0 switches it off."""
    hindsight: bool = False
    """Whether every proposition visited counts as a completed sub-task, and not only those assigned."""
    branch: float = setting(0.7, least=0, most=1)
    """Probability of a random branch at each node of the completed path."""


@dataclasses.dataclass(frozen=True)
class ShieldConfig(Checked):
    """Proposition avoidance (paper, "Avoiding Propositions")."""

    enabled: bool = True
    """Whether actions near a forbidden proposition are replaced while collecting."""
    threshold: float = setting(0.9, least=0, most=1)
    """Nu: V(s, g) above it counts as near."""
    discount: float = setting(0.85, least=0, most=1)
    """Discount of the reach critic: its value is discount^(steps to g - 1)."""
    optimiser: OptimiserConfig = OptimiserConfig(final_learning_rate=1e-3, epochs=1, minibatches=8, max_grad_norm=1.0)


@dataclasses.dataclass(frozen=True)
class Config(Checked):
    """A training run, less its environment, method and rewards."""

    num_envs: int = setting(128, least=1)
    """E, environments stepped side by side."""
    num_steps: int = setting(64, least=2)
    """T, steps of a rollout."""
    blocks: int = setting(1, least=1)
    """G, equal parts of the environments. Each shuffles its own rows into minibatches, whose gradient is the mean over
    the parts; devices share them evenly, and what is learned does not depend on the number of devices."""
    total_steps: int = setting(3_000_000, least=1, most=2**40)
    discount: float = setting(0.94, least=0, most=1)
    """Gamma, per environment step, at both levels."""
    noise_correlation: float = setting(0.0, least=0, most=0.999)
    """Correlation of the noise of successive steps while collecting, for continuous actions: coloured noise explores
    farther than white noise, whose steps cancel out."""
    final_noise_correlation: float = setting(0.0, least=0, most=0.999)
    """What it comes to in the end, linearly. A policy trained with coloured noise to the end leaves it to the noise to
    get it out of where it hesitates, and stands still without."""
    steps_per_slot: int = setting(5, least=1)
    """A rollout tells T divided by this many episodes of an environment apart, two at least."""
    group: int = setting(32, least=1)
    """Environments the high level decides for at a time."""
    low: PPOConfig = PPOConfig()
    network: NetworkConfig = NetworkConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    relabel: RelabelConfig = RelabelConfig()
    shield: ShieldConfig = ShieldConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_envs % self.blocks:
            raise ConfigError(
                f"Config.blocks is {self.blocks}, expected a divisor of {self.num_envs}, the number of environments"
            )
        if self.curriculum.stay and not (self.network.roles and self.network.lookahead):
            found = f"Config.curriculum.stay is {self.curriculum.stay:g}"
            raise ConfigError(
                f"{found}, which asks for a low level that sees ahead: roles and a lookahead of at least 1"
            )
        of_a_block = "" if self.blocks == 1 else f" of each of {self.blocks} blocks"
        rows = self.envs_per_block + self.copies_per_block
        check_divides(
            "Config.low.optimiser.minibatches", self.low.optimiser, rows, f"environments and copies{of_a_block}"
        )
        if self.shield.enabled:
            what = f"environments{of_a_block}"
            check_divides("Config.shield.optimiser.minibatches", self.shield.optimiser, self.envs_per_block, what)

    @property
    def envs_per_block(self) -> int:
        """Environments of a block."""
        return self.num_envs // self.blocks

    @property
    def copies_per_block(self) -> int:
        """Environments of a block whose rollouts are relabelled in an iteration."""
        return round(self.relabel.share * self.envs_per_block)

    @property
    def steps_per_iteration(self) -> int:
        """E·T, environment steps of one iteration."""
        return self.num_envs * self.num_steps

    @property
    def episode_slots(self) -> int:
        """Episodes of one environment that a rollout tells apart; what comes after them is left out of the update."""
        return max(2, self.num_steps // self.steps_per_slot)

    @property
    def num_iterations(self) -> int:
        """Iterations that make up ``total_steps``, rounded up."""
        return -(-self.total_steps // self.steps_per_iteration)


def evolve(settings: S, changes: Mapping[str, Any]) -> S:
    """A copy of settings with changes, by dotted names, checked once all of them are made.

    ``evolve(config, {"num_envs": 64, "low.optimiser.learning_rate": 1e-3})``.

    Raises:
        ConfigError: there is no setting of that name, or a value cannot be meant.
    """
    known = [field.name for field in dataclasses.fields(settings)] if dataclasses.is_dataclass(settings) else []
    nested: dict[str, dict[str, Any]] = {}
    for name, value in changes.items():
        first, _, rest = name.partition(".")
        if first not in known:
            expected = f"expected one of: {', '.join(known)}" if known else "which has none"
            raise ConfigError(f"unknown setting {first!r} of {type(settings).__name__}, {expected}")
        nested.setdefault(first, {})[rest] = value
    values = {}
    for name, inner in nested.items():
        whole = inner.pop("", getattr(settings, name))
        values[name] = evolve(whole, inner) if inner else whole
    return dataclasses.replace(settings, **values)  # type: ignore[type-var]


def from_plain(example: S, data: Any, *, prefix: str = "", needed: Callable[[str], bool] = lambda name: True) -> S:
    """Settings from plain JSON values, as a record has them; lists become tuples.

    Args:
        example: settings of the same type, all the way down.
        data: a value for each of the settings, under its name.
        prefix: of their names, with its dot.
        needed: whether the setting of a dotted name must be there, unless it is a later one; another is the example's
            where it is missing.

    Raises:
        ConfigError: settings are missing or unknown, or a value is of another type or out of its range.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(f"{prefix.rstrip('.')} is {data!r}")
    known = dataclasses.fields(example)  # type: ignore[arg-type]
    data = {field.name: field.default for field in known if field.metadata.get("later")} | dict(data)
    fields = {field.name: getattr(example, field.name) for field in known}
    wrong = (data.keys() - fields) | {name for name in fields.keys() - data if needed(prefix + name)}
    if wrong:
        raise ConfigError(f"the setting {prefix + min(wrong)!r} is not in both")
    hints = typing.get_type_hints(type(example))
    return dataclasses.replace(  # type: ignore[type-var]
        example,
        **{
            name: from_plain(value, data[name], prefix=f"{prefix}{name}.", needed=needed)
            if dataclasses.is_dataclass(value)
            else _from_plain(hints[name], data[name], prefix + name)
            for name, value in fields.items()
            if name in data
        },
    )


def _from_plain(kind: Any, value: Any, name: str) -> Any:
    """A value of an annotated type from a plain JSON value."""
    origin, options = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and isinstance(value, list):
        return tuple(_from_plain(options[0], item, name) for item in value)
    if not _fits(value, kind):
        raise ConfigError(f"{name} is {value!r}")
    try:
        return float(value) if kind is float else value
    except OverflowError:
        raise ConfigError(f"{name} is too large") from None


def without_copies(config: Config) -> Config:
    """No relabelled copies; minibatches as large as with them, if the environments divide into such."""
    rows, minibatches = config.envs_per_block + config.copies_per_block, config.low.optimiser.minibatches
    fewer, rest = divmod(minibatches * config.envs_per_block, rows)
    kept = minibatches if rest or config.envs_per_block % fewer else fewer
    return evolve(config, {"relabel.share": 0.0, "low.optimiser.minibatches": kept})


def check_divides(name: str, optimiser: OptimiserConfig, rows: int, what: str) -> None:
    """Refuses minibatches that do not share their rows evenly.

    Raises:
        ConfigError: naming the setting, the rows and what they are.
    """
    if rows < optimiser.minibatches or rows % optimiser.minibatches:
        raise ConfigError(f"{name} is {optimiser.minibatches}, expected a divisor of {rows}, the number of {what}")
