"""The README's Python runs as it stands, but for the number of steps."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_python_blocks_run(capsys: pytest.CaptureFixture[str]) -> None:
    text = README.read_text()
    first, more, gymnasium = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert text.index("import hrlspec") < len("".join(text.splitlines(keepends=True)[:30]))
    assert len(text.splitlines()) <= 120
    shorter, count = re.subn(r"total_steps=2_500_000", "total_steps=8_192", first)
    assert count == 1
    names: dict[str, Any] = {}
    for code in (shorter, more, gymnasium):
        exec(compile(code, str(README), "exec", dont_inherit=True), names)
    assert 0 <= names["result"].total.success_rate.estimate <= 1
    assert names["agents"][1].params.keys() == names["trained"].params.keys()
    assert int(names["state"].iteration) == 1
    assert names["info"]["status"] == "running"
    assert "achieve " in capsys.readouterr().out  # the sampled action may have reached a
