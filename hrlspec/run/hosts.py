"""Processes that train one run together, on one machine or on several.

Each trains on devices of its own. The first one leads: it alone evaluates and writes to the run folder, and decides
when to save and when to stop. Keys, curriculum and banks of tasks are functions of the seed, and so the same on all.

A process that has lost the others cannot go on. JAX would let it wait for minutes, or for ever; it leaves at once with
the status `LOST`, so that a supervisor or a cluster can start all of them again from the last checkpoint.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import json
import os
import socket
import sys
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NoReturn, TextIO, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hrlspec.run import heartbeat
from hrlspec.run.errors import FAILED, UserError, in_words, main_guard

T = TypeVar("T")

AUTO = "auto"
LOST = 75
"""Exit status of a process that has lost the others: as ``EX_TEMPFAIL``, worth another try."""

_HEARTBEAT_SECONDS = 10  # without a sign until JAX gives a process up
_FOR_EVER = 2**31 - 1  # ms; a process that is gone is noticed by its heartbeat
_REMEMBERED = 64  # what the first one said; nobody is so far behind it


class Hosts:
    """One process of those that train together.

    Args:
        count: how many there are.
        index: which one this is; 0 leads.
    """

    def __init__(self, count: int = 1, index: int = 0) -> None:
        self.count, self.index = count, index
        self._said = itertools.count()

    @property
    def leads(self) -> bool:
        """Whether this is the first process."""
        return self.index == 0

    def lead(self, function: Callable[[], T]) -> T:
        """What a function returns on the first process, which alone calls it, on all of them, which wait for it.

        Every process calls this in the same places. The result is one that JSON knows, which makes lists of tuples.

        Raises:
            SystemExit: on the others, when the function has raised something on the first.
        """
        if self.count == 1:
            return function()
        client, number = _client(), next(self._said)
        key = f"hrlspec/{number}"
        if not self.leads:
            said: list[T] = json.loads(client.blocking_key_value_get(key, _FOR_EVER))
            if not said:
                raise SystemExit(FAILED)
            return said[0]
        try:
            result = function()
        except BaseException:
            client.key_value_set(key, "[]")
            raise
        client.key_value_set(key, json.dumps([result]))
        if number >= _REMEMBERED:
            client.key_value_delete(f"hrlspec/{number - _REMEMBERED}")
        return result

    def wished(self, mine: bool) -> bool:
        """Tells the first process of a wish; there, whether any process has had it."""
        if self.count == 1 or (self.leads and mine):
            return mine
        if self.leads:
            return bool(_client().key_value_dir_get("hrlspec/wish"))
        if mine:
            _client().key_value_set(f"hrlspec/wish/{self.index}", "", allow_overwrite=True)
        return mine

    def meet(self, mesh: Mesh) -> None:
        """Waits for all processes, and connects their devices.

        The first collective gives up after half a minute, and while programs are compiled nobody knows who is late;
        later ones wait for as long as it takes.
        """
        if self.count == 1:
            return
        _client().wait_at_barrier(f"hrlspec/{next(self._said)}", _FOR_EVER)
        with _quiet():
            shares = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
            jax.block_until_ready(_whole(mesh)(jax.make_array_from_callback((mesh.size,), shares, _nothing)))

    def readable(self, state: T) -> T:
        """A state of which each process can read all; every process calls this."""
        if self.count == 1:
            return state
        readable: T = _whole(jax.tree.leaves(state)[0].sharding.mesh)(state)
        return readable


ALONE = Hosts()


def local_address() -> str:
    """An address for processes of this machine, at which nobody listens now."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{server.getsockname()[1]}"


