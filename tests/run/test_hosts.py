"""One run in two processes, started by ``experiments.launch``: the run of one process, whatever is done to them."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from hrlspec import checkpoint
from hrlspec.run.folder import read_metrics
from hrlspec.run.hosts import local_address
from tests.run import tiny

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc"),
]

ROOT = Path(__file__).parents[2]
PATIENCE = 1800  # seconds; a busy machine may need most of it to compile


@pytest.fixture(scope="module", autouse=True)
def compiled_programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A compilation cache that the processes share."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(tmp_path_factory.mktemp("jax"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", folder)
        yield


def run_command(folder: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "experiments.run", *tiny.arguments(folder, "--checkpoint-minutes", "0", *more)]


class Process:
    """A command, and what it says, in files."""

    def __init__(self, command: Sequence[str], said: Path) -> None:
        said.mkdir(parents=True, exist_ok=True)
        self._files = [said / "out", said / "err"]
        with self._files[0].open("w") as out, self._files[1].open("w") as err:
            self.popen = subprocess.Popen(command, cwd=ROOT, stdout=out, stderr=err)
        self.pid = self.popen.pid

    @property
    def out(self) -> str:
        return self._files[0].read_text()

    @property
    def err(self) -> str:
        return self._files[1].read_text()

    def wait(self) -> int:
        return self.popen.wait(PATIENCE)

    def workers(self) -> list[int]:
        """The processes that it has started, in order."""
        found = {}
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError, ValueError, IndexError):
                if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == self.pid:
                    words = (entry / "cmdline").read_bytes().split(b"\0")
                    found[int(words[words.index(b"--process-id") + 1])] = int(entry.name)
        return [found[index] for index in sorted(found)]

    def wait_for_step(self, folder: Path, least: int) -> list[int]:
        """Waits for a checkpoint; returns the workers."""
        end = time.monotonic() + PATIENCE
        while not any(step >= least for step in checkpoint.steps(folder / "checkpoints")):
            assert self.popen.poll() is None, self.err
            assert time.monotonic() < end
            time.sleep(0.005)
        return self.workers()


@contextlib.contextmanager
def running(command: Sequence[str], said: Path) -> Iterator[Process]:
    process = Process(command, said)
    try:
        yield process
    finally:
        process.popen.kill()
        process.popen.wait()


@contextlib.contextmanager
def launched(folder: Path, *more: str) -> Iterator[Process]:
    arguments = run_command(folder, *more)[3:]
    command = [sys.executable, "-m", "experiments.launch", "-n", "2", "--", *arguments]
    with running(command, folder.parent / "said") as process:
        yield process


def gone(pids: Sequence[int]) -> bool:
    """Whether all of these end soon."""
    end = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def leaves(folder: Path) -> Any:
    """The SHA-256 of each leaf of the last checkpoint."""
    assert checkpoint.steps(folder / "checkpoints")[-1] == tiny.TOTAL
    return json.loads((folder / "checkpoints" / f"step_{tiny.TOTAL:012d}" / "manifest.json").read_text())["leaves"]


def assert_same(folder: Path, other: Path) -> None:
    """State, rows and results of two runs."""
    assert leaves(folder) == leaves(other)
    timeless = [
        [{k: v for k, v in row.items() if k not in ("wall_s", "train/steps_per_s")} for row in read_metrics(run)]
        for run in (folder, other)
    ]
    assert timeless[0] == timeless[1]
    assert [row["env_steps"] for row in timeless[0]] == [400, 800, 960]
    final = [json.loads((run / "summary.json").read_text())["final"] for run in (folder, other)]
    assert final[0] == final[1]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return in_one(tmp_path_factory.mktemp("alone") / "run")


def in_one(folder: Path, *more: str) -> Path:
    """The run in one process, on two devices."""
    with running(run_command(folder, "--devices", "2", *more), folder.parent / "said") as process:
        assert process.wait() == 0, process.err
    return folder


def test_two_processes_are_one_with_two_devices(alone: Path, tmp_path: Path) -> None:
    """Started by hand. The second one says nothing; it would read what it needs, and writes nothing."""
    folder = tmp_path / "run"
    together = ("--distributed", local_address(), "--num-processes", "2", "--process-id")
    with (
        running(run_command(folder, *together, "1"), tmp_path / "second") as second,
        running(run_command(folder, *together, "0"), tmp_path / "first") as first,
    ):
        assert first.wait() == 0, first.err
        assert second.wait() == 0, second.err
    assert (second.out, second.err) == ("", "")
    assert "results, curves and pictures" in first.out
    assert "Gloo" not in first.out
    assert_same(folder, alone)


def test_zone_too(tmp_path: Path) -> None:
    """Its physics comes with arrays of its own, which must be this process's."""
    with launched(tmp_path / "run", "--env", "zone") as launcher:
        assert launcher.wait() == 0, launcher.err
    assert_same(tmp_path / "run", in_one(tmp_path / "one" / "run", "--env", "zone"))


