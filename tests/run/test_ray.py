"""Sweeps on a Ray cluster: whatever ends early, all runs end as in a sweep that nothing disturbed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hrlspec import checkpoint
from hrlspec.run.folder import read_metrics, read_record, read_summary
from hrlspec.run.places import held_cores
from tests.run.tiny import FLAGS, PLANNER

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are not tethered"),
    pytest.mark.filterwarnings("default"),  # those of Ray
]
STEPS = 3_200
"""40 iterations, each with a checkpoint, so that there is time to disturb."""


def command(out: Path, *own: str, seeds: str = "0-3") -> list[str]:
    """Two cells of so many seeds."""
    shared = [*FLAGS, "--evaluation.every", "1600", *PLANNER, "--total-steps", str(STEPS), "--checkpoint-minutes", "0"]
    grid = ["--grid", "config.discount=0.9,0.95", "--seeds", seeds]
    return [sys.executable, "-m", "hrlspec.run.cli", "sweep", "--out", str(out), *grid, *own, "--", *shared]


def run_folders(out: Path) -> list[Path]:
    return sorted(path.parent for path in out.glob("*/*/config.json"))


def under_way(out: Path) -> list[Path]:
    """The runs that have done some of their iterations and not most of them."""
    done = {folder: checkpoint.steps(folder / "checkpoints")[-1:] for folder in run_folders(out)}
    return [folder for folder, steps in done.items() if steps and STEPS // 10 < steps[0] < STEPS // 2]


def outcome(folder: Path) -> dict[str, Any]:
    """What a run came to, without what depends on the clock: every leaf's hash, all numbers."""
    (newest,) = checkpoint.steps(folder / "checkpoints")[-1:]
    manifest = json.loads((folder / "checkpoints" / f"step_{newest:012d}" / "manifest.json").read_text())
    summary = read_summary(folder)
    assert summary is not None
    clocks = ("wall_s", "train/steps_per_s")
    rows = [{name: value for name, value in row.items() if name not in clocks} for row in read_metrics(folder)]
    return {"leaves": manifest["leaves"], "rows": rows, "steps": summary["env_steps"], "final": summary["final"]}


def wait_until(condition: Callable[[], object], process: subprocess.Popen[str]) -> None:
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sweep without Ray."""
    out = tmp_path_factory.mktemp("undisturbed")
    subprocess.run(command(out), check=True, capture_output=True)
    return out


def compare(out: Path, undisturbed: Path) -> int:
    """Compares all runs that are in a folder with those that nothing disturbed; how many there are."""
    folders = run_folders(out)
    for folder in folders:
        assert outcome(folder) == outcome(undisturbed / folder.relative_to(out)), folder
    return len(folders)


def disturbed(out: Path) -> list[Path]:
    """The runs that more than one process has made."""
    return [folder for folder in run_folders(out) if read_record(folder).get("earlier")]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes on this machine, with a core each."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    head = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 10**8}
    made = Cluster(initialize_head=True, head_node_args=head)
    try:
        yield made
    finally:
        made.shutdown()


def test_a_node_dies_in_the_middle(cluster: Any, undisturbed: Path, tmp_path: Path) -> None:
    node = cluster.add_node(num_cpus=1, object_store_memory=10**8)
    process = subprocess.Popen(
        command(tmp_path, "--ray", cluster.address), stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    wait_until(lambda: len(under_way(tmp_path)) == 2, process)
    cluster.remove_node(node, allow_graceful=False)
    out, err = process.communicate()
    assert process.returncode == 0, err
    assert "0.95" in out
    assert not any(word in err for word in ("Traceback", "Error", "WARNING", "failed")), err
    assert len(disturbed(tmp_path)) == 1
    assert compare(tmp_path, undisturbed) == 8
    assert (tmp_path / "results.json").read_text() == (undisturbed / "results.json").read_text()


def test_ctrl_c_and_on(undisturbed: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    ours = command(tmp_path, "--ray", "local", seeds="0")
    process = subprocess.Popen(ours, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
    wait_until(lambda: under_way(tmp_path), process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: Ray's own processes hear it, too
    out, err = process.communicate()
    assert (process.returncode, out) == (130, "")
    last = "interrupted: by SIGINT; the runs are saved in their folders, the same command goes on"
    assert err.splitlines()[-1] == last
    stopped = {folder: checkpoint.steps(folder / "checkpoints") for folder in run_folders(tmp_path)}
    with held_cores(len(os.sched_getaffinity(0))) as cores:  # nobody is left
        assert cores
    ended = subprocess.run(ours, capture_output=True, text=True, check=True)
    assert "2 runs, 2 of them missing" in ended.stderr
    assert {folder for folder, steps in stopped.items() if steps} <= {*disturbed(tmp_path)}
    assert compare(tmp_path, undisturbed) == 2


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--ray", "127.0.0.1:9"), "--ray 127.0.0.1:9: there is no such cluster"),
        (("--ray", "local", "--cores-per-run", "4096"), "a run is to have 4096 cores and 0 GPUs, but nodes have"),
    ],
)
def test_what_there_is_not(flags: tuple[str, ...], said: str, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    ended = subprocess.run(command(tmp_path, *flags), capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert said in ended.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())
