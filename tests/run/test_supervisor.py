"""Processes kept going, with others than training in their place; `tests/run/test_hosts.py` is the real thing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hrlspec.run import signals, supervisor
from hrlspec.run.hosts import LOST
from hrlspec.run.supervisor import Watch, supervise

ROOT = Path(__file__).parents[2]
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="signals and /proc as on Linux")

# A process: it writes its number into a file, then does what it was told for this try.
PROCESS = """
import os, signal, sys, time
from pathlib import Path
from hrlspec.run.heartbeat import answer_supervisor
from hrlspec.run.signals import polled_signals
folder, index, kinds, tries = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3].split("/"), int(sys.argv[4])
with polled_signals() as stop:
    answer_supervisor()
    (folder / f"{index}-{tries}").write_text(str(os.getpid()))
    kind = kinds[min(tries, len(kinds) - 1)]
    if kind.lstrip("-").isdigit():
        time.sleep(0.2)
        os.kill(os.getpid(), -int(kind)) if int(kind) < 0 else sys.exit(int(kind))
    stop.wait(60)
    sys.exit(130 if stop else 0)
"""


class Group:
    """Two such processes under a supervisor."""

    def __init__(self, folder: Path, kinds: tuple[str, str], reached: Callable[[], object] = lambda: 0) -> None:
        self._folder, self._kinds, self._reached = folder, kinds, reached
        self.said: list[str] = []
        self.again: list[bool] = []

    def run(self, restarts: int = 3) -> int:
        def commands(again: bool) -> list[list[str]]:
            self.again.append(again)
            return [
                [sys.executable, "-c", PROCESS, str(self._folder), str(index), kinds, str(len(self.again) - 1)]
                for index, kinds in enumerate(self._kinds)
            ]

        return supervise(commands, reached=self._reached, restarts=restarts, patience=60, say=self.said.append)

    def pids(self) -> list[int]:
        """Of all processes that there were."""
        return [int(file.read_text()) for file in sorted(self._folder.iterdir()) if file.read_text()]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "_LONGEST_DELAY", 0.01)
    monkeypatch.setattr(supervisor, "_PARTING_SECONDS", 0.3)
    monkeypatch.setattr(supervisor, "_ORDERLY_SECONDS", 0.6)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_all_done(tmp_path: Path) -> None:
    group = Group(tmp_path, ("0", "0"))
    assert (group.run(), group.said) == (0, [])


@pytest.mark.parametrize("status", [1, 2, 130])
def test_what_would_fail_again_is_not_tried_again(tmp_path: Path, status: int) -> None:
    group = Group(tmp_path, ("wait", str(status)))
    assert (group.run(), group.said, group.again) == (status, [], [False])
    assert not any(map(alive, group.pids()))


def test_who_lost_the_others_is_not_to_blame(tmp_path: Path) -> None:
    """All begin again. The first try ends one process by a signal, the second has only lost ones."""
    group = Group(tmp_path, (f"{LOST}/{LOST}/0", "-9/wait/0"))
    assert group.run() == 0
    assert group.again == [False, True, True]
    assert [line.partition(";")[0] for line in group.said] == [
        "process 1 ended by SIGKILL",
        "process 0 lost the others",
    ]
    assert not any(map(alive, group.pids()))


def test_given_up(tmp_path: Path) -> None:
    group = Group(tmp_path, ("-9", "wait"))
    assert group.run(restarts=1) == 1
    assert group.said[-1].startswith("error: process 0 ended by SIGKILL; given up after 1 restarts; --resume ")
    assert len(group.again) == 2


def test_who_gets_further_may_fail_as_often_as_it_likes(tmp_path: Path) -> None:
    steps = iter(range(100))
    group = Group(tmp_path, ("-9/-9/-9/0", "wait/wait/wait/0"), lambda: next(steps))
    assert group.run(restarts=1) == 0
    assert len(group.again) == 4


@LINUX
def test_a_process_that_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "SILENCE_SECONDS", 2.0)
    group = Group(tmp_path, (f"{-signal.SIGSTOP}/0", "wait/0"))
    assert group.run() == 0
    assert group.said[0].startswith("process 0 has not answered for ")
    assert not any(map(alive, group.pids()))


@pytest.mark.parametrize("to", ["supervisor", "process", "all"])
def test_a_signal_to_whomever_stops_all(tmp_path: Path, to: str) -> None:
    """Once, whoever else gets it; a second one would end them at once."""
    group = Group(tmp_path, ("wait", "wait"))

    def send() -> None:
        while len(pids := group.pids()) < 2:
            time.sleep(0.02)
        chosen = {"supervisor": [], "process": pids[:1], "all": pids}[to]
        for pid in chosen if to == "process" else [*chosen, os.getpid()]:
            os.kill(pid, signal.SIGTERM)

    sender = threading.Thread(target=send)
    sender.start()
    assert (group.run(), group.said, group.again) == (130, [], [False])
    sender.join()
    assert not any(map(alive, group.pids()))


SUPERVISOR = """
import sys
from tests.run.test_supervisor import Group
from pathlib import Path
Group(Path(sys.argv[1]), ("wait", f"{-19}")).run()
"""


@LINUX
def test_when_the_supervisor_is_gone_so_are_the_processes(tmp_path: Path) -> None:
    """One of them is stopped."""
    group = Group(tmp_path, ("", ""))
    with subprocess.Popen([sys.executable, "-c", SUPERVISOR, str(tmp_path)], cwd=ROOT) as process:
        while len(group.pids()) < 2:
            time.sleep(0.02)
        pids = group.pids()
        time.sleep(0.5)
        process.kill()
    end = time.monotonic() + 60
    while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < end:
        time.sleep(0.02)
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_signals_are_delivered_to_the_innermost_context() -> None:
    signals.deliver("SIGTERM")  # nobody is there
    with signals.polled_signals() as outer:
        with signals.polled_signals() as inner:
            signals.deliver("SIGTERM")
        assert (inner.signal_name, outer.signal_name) == ("SIGTERM", None)


def test_silence() -> None:
    watch = Watch(0.0, 1000.0)
    assert watch.complaint(99.0) is None  # it has not come so far
    watch.hear(99.0, 0, False)
    assert watch.complaint(99.0 + supervisor.LOADING_SECONDS) is None
    assert watch.complaint(100.0 + supervisor.SILENCE_SECONDS, stopped=True) == "has not answered for 6 s"
    assert watch.complaint(100.0 + supervisor.LOADING_SECONDS) == "has not answered for 16 s"
    watch.hear(200.0, 1, True)
    assert watch.complaint(200.0 + supervisor.SILENCE_SECONDS) is None
    assert watch.complaint(201.0 + supervisor.SILENCE_SECONDS) == "has not answered for 6 s"


def test_hanging() -> None:
    """Of iterations that take 1, 3 and 2 s; then an evaluation, whose time nobody knows."""
    watch, now = Watch(0.0, 100.0), 0.0

    def until(end: float, count: int, steady: bool) -> str | None:
        nonlocal now
        watch.hear(now, count, steady)
        while now < end and watch.complaint(now) is None:
            now += 0.5
            watch.hear(now, count, steady)
        return watch.complaint(now)

    assert until(90, 0, False) is None  # compiling
    for count, end in ((1, 91), (2, 94), (3, 96)):
        assert until(end, count, True) is None
    assert until(126, 4, True) is None  # the fourth may take ten times 3 s
    assert until(200, 4, True) == "has done nothing for 30 s"
    assert until(now + 100, 5, False) is None
    assert until(now + 100, 5, False) == "has done nothing for 100 s"


def test_cores_are_shared() -> None:
    assert supervisor._shares([3, 5], 2) == [[3], [5]]
    assert supervisor._shares([0, 1, 2], 1) == [[0, 1, 2]]
    assert supervisor._shares([0, 1, 2], 2) == [[0], [1]]
    assert supervisor._shares([0, 1], 3) == [[0, 1]] * 3