def test_a_longer_run_compiles_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice as many iterations and evaluations: nothing is compiled after warm-up, by the process that speaks."""
    monkeypatch.setenv("JAX_LOG_COMPILES", "1")
    compiled = []
    for times in (1, 2):
        folder = tmp_path / str(times) / "run"
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(folder.parent / "compiled"))
        with launched(folder, "--total-steps", str(times * tiny.TOTAL)) as launcher:
            assert launcher.wait() == 0, launcher.err
        words = launcher.err.split()
        compiled.append(sorted(after for word, after in itertools.pairwise(words) if word == "Compiling"))
    assert compiled[0]
    assert compiled[1] == compiled[0]


def test_a_signal_to_the_second_stops_both(alone: Path, tmp_path: Path) -> None:
    """As where a cluster takes one machine away."""
    folder = tmp_path / "run"
    together = ("--distributed", local_address(), "--num-processes", "2", "--process-id")
    with (
        running(run_command(folder, *together, "1"), tmp_path / "second") as second,
        running(run_command(folder, *together, "0"), tmp_path / "first") as first,
    ):
        first.wait_for_step(folder, 80)
        second.popen.send_signal(signal.SIGTERM)
        assert (first.wait(), second.wait()) == (130, 130)
    stopped = checkpoint.steps(folder / "checkpoints")[-1]
    assert stopped < tiny.TOTAL
    assert f"interrupted: a signal after {stopped} of {tiny.TOTAL} environment steps" in first.err
    assert (second.out, second.err) == ("", "")


def test_killed_and_stopped_it_ends_as_if_left_in_peace(alone: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with launched(folder) as launcher:
        for step, index, number in ((160, 1, signal.SIGKILL), (400, 0, signal.SIGKILL), (640, 1, signal.SIGSTOP)):
            workers = launcher.wait_for_step(folder, step)
            os.kill(workers[index], number)
            assert gone(workers)
        assert launcher.wait() == 0, launcher.err
    assert_same(folder, alone)
    said = [line for line in launcher.err.splitlines() if line.startswith("process ")]
    assert [line.partition(";")[0] for line in said[:2]] == [
        "process 1 ended by SIGKILL",
        "process 0 ended by SIGKILL",
    ]
    assert said[2].startswith("process 1 has not answered for ")
    assert len(said) == 3


def test_terminated_it_goes_on_in_one_process(alone: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with launched(folder) as launcher:
        workers = launcher.wait_for_step(folder, 160)
        for pid in (*workers, launcher.pid):
            os.kill(pid, signal.SIGTERM)
        assert launcher.wait() == 130
        assert gone(workers)
    (line,) = [line for line in launcher.err.splitlines() if "letter" not in line.partition(":")[0]]
    stopped = checkpoint.steps(folder / "checkpoints")[-1]
    assert line.startswith(f"interrupted: SIGTERM after {stopped} of {tiny.TOTAL} environment steps")
    with running(run_command(folder, "--resume"), tmp_path / "again") as process:
        assert process.wait() == 0, process.err
    assert_same(folder, alone)


def test_one_process_goes_on_in_two(alone: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with running(run_command(folder), tmp_path / "first") as process:
        process.wait_for_step(folder, 80)
        process.popen.send_signal(signal.SIGTERM)
        assert process.wait() == 130
    with launched(folder, "--resume") as launcher:
        assert launcher.wait() == 0, launcher.err
    assert "continuing after" in launcher.err
    assert_same(folder, alone)


@pytest.mark.parametrize("stopped", [False, True])
def test_without_the_launcher_nothing_goes_on(tmp_path: Path, stopped: bool) -> None:
    folder = tmp_path / "run"
    with launched(folder) as launcher:
        workers = launcher.wait_for_step(folder, 80)
        if stopped:
            os.kill(workers[1], signal.SIGSTOP)
        launcher.popen.kill()
        assert gone(workers)


def test_a_full_disk_ends_the_run(alone: Path, tmp_path: Path) -> None:
    """Which a limit on the size of files stands in for."""
    folder = tmp_path / "run"
    with launched(folder) as launcher:
        workers = launcher.wait_for_step(folder, 160)
        resource.prlimit(workers[0], resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        assert launcher.wait() == 1
        assert gone(workers)
    (line,) = [line for line in launcher.err.splitlines() if "letter" not in line.partition(":")[0]]
    last = checkpoint.steps(folder / "checkpoints")[-1]
    assert line.startswith(f"error: cannot write to {folder} at environment step ")
    assert f"File too large; the last checkpoint, in {folder}, is of step {last}" in line
    with launched(folder, "--resume") as launcher:
        assert launcher.wait() == 0, launcher.err
    assert_same(folder, alone)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--config.blocks 1", "--config.blocks is 1, expected a multiple of 2, the number of processes"),
        ("--devices 1", "--devices is 1, expected a multiple of 2, the number of processes"),
        ("--resume", "there is no run to resume in "),
        ("--config.blocks 0", "--config.blocks is 0, expected at least 1"),
        ("--distributed auto", "--distributed is what python -m experiments.launch gives"),
    ],
)
def test_what_the_user_can_mend_is_one_line(tmp_path: Path, flags: str, message: str) -> None:
    folder = tmp_path / "run"
    with launched(folder, *flags.split()) as launcher:
        assert launcher.wait() == 2
    assert launcher.err.startswith(f"error: {message}")
    assert launcher.err.count("\n") == 1
    assert not folder.exists()
