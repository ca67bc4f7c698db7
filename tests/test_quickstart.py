"""docs/quickstart.ipynb, the notebook: what is kept in it is what running it shows.

Kept anew, with the extra ``docs``, by ``jupyter nbconvert --to notebook --execute --inplace
--ExecutePreprocessor.record_timing=False docs/quickstart.ipynb``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "docs" / "quickstart.ipynb"
MEASURED = "measured"
"""Tag of the cells whose numbers depend on the processor, and on how much is trained."""
SHORTER = """{
    "total_steps": 1_024,
    "num_envs": 16,
    "low.optimiser.minibatches": 8,
    "relabel.share": 0.0,
    "network.symmetric": False,
}"""
"""One iteration of a smaller program: compiling it is what takes the time."""


def kept() -> Any:
    return nbformat.read(NOTEBOOK, as_version=4)


def code(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def shown(cell: Any) -> list[tuple[str, str]]:
    """What a cell prints and draws: kinds and texts, without what the libraries tell on the error stream."""
    found = []
    for output in cell.outputs:
        if output.output_type == "stream":
            found += [(output.name, output.text)] if output.name == "stdout" else []
        else:
            found += [(kind, "" if kind.startswith("image/") else text) for kind, text in sorted(output.data.items())]
    if MEASURED in cell.metadata.get("tags", []):
        return [(kind, re.sub(r"\d+(\.\d+)?", "0", text)) for kind, text in found]
    return found


def test_it_is_kept_as_it_was_run() -> None:
    notebook, cells = kept(), code(kept())
    nbformat.validate(notebook)
    assert NOTEBOOK.stat().st_size < 300_000
    assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)]
    outputs = [output for cell in cells for output in cell.outputs]
    assert {output.get("name", output.output_type) for output in outputs} <= {"stdout", "display_data"}
    texts = [cell.source for cell in notebook.cells] + [text for cell in cells for _, text in shown(cell)]
    assert not [text for text in texts if re.search(r"""(^|[\s"'`(=])(/\w|~/|[A-Z]:\\)""", text, re.MULTILINE)]
    drawn = [cell for cell in cells if any(kind.startswith("image/") for kind, _ in shown(cell))]
    assert len(drawn) == 2
    assert all(cell.metadata["alt"] for cell in drawn)
    assert "execution" not in str([cell.metadata for cell in cells])  # when it ran says nothing to the reader


@pytest.mark.slow
def test_running_it_shows_what_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MPLBACKEND", raising=False)  # else nothing is drawn into the page
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    for variable in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(variable, str(tmp_path / variable))
    notebook = kept()
    (cell,) = (cell for cell in code(notebook) if "total_steps" in cell.source)
    cell.source, count = re.subn(r'\{"total_steps": [\d_]+\}', SHORTER, cell.source)
    assert count == 1
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    for before, after in zip(code(kept()), code(notebook), strict=True):
        assert shown(after) == shown(before), after.source