@contextlib.contextmanager
def joined(address: str | None, count: int | None = None, index: int | None = None) -> Iterator[Hosts]:
    """This process among those that train together, while the context lasts; before JAX is used.

    Whatever the context ends with ends the process, with the line and the status that `main_guard` gives it. From here
    on only the first process says anything, but for tracebacks.

    Args:
        address: ``HOST:PORT`` where the first one listens; `AUTO` where a cluster says all this; ``None`` for a process
            of its own, to which nothing of this applies.
        count: how many there are; a cluster knows.
        index: which one this is; a cluster knows.

    Raises:
        UserError: no cluster started this process.
    """
    if address is None:
        yield ALONE
        return
    stderr = sys.stderr
    try:
        hosts = _join(address, count, index)
        if not hosts.leads:
            stderr = os.fdopen(os.dup(2), "w")
            _to_nowhere(1, 2)
        yield hosts
        jax.distributed.shutdown()
    except BaseException as error:
        if isinstance(error, UserError) and not jax.distributed.is_initialized():
            raise
        _leave(error, stderr)


def _join(address: str, count: int | None, index: int | None) -> Hosts:
    from jax._src.distributed import global_state

    _share_core()
    options: dict[str, Any] = {}
    if address != AUTO:
        options = {"coordinator_address": address, "num_processes": count, "process_id": index}
        options["cluster_detection_method"] = "deactivate"
        if address.startswith("127."):  # JAX would listen to every network
            options["coordinator_bind_address"] = address
    jax.config.update("jax_enable_preemption_service", False)  # it would keep SIGTERM to itself
    try:
        jax.distributed.initialize(
            **options, heartbeat_timeout_seconds=_HEARTBEAT_SECONDS, shutdown_timeout_seconds=_HEARTBEAT_SECONDS
        )
    except jax.errors.JaxRuntimeError:
        raise
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"--distributed {address}: {in_words(error)}; where neither SLURM nor Open MPI nor Kubernetes has started "
            "this process, give HOST:PORT, --num-processes and --process-id"
        ) from error
    return Hosts(global_state.num_processes, global_state.process_id)


def _share_core() -> None:
    """Threads of this process, those that it starts from here on, run one after the other where they share a core.

    Else, with a core for each process, what arrives waits for the scheduler's next tick: 4 ms for any transfer, when
    that of 350 numbers takes .05 ms.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # some containers forbid it
            if os.sched_getscheduler(0) == os.SCHED_OTHER:
                os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _leave(error: BaseException, stderr: TextIO) -> NoReturn:
    """Ends the process at once: what JAX does at exit would wait for the others.

    Args:
        error: why.
        stderr: where what nobody expected is told.
    """

    def again() -> NoReturn:
        raise error

    try:
        if isinstance(error, jax.errors.JaxRuntimeError):
            status = LOST
            if not heartbeat.supervised():
                said = f"error: the processes lost each other ({in_words(error)})"
                print(f"{said}; --resume goes on from the last checkpoint", file=sys.stderr)
        else:
            status = main_guard(again)
    except SystemExit as stop:
        status = stop.code if isinstance(stop.code, int) else FAILED
        if isinstance(stop.code, str):
            print(stop.code, file=sys.stderr)
    except BaseException:
        traceback.print_exception(error, file=stderr)
        status = FAILED
    for stream in (sys.stdout, sys.stderr, stderr):
        stream.flush()
    os._exit(status)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Nothing reaches standard output: the library that connects CPUs says so there."""
    sys.stdout.flush()
    kept = os.dup(1)
    _to_nowhere(1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _to_nowhere(*numbers: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in numbers:
        os.dup2(nowhere, number)
    os.close(nowhere)


def _nothing(index: Any) -> np.ndarray:
    del index
    return np.zeros(1, np.float32)


@functools.cache
def _whole(mesh: Mesh) -> Callable[[Any], Any]:
    """A pytree that lies on a mesh, all of it on each device."""
    whole: Callable[[Any], Any] = jax.jit(lambda tree: tree, out_shardings=NamedSharding(mesh, PartitionSpec()))
    return whole


def _client() -> Any:
    from jax._src.distributed import global_state  # as orbax does: JAX has no public name for it

    return global_state.client
