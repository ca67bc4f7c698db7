"""The README's Python runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_python_blocks_run() -> None:
    functions, gymnasium = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(functions.splitlines()) <= 25
    names: dict[str, object] = {}
    exec(compile(functions, str(README), "exec"), names)
    episodes = names["episodes"]
    assert episodes.success.shape == (8,)  # type: ignore[attr-defined]
    assert (episodes.steps >= 1).all()  # type: ignore[attr-defined]
    exec(compile(gymnasium, str(README), "exec"), names)
    assert names["info"]["status"] == "running"  # type: ignore[index]
