"""A file of an agent that was never trained, as small as it can be, and changed in every way."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors.numpy

from hrlspec.agent_files import write_agent
from hrlspec.run.circumstances import circumstances
from hrlspec.run.experiment import Experiment
from hrlspec.run.run_flags import experiments_of, parse_run
from tests.probes import random_params
from tests.run import tiny


def tiny_experiment(*flags: str) -> Experiment:
    """What a tiny run's flags give."""
    ((experiment, _),) = experiments_of(parse_run(tiny.arguments(Path("run"), *flags)))
    return experiment


def write_tiny(file: Path, experiment: Experiment | None = None) -> Any:
    """Writes an agent of random parameters, which are returned."""
    made = experiment or tiny_experiment()
    params = random_params(made.agent, 0)
    origin = {name: circumstances()[name] for name in ("commit", "versions")}
    write_agent(
        file,
        made.agent,
        params,
        config=json.loads(json.dumps(dataclasses.asdict(made))),
        env_steps=0,
        trained=origin,
        evaluated=origin,
        results={},
        success_at_least={},
    )
    return params


class Draft:
    """An agent's two files, to be changed before they are written again.

    Args:
        file: the parameters; a good agent.
    """

    def __init__(self, file: Path) -> None:
        self.file, self.card_file = file, file.with_suffix(".json")
        self.card: dict[str, Any] = json.loads(self.card_file.read_text())
        self.leaves: dict[str, np.ndarray] = safetensors.numpy.load_file(file)

    @property
    def some(self) -> str:
        """The name of a leaf with two axes of different length."""
        return next(name for name, x in self.leaves.items() if x.ndim == 2 and x.shape[0] != x.shape[1])

    @property
    def content(self) -> bytes:
        """The leaves as a file."""
        return safetensors.numpy.save(self.leaves)

    def write(self, content: bytes | None = None, card: str | bytes | None = None) -> None:
        """Writes both; the card has the SHA-256 of what is written unless its text is given."""
        content = self.content if content is None else content
        self.file.write_bytes(content)
        text = json.dumps(self.card | {"sha256": hashlib.sha256(content).hexdigest()}) if card is None else card
        self.card_file.write_bytes(text if isinstance(text, bytes) else text.encode())

    def with_header(self, header: Any, body: bytes = b"") -> bytes:
        """A file in safetensors with any header."""
        text = header if isinstance(header, bytes) else json.dumps(header).encode()
        return len(text).to_bytes(8, "little") + text + body


def same(left: Any, right: Any) -> bool:
    """Whether two trees of arrays are the same to the bit."""
    pairs = jax.tree.map(lambda x, y: np.asarray(x).tobytes() == np.asarray(y).tobytes(), left, right)
    return all(jax.tree.leaves(pairs))
