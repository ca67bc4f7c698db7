"""Runs on a Ray cluster: one run a task, with its cores or its part of a GPU.

A task is a Ray worker that starts the run's process and waits for it. When its node dies Ray starts the task anew on
another one, where the run goes on from its folder. So folders, and the code, lie on storage that all nodes share.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import signal
import socket
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import ray

from hrlspec.run import platform
from hrlspec.run.errors import UserError, in_words
from hrlspec.run.folder import is_being_written
from hrlspec.run.places import Place, held_cores
from hrlspec.run.planned import PlannedRun, problem_of, start_run

RETRIES = 10
"""Nodes that a run may lose."""
_HANDED_ON = ("JAX_", "XLA_", "PYTHONPATH")
"""Beginnings of the environment variables that runs get from here, not from where their node was started."""
_STORE_BYTES = 100 * 2**20  # near the least that Ray allows; nothing of size is sent
_MEMORY = 0.9  # of its part of a GPU that a run takes for itself
_ANSWER = 10.0  # seconds for a cluster to answer
_PATIENCE = 120.0  # seconds for the process before to let go of a folder


class RayEngine:
    """A Ray cluster, or one of this machine alone.

    Args:
        address: of the cluster; ``auto`` for the one that this machine belongs to, ``local`` for one that lasts as long
            as the engine.
        cores: CPU cores of a run.
        gpus: GPUs of a run, or its part of one; 0 for none.
    """

    def __init__(self, address: str, *, cores: int, gpus: float) -> None:
        self._address, self._cores, self._gpus = address, cores, gpus
        self._running: dict[ray.ObjectRef[int], PlannedRun] = {}

    def __enter__(self) -> Self:
        _check_address(self._address)
        before = signal.getsignal(signal.SIGTERM)
        how: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}
        if self._address == "local":
            how |= {"num_cpus": len(platform.cores()), "object_store_memory": _STORE_BYTES, "include_dashboard": False}
        try:
            ray.init(self._address, **how)
        except Exception as error:  # as many kinds as there are reasons
            raise UserError(f"--ray {self._address}: there is no such cluster ({in_words(error)})") from error
        finally:
            signal.signal(signal.SIGTERM, before)  # Ray has a handler of its own
        try:
            self._check_room()
            needs = ray.remote(num_cpus=self._cores, num_gpus=self._gpus, max_retries=RETRIES)
            self._task = needs(_carry_out)
        except BaseException:
            ray.shutdown()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        for reference in self._running:
            ray.cancel(reference)
        if self._running:
            ray.wait([*self._running], num_returns=len(self._running))
        ray.shutdown()

    def submit(self, run: PlannedRun) -> None:
        """Has Ray make the run when a node has room for it."""
        there = dataclasses.replace(run, folder=run.folder.absolute())
        variables = {name: value for name, value in os.environ.items() if name.startswith(_HANDED_ON)}
        variables |= _of_gpus(self._gpus, variables)
        self._running[self._task.remote(there, Path.cwd(), variables, self._cores)] = run

    def ended(self) -> list[tuple[PlannedRun, str | None]]:
        """The runs whose tasks have ended, for good."""
        if not self._running:
            return []
        done, _ = ray.wait([*self._running], num_returns=len(self._running), timeout=0)
        return [(self._running.pop(reference), _problem(reference)) for reference in done]

    def _check_room(self) -> None:
        """Refuses what no node will ever have room for, and Ray would wait for."""
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(node.get("CPU", 0) >= self._cores and node.get("GPU", 0) >= self._gpus for node in nodes):
            most = ", ".join(f"{node.get('CPU', 0):g} cores and {node.get('GPU', 0):g} GPUs" for node in nodes)
            wanted = f"{self._cores} cores and {self._gpus:g} GPUs"
            raise UserError(f"--ray {self._address}: a run is to have {wanted}, but nodes have {most}")


def _check_address(address: str) -> None:
    """Refuses an address where nobody answers, on which Ray would try for minutes.

    Raises:
        UserError: nobody does.
    """
    if address in ("auto", "local"):
        return
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=_ANSWER).close()
    except (OSError, ValueError, OverflowError) as error:
        expected = "expected auto, local, or HOST:PORT as ray start says it"
        raise UserError(f"--ray {address}: there is no such cluster, {expected} ({in_words(error)})") from error


def _of_gpus(gpus: float, given: Mapping[str, str]) -> dict[str, str]:
    """What JAX has to know, unless it is said already: that it has no GPU, or only a part of one."""
    said = {"JAX_PLATFORMS": "cpu"} if gpus == 0 else {}
    if 0 < gpus < 1:
        said["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{_MEMORY * gpus:.3f}"
    return {name: value for name, value in said.items() if name not in given}


def _problem(reference: ray.ObjectRef[int]) -> str | None:
    """What is said of a task that has ended."""
    try:
        return problem_of(ray.get(reference))
    except ray.exceptions.RayError as error:
        return in_words(error)


def _carry_out(run: PlannedRun, cwd: Path, variables: Mapping[str, str], cores: int) -> int:
    """Makes a run on the node where this is called, and returns its exit status."""
    _wait_for(run.folder)
    with held_cores(cores) as own:
        process = start_run(run, Place(variables, own), cwd)
        try:
            while True:  # who cancels the task is heard between two of these
                with contextlib.suppress(subprocess.TimeoutExpired):
                    return process.wait(timeout=1.0)
        finally:
            process.terminate()
            process.wait()


def _wait_for(folder: Path) -> None:
    """Waits while the process of a node that is lost still saves."""
    end = time.monotonic() + _PATIENCE
    while is_being_written(folder) and time.monotonic() < end:
        time.sleep(0.2)
