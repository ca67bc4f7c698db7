"""Draws the test suites anew: ``hrlspec suites``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from hrlspec.presets import PRESETS
from hrlspec.presets.suites import hashes_file, hashes_text, suite_file, suite_texts
from hrlspec.run.errors import UserError
from hrlspec.run.flags import parse_flags


@dataclasses.dataclass(frozen=True)
class SuitesFlags:
    """Draws the test suites anew, byte for byte the same."""

    check: bool = False
    """Write nothing, only say whether the files are as drawn."""


def main(argv: Sequence[str], *, program: str = "hrlspec suites") -> None:
    """The command line.

    Raises:
        UserError: bad usage, or a file is not as drawn.
    """
    check = parse_flags(SuitesFlags, argv, program=program).check
    for preset in PRESETS.values():
        propositions = preset.make().propositions
        for name, text in suite_texts(preset.name, preset.suites, propositions).items():
            path = suite_file(preset.name, name)
            if not check:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8", newline="\n")
            elif not path.exists() or path.read_bytes() != text.encode():
                raise UserError(f"{path} is not what the sampler draws; write it again with `{program}`")
            print(f"{'as drawn' if check else 'written'}: {path}")
        if not check:
            text = hashes_text(preset.name, tuple(preset.suites), propositions)
            hashes_file(preset.name).write_text(text, encoding="utf-8", newline="\n")
