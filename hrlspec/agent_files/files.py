"""An agent as two files, ``NAME.safetensors`` and ``NAME.json``: writing them, finding them, reading them."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hrlspec.agent.agent import Agent
from hrlspec.agent.low_level import Params
from hrlspec.agent_files.card import FORMAT, LICENCE, AgentFileError, Card, read_card
from hrlspec.checkpoint.leaves import Kind, flatten, kind_of, path_name
from hrlspec.config import Checked, Config, ConfigError, from_plain
from hrlspec.methods import METHODS, Method
from hrlspec.presets import Preset, Recipe, RewardSet, find_preset
from hrlspec.tasks.rewards import RewardMachine

PACKAGED = Path(__file__).parent / "packaged"
"""The agents that come along."""
_LARGEST = 2**28  # bytes
_TRAINING = {"begun_from", "curriculum", "evaluation", "low", "optimiser", "ppo", "relabel"}
_DEEPEST, _WIDEST = 256, 65_536  # layers or rounds, each of which is traced, and features


@dataclasses.dataclass(frozen=True)
class AgentFile:
    """An agent in a file, without its parameters: see `read_params`.

    Attributes:
        card: what the file says.
        path: of the parameters.
        preset: the environment with what belongs to it.
        agent: the networks.
        reward_set: of the rewards that it was trained with.
        seed: that it was trained with.
    """

    card: Card
    path: Path
    preset: Preset
    agent: Agent
    reward_set: RewardSet
    seed: int

    @property
    def rewards(self) -> RewardMachine:
        """The rewards that it was trained with."""
        return self.preset.rewards(self.reward_set)


def acts(name: str) -> bool:
    """Whether the setting of a dotted name tells how an agent acts, and not only how it is trained."""
    return _TRAINING.isdisjoint(name.split("."))


def packaged_agents() -> tuple[str, ...]:
    """The names of the agents that come along."""
    return tuple(sorted(file.stem for file in PACKAGED.glob("*.json")))


def read_agent(name: str | os.PathLike[str]) -> AgentFile:
    """Finds an agent and reads its card.

    Args:
        name: of a packaged agent, or the path of a ``.safetensors`` file with its card beside it, or of the card.

    Raises:
        AgentFileError: there is none, or it is not of this version, or its settings cannot be meant.
        ImportError: a library that its environment needs is missing.
    """
    path = _found(name)
    card = read_card(path.with_suffix(".json"))
    try:
        origin = _origin(card.config)
        preset = find_preset(origin.env)
        assert preset is not None
        env = preset.make()
        env.check_installed()
        agent = Agent(env, origin.config, origin.method_settings)
    except ValueError as error:
        raise AgentFileError(path.with_suffix(".json"), error) from None
    return AgentFile(card, path, preset, agent, origin.reward_set, origin.seed)


def read_params(file: AgentFile) -> Params:
    """The parameters of an agent, float32 leaves as its settings ask for.

    Raises:
        AgentFileError: the file does not match its SHA-256, or holds other leaves, or one that is not finite.
        ImportError: there is no safetensors.
    """
    safetensors, path = _library(), file.path
    try:
        if path.stat().st_size > _LARGEST:
            raise AgentFileError(path, f"it is larger than {_LARGEST} bytes")
        content = path.read_bytes()
    except OSError as error:
        raise AgentFileError(path, error.strerror) from error
    if hashlib.sha256(content).hexdigest() != file.card.sha256:
        raise AgentFileError(path, "it does not match the SHA-256 in its card: one of them was changed or cut off")
    try:
        found = safetensors.numpy.load(content)
    except (safetensors.SafetensorError, KeyError, ValueError) as error:
        raise AgentFileError(path, f"it holds no parameters in safetensors: {error}") from None
    with_paths, structure = jax.tree_util.tree_flatten_with_path(_shapes(file.agent))
    wanted = {path_name(place): kind_of(path_name(place), leaf) for place, leaf in with_paths}
    _check_fit(path, {name: Kind("array", leaf.dtype.name, leaf.shape) for name, leaf in found.items()}, wanted)
    for name in wanted:
        if not np.isfinite(found[name]).all():
            raise AgentFileError(path, f"{name!r} holds values that are not finite")
    params: Params = jax.tree_util.tree_unflatten(structure, [found[name] for name in wanted])
    return jax.device_put(params)


def write_agent(
    file: Path,
    agent: Agent,
    params: Params,
    *,
    config: Mapping[str, Any],
    env_steps: int,
    trained: Mapping[str, Any],
    evaluated: Mapping[str, Any],
    results: Mapping[str, Any],
    success_at_least: Mapping[str, float],
) -> Card:
    """Writes an agent's parameters and its card, replacing those there.

    Args:
        file: ends in ``.safetensors``.
        agent: the networks.
        params: what of them acting needs is kept, see `Agent.acting`.
        config: as in `Card`, and so are the others.

    Raises:
        OSError: the system says no.
        ImportError: there is no safetensors.
    """
    leaves = {name: leaf.value for name, leaf in flatten(agent.acting(params)).items()}
    content = _library().numpy.save({name: value for name, value in leaves.items() if isinstance(value, np.ndarray)})
    card = Card(
        format=FORMAT,
        file=file.name,
        sha256=hashlib.sha256(content).hexdigest(),
        licence=LICENCE,
        config=config,
        env_steps=env_steps,
        trained=trained,
        evaluated=evaluated,
        results=results,
        success_at_least=success_at_least,
    )
    # The card comes last: until then the one before refuses the new parameters.
    for place, written in ((file, content), (file.with_suffix(".json"), card.text().encode())):
        scratch = place.with_name(f".{place.name}.new")
        scratch.write_bytes(written)
        scratch.replace(place)
    return card


@dataclasses.dataclass(frozen=True)
class _Origin(Checked):
    """What of a run's settings makes the agent, under the names of ``config.json``."""

    env: str
    method: str
    recipe: Recipe
    reward_set: RewardSet
    seed: int
    config: Config
    method_settings: Method


