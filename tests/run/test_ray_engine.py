"""The engine that hands runs to Ray, with a module in Ray's place; with Ray itself: test_ray.py."""

from __future__ import annotations

import _thread
import contextlib
import importlib
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from hrlspec.run.errors import UserError
from hrlspec.run.folder import open_run
from hrlspec.run.places import Place
from hrlspec.run.planned import PlannedRun


class FakeRay(ModuleType):
    """A cluster of two nodes, whose tasks end as they are told to."""

    def __init__(self) -> None:
        super().__init__("ray")
        self.exceptions = SimpleNamespace(RayError=type("RayError", (Exception,), {}))
        self.given: dict[str, Any] = {}
        self.needs: dict[str, Any] = {}
        self.tasks: dict[object, tuple[Any, ...]] = {}
        self.results: dict[object, int | Exception] = {}
        self.cancelled: list[object] = []
        self.on = False

    def init(self, address: str, **how: Any) -> None:
        signal.signal(signal.SIGTERM, lambda number, frame: None)
        if address == "auto":
            raise ConnectionError("Could not find\nany running Ray instance")
        self.given, self.on = {"address": address, **how}, True

    def nodes(self) -> list[dict[str, Any]]:
        rooms: list[dict[str, float]] = [{"CPU": 2.0}, {"CPU": 4.0, "GPU": 1.0}]
        lost = {"Alive": False, "Resources": {"CPU": 64.0}}
        return [*({"Alive": True, "Resources": room} for room in rooms), lost]

    def remote(self, **needs: Any) -> Callable[[Any], Any]:
        self.needs = needs

        def submit(*args: Any) -> object:
            self.tasks[reference := object()] = args
            return reference

        return lambda function: SimpleNamespace(remote=submit)

    def wait(
        self, references: Sequence[object], *, num_returns: int, timeout: float | None = None
    ) -> tuple[list[object], list[object]]:
        assert timeout == 0 or {*references} <= {*self.cancelled}  # or it would wait for ever
        assert num_returns == len(references)
        done = [reference for reference in references if reference in self.results]
        return done, [reference for reference in references if reference not in self.results]

    def get(self, reference: object) -> int:
        result = self.results[reference]
        if isinstance(result, Exception):
            raise result
        return result

    def cancel(self, reference: object) -> None:
        self.cancelled.append(reference)

    def shutdown(self) -> None:
        self.on = False


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeRay:
    module = FakeRay()
    monkeypatch.setitem(sys.modules, "ray", module)
    return module


@pytest.fixture
def engines(fake: FakeRay) -> Iterator[Any]:
    """The module, made of the fake."""
    sys.modules.pop("hrlspec.run.ray_engine", None)
    yield importlib.import_module("hrlspec.run.ray_engine")
    del sys.modules["hrlspec.run.ray_engine"]


def planned(name: str) -> PlannedRun:
    return PlannedRun(name, ("--seed", "0"), Path("runs") / name, 100)


def test_a_run_is_a_task(fake: FakeRay, engines: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "--of-here")
    monkeypatch.delenv("JAX_PLATFORMS")
    before = signal.getsignal(signal.SIGTERM)
    runs = [planned(f"seed{seed}") for seed in range(4)]
    with engines.RayEngine("local", cores=2, gpus=0) as engine:
        assert signal.getsignal(signal.SIGTERM) == before
        assert fake.given["address"] == "local"
        assert fake.given["include_dashboard"] is fake.given["log_to_driver"] is False
        assert fake.needs == {"num_cpus": 2, "num_gpus": 0, "max_retries": engines.RETRIES}
        assert engine.ended() == []
        for run in runs:
            engine.submit(run)
        first, second, third, last = fake.tasks
        run, cwd, variables, cores = fake.tasks[first]
        assert (run.name, run.folder, cwd, cores) == ("seed0", Path.cwd() / "runs" / "seed0", Path.cwd(), 2)
        assert variables["XLA_FLAGS"] == "--of-here"
        assert variables["JAX_PLATFORMS"] == "cpu"
        assert "HOME" not in variables
        assert engine.ended() == []
        fake.results = {third: fake.exceptions.RayError("the node\ndied"), first: 0, second: 3}
        assert engine.ended() == [(runs[0], None), (runs[1], "status 3"), (runs[2], "RayError: the node died")]
        assert engine.ended() == []
    assert fake.cancelled == [last]
    assert not fake.on


