"""What one of several processes on a machine has to itself: an accelerator, or its share of the cores."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

_TETHERED = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM)
if os.getppid() != int(sys.argv[1]):
    sys.exit(130)
os.execv(sys.executable, [sys.executable, *sys.argv[2:]])
"""
"""PR_SET_PDEATHSIG stays with a process when another program takes its place."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a process runs.

    Attributes:
        variables: added to its environment variables.
        cores: CPU cores that it is bound to, since unbound runs wait for each other's threads; all if empty.
    """

    variables: Mapping[str, str] = dataclasses.field(default_factory=dict)
    cores: Sequence[int] = ()

    def start(self, command: Sequence[str], **how: Any) -> subprocess.Popen[bytes]:
        """Starts a process there.

        Args:
            command: its arguments.
            **how: as for ``subprocess.Popen``.
        """
        process = subprocess.Popen(command, env=os.environ | self.variables, **how)
        if sys.platform == "linux" and self.cores:
            with contextlib.suppress(ProcessLookupError):  # it has failed already
                os.sched_setaffinity(process.pid, self.cores)
        return process


def tethered(command: Sequence[str]) -> list[str]:
    """A Python command that is asked to stop (SIGTERM) when the thread that starts it ends, however it ends; on Linux.

    Args:
        command: its arguments, the first of them this process's Python.
    """
    if sys.platform != "linux":
        return [*command]
    return [command[0], "-ISc", _TETHERED, str(os.getpid()), *command[1:]]


def places(jobs: int | None) -> list[Place]:
    """An accelerator for each of the processes side by side, or else its share of the CPU cores.

    Args:
        jobs: how many; one for each accelerator or core if ``None``.
    """
    if jobs is None or jobs > 1:
        # Another process asks, since asking takes hold of the devices.
        code = "import jax; print(jax.default_backend(), jax.device_count())"
        said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout.split()
        if len(said) == 2 and said[0] == "gpu":
            count = int(said[1])
            return [Place({"CUDA_VISIBLE_DEVICES": str(i % count)}) for i in range(jobs or count)]
    if sys.platform != "linux":  # cores cannot be chosen
        return [Place() for _ in range(jobs or os.cpu_count() or 1)]
    cores = sorted(os.sched_getaffinity(0))
    jobs = jobs or len(cores)
    return [Place(cores=cores[i % len(cores) :: jobs]) for i in range(jobs)]


@contextlib.contextmanager
def held_cores(number: int) -> Iterator[list[int]]:
    """So many cores of this machine that no other process has by this function; none where not as many are free.

    The system takes them back however the process ends.
    """
    with contextlib.ExitStack() as held:
        yield _free_cores(number, held) if sys.platform == "linux" else []


def _free_cores(number: int, held: contextlib.ExitStack) -> list[int]:
    """Locks one file for each core, until ``held`` ends."""
    import fcntl

    folder = Path(tempfile.gettempdir()) / f"hrlspec-cores-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    own = dict[int, Any]()
    with contextlib.ExitStack() as locks, (folder / "all").open("a") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)  # or two that ask at once would get half each
        for core in sorted(os.sched_getaffinity(0)):
            file = (folder / str(core)).open("a")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.close()
                continue
            own[core] = locks.enter_context(file)
            if len(own) == number:
                held.push(locks.pop_all())
                return [*own]
    return []
