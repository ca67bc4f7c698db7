"""What processes on one machine have to themselves."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hrlspec.run.places import held_cores, places, tethered

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="cores cannot be chosen")


@ON_LINUX
def test_runs_side_by_side_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {2, 3, 5, 7})
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: subprocess.CompletedProcess(args, 0, "cpu 1", ""))
    shares = {jobs: [list(place.cores) for place in places(jobs)] for jobs in (None, 1, 2, 3, 6)}
    assert shares[None] == [[2], [3], [5], [7]]
    assert shares[1] == [[2, 3, 5, 7]]
    assert shares[2] == [[2, 5], [3, 7]]
    assert shares[3] == [[2, 7], [3], [5]]
    assert shares[6] == [[2], [3], [5], [7], [2], [3]]
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: subprocess.CompletedProcess(args, 0, "gpu 2", ""))
    assert [place.variables for place in places(3)] == [{"CUDA_VISIBLE_DEVICES": n} for n in "010"]


@ON_LINUX
def test_no_core_is_held_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {2, 3, 5, 7})
    with held_cores(1) as one, held_cores(2) as two:
        assert (one, two) == ([2], [3, 5])
        with held_cores(2) as more:  # there is one left
            assert more == []
        with held_cores(1) as last, held_cores(1) as nothing:
            assert (last, nothing) == ([7], [])
    with held_cores(4) as every:
        assert every == [2, 3, 5, 7]


TETHERS = """
import subprocess, sys
from hrlspec.run.places import tethered
child = "import signal; print('begun', flush=True); signal.sigwait([signal.SIGTERM]); print('asked', flush=True)"
blocked = "import signal; signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM]); signal.alarm(60); "
process = subprocess.Popen(tethered([sys.executable, "-c", blocked + child]), start_new_session=True)
process.wait()
"""
"""A process with another one on a tether, which says when it is asked to stop, and lives for a minute at most."""


@ON_LINUX
def test_who_is_tethered_is_asked_to_stop_when_its_parent_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", TETHERS], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "begun\n"
        parent.send_signal(signal.SIGKILL)
        assert parent.stdout.readline() == "asked\n"


def test_a_tethered_command_is_the_command() -> None:
    code = "import sys; print(sys.argv[1:]); sys.exit(3)"
    command = tethered([sys.executable, "-c", code, "a b", "--c"])
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "['a b', '--c']\n", "")