def test_what_shares_a_gpu_shares_its_memory(fake: FakeRay, engines: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JAX_PLATFORMS")
    for gpus, expected in ((0.25, "0.225"), (1, None)):
        with engines.RayEngine("local", cores=1, gpus=gpus) as engine:
            engine.submit(planned("seed0"))
        variables = [*fake.tasks.values()][-1][2]
        assert variables.get("XLA_PYTHON_CLIENT_MEM_FRACTION") == expected
        assert "JAX_PLATFORMS" not in variables


def test_refusals(fake: FakeRay, engines: Any) -> None:
    for cores, gpus in ((5, 0), (1, 2), (64, 0)):
        with pytest.raises(UserError, match="but nodes have 2 cores and 0 GPUs, 4 cores and 1 GPUs"):
            engines.RayEngine("local", cores=cores, gpus=gpus).__enter__()
        assert not fake.on
    with pytest.raises(UserError, match=r"no such cluster .ConnectionError: Could not find any running"):
        engines.RayEngine("auto", cores=1, gpus=0).__enter__()
    with socket.socket() as nobody:  # who has a port and does not listen
        nobody.bind(("127.0.0.1", 0))
        for address in (f"127.0.0.1:{nobody.getsockname()[1]}", "there", "127.0.0.1:"):
            with pytest.raises(UserError, match=f"--ray {address}: there is no such cluster, expected auto, local"):
                engines.RayEngine(address, cores=1, gpus=0).__enter__()
    assert fake.given["address"] == "local"  # Ray was asked for no other that is not there


@pytest.fixture
def started(engines: Any, monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The processes of tasks, each of which waits to be asked to stop, for a minute at most."""
    processes: list[subprocess.Popen[bytes]] = []

    def start(run: PlannedRun, place: Place, cwd: Path) -> subprocess.Popen[bytes]:
        assert len(place.cores) == (sys.platform == "linux")
        code = "raise SystemExit(3)" if run.name == "ends" else "import signal; signal.alarm(60); signal.pause()"
        processes.append(place.start([sys.executable, "-c", code], cwd=cwd))
        return processes[-1]

    monkeypatch.setattr(engines, "start_run", start)
    return processes


def test_a_task_has_the_status_of_its_process(
    engines: Any, started: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    assert engines._carry_out(planned("ends"), tmp_path, {}, 1) == 3
    assert len(started) == 1


def test_who_cancels_a_task_stops_its_process(
    engines: Any, started: list[subprocess.Popen[bytes]], tmp_path: Path
) -> None:
    def cancel() -> None:  # as Ray does
        while not started:
            time.sleep(0.01)
        _thread.interrupt_main()

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # who runs the tests may ignore it
    try:
        threading.Thread(target=cancel).start()
        with pytest.raises(KeyboardInterrupt):
            engines._carry_out(planned("lasts"), tmp_path, {}, 1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert started[0].returncode == -signal.SIGTERM


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_a_task_waits_for_whoever_writes_to_its_folder(
    engines: Any, started: list[subprocess.Popen[bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = PlannedRun("ends", (), tmp_path / "run", 100)
    waits = []
    with contextlib.ExitStack() as writer:
        writer.enter_context(open_run(run.folder, {"seed": 0}, tensorboard=False))

        def wait(seconds: float) -> None:
            assert not started
            waits.append(seconds)
            if len(waits) == 3:
                writer.close()

        monkeypatch.setattr(engines, "time", SimpleNamespace(sleep=wait, monotonic=lambda: 0.0))
        assert engines._carry_out(run, tmp_path, {}, 1) == 3
    assert len(waits) == 3