def _origin(record: Mapping[str, Any]) -> _Origin:
    """The settings of a card.

    Raises:
        ValueError: one is missing, unknown, or cannot be meant; or the environment or the method is none of ours.
    """
    env, method = record.get("env"), record.get("method")
    if not isinstance(env, str) or find_preset(env) is None:
        raise ConfigError(f"it is of the environment {env!r}, which is none of hrlspec's")
    if not isinstance(method, str) or method not in METHODS:
        raise ConfigError(f"it is of the method {method!r}, which is none of hrlspec's")
    _check_size(record, "")
    example = _Origin("", "", "hrlspec", 1, 0, Config(), METHODS[method])
    return from_plain(example, {name: value for name, value in record.items() if acts(name)}, needed=acts)


def _check_size(settings: Any, name: str) -> None:
    """Refuses networks that would take for ever to set up: what is long, wide, or has many rounds.

    Raises:
        ConfigError: naming the setting.
    """
    if isinstance(settings, Mapping):
        for inner, value in settings.items():
            _check_size(value, f"{name}.{inner}".lstrip("."))
        return
    several = settings if isinstance(settings, list) else [settings]
    of_networks = [value for value in several if isinstance(value, int) and ".network." in name]
    most = _DEEPEST if name.endswith(("rounds", "lookahead", "memory")) else _WIDEST
    for size, limit in ((len(several), _DEEPEST), (max(of_networks, default=0), most)):
        if size > limit:
            raise ConfigError(f"the setting {name} asks for {size}, expected {limit} at most")


def _library() -> Any:
    """The library that reads and writes parameters.

    Raises:
        ImportError: it is missing.
    """
    try:
        import safetensors.numpy
    except ImportError as error:
        raise ImportError('agents in files need the extra "files": pip install "hrlspec[files]"') from error
    return safetensors


@functools.cache
def _shapes(agent: Agent) -> Params:
    """Shapes and types of what acting needs; not to be changed."""
    shapes: Params = agent.acting(jax.eval_shape(agent.init, jax.random.key(0)))
    return shapes


def _found(name: str | os.PathLike[str]) -> Path:
    """Where the parameters are."""
    if str(name) in packaged_agents():
        return PACKAGED / f"{name}.safetensors"
    path = Path(name)
    if path.suffix not in (".safetensors", ".json"):
        known = ", ".join(packaged_agents())
        raise AgentFileError(path, f"expected one of the packaged agents ({known}), or a file in .safetensors")
    return path.with_suffix(".safetensors")


def _check_fit(path: Path, found: Mapping[str, Kind], wanted: Mapping[str, Kind]) -> None:
    """Refuses other leaves than the settings ask for."""
    differences = [
        f"{name!r} is {found.get(name, 'missing')}, expected {wanted.get(name, 'nothing of that name')}"
        for name in sorted(found.keys() | wanted.keys())
        if found.get(name) != wanted.get(name)
    ]
    if differences:
        more = f" ({len(differences) - 1} more leaves differ)" if len(differences) > 1 else ""
        raise AgentFileError(path, f"it does not fit its settings: {differences[0]}{more}")
