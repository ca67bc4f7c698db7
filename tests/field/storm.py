"""A storm: tiny runs under signals, closed pipes, full disks, in odd folders and odd environments.

    python -m tests.field.storm --trials 200 --seed 0

Whatever happens to a run:

* a checkpoint that was once sealed can be loaded, or a later one; in some trials the run is resumed to its end;
* it ends in time, with status 0, 1, 2, 130 or 143, or by a signal that was sent to it;
* a failure says at most ten lines, and no traceback;
* what is refused (status 2) leaves nothing behind, and status 0 leaves results.

A trial depends on the seed and its number alone, but for the moment at which a signal meets the run. ``--from`` begins
at a later one. What failed is kept below ``--work``, with what the processes said. Linux; as root disks are small ones
of their own (tmpfs), else a limit on the size of files stands in for them.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hrlspec import checkpoint
from hrlspec.run.experiment import experiment_of
from hrlspec.run.folder import read_metrics, read_record, read_summary
from hrlspec.run.learner import Learner
from tests.run import tiny

ROOT = Path(__file__).parents[2]
STATUSES = (0, 1, 2, 130, 143)
MOST_LINES = 10
PATIENCE = 300  # seconds; a busy machine may have to compile within them
RESUMED = 3  # one trial in so many is resumed to its end
ROWS = [400, 800, 960]  # steps at which a whole run is evaluated
PROGRESS = "letter-ours-hrlspec-set1-seed0: "  # begins a line that is no failure's

NAMES = (
    *(
        "lr[0.1]",
        "[bold red]x",
        "a\\b",
        "a b",
        "ü 漢字",
        "*?",
        "{x} %s $HOME `id`",
        "#1",
        "-run",
        ".",
        "run/",
        "a/b/c/d",
    ),
    *("x" * 255, "x" * 300, "line\nbreak", "\udcff", "gs:run", "gs://bucket/run", "s3:", "", "~", "file", "file/run"),
    *("full", "link", "dangling", "/dev/null", "/dev/full/run", "/proc/run"),
)
PLACES = ("cwd [1]", "cwd \\", "gone")
"""Working directories; the last one is no longer there."""

ENVIRONMENTS: tuple[dict[str, str | None], ...] = (
    {"HOME": None},
    {"HOME": "/nowhere", "XDG_CACHE_HOME": None},
    {"HOME": "", "XDG_CACHE_HOME": "relative"},
    {"PATH": ""},
    {"TMPDIR": "/nowhere"},
    {"TERM": "dumb"},
    {"TERM": None, "COLUMNS": "1"},
    {"COLUMNS": "many", "LINES": "-1"},
    {"FORCE_COLOR": "1", "COLUMNS": "20"},
    {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    {"PYTHONIOENCODING": "ascii"},
    {"PYTHONIOENCODING": "cp1252"},
    {"MPLBACKEND": "nonsense"},
    {"MPLCONFIGDIR": "/proc/nowhere"},
    {"PYTHONWARNINGS": "error"},
    {"PYTHONOPTIMIZE": "2"},
    {"PYTHONUNBUFFERED": "1"},
    {"GIT_DIR": "/nowhere"},
    {"TZ": "Nowhere/Nothing"},
    {"JAX_PLATFORMS": "cuda"},
    {"JAX_PLATFORMS": ""},
    {"JAX_ENABLE_X64": "1"},
    {"XLA_FLAGS": "--xla_no_such_flag=1"},
    {"XLA_FLAGS": "/nowhere/flags"},
    {"JAX_COMPILATION_CACHE_DIR": "/proc/nowhere"},
)


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a trial does; numbers between 0 and 1 are shares of what an undisturbed run takes.

    Attributes:
        hazard: ``none``, ``signal``, ``pipe`` or ``disk``.
        name: the run folder, as given.
        place: the working directory.
        environment: what is set, or with ``None`` removed.
        signals: what is sent, and when.
        to_group: signals go to the whole process group, as a terminal sends them.
        streams: for each of standard output and standard error ``file``, ``closed``, ``full``, or ``pipe``, whose
            reader leaves.
        leaves: when the readers leave.
        space: of the disk.
    """

    hazard: str
    name: str = "run"
    place: str = ""
    environment: dict[str, str | None] = dataclasses.field(default_factory=dict)
    signals: tuple[tuple[float, signal.Signals], ...] = ()
    to_group: bool = False
    streams: tuple[str, str] = ("file", "file")
    leaves: float = 1.0
    space: float = 1.0

    def __str__(self) -> str:
        default = Plan("none")
        told = {k: v for k, v in dataclasses.asdict(self).items() if v != getattr(default, k)}
        if self.signals:
            told["signals"] = [f"{number.name} at {at:.2f}" for at, number in self.signals]
        return json.dumps({k: v[:40] if isinstance(v, str) else v for k, v in told.items()})


def plan_of(seed: int, index: int) -> Plan:
    """The plan of a trial."""
    rng = random.Random(f"{seed}:{index}")
    hazard = rng.choices(["none", "signal", "pipe", "disk"], [3, 9, 4, 4])[0]
    plan = Plan(hazard)
    odd = rng.random() < (0.35 if hazard != "none" else 0.8)
    if odd and rng.random() < 0.25:
        plan = dataclasses.replace(plan, place=rng.choice(PLACES))
    elif odd:
        plan = dataclasses.replace(plan, name=rng.choice(NAMES))
    if rng.random() < (0.3 if hazard != "none" else 0.6):
        plan = dataclasses.replace(plan, environment=rng.choice(ENVIRONMENTS))
    if hazard == "signal" or (hazard == "pipe" and rng.random() < 0.4):
        plan = dataclasses.replace(plan, signals=_signals(rng), to_group=rng.random() < 0.5)
    if hazard == "pipe":
        streams = rng.choice([*[("pipe", "pipe")] * 4, ("pipe", "file"), ("file", "pipe"), *_CLOSED])
        at_the_signal = plan.signals and rng.random() < 0.5  # as Ctrl-C ends `| tee` too
        plan = dataclasses.replace(plan, streams=streams, leaves=plan.signals[0][0] if at_the_signal else rng.random())
    if hazard == "disk":
        plan = dataclasses.replace(plan, space=rng.random() ** 2 * 1.1)
    return plan


_CLOSED = [("closed", "file"), ("file", "closed"), ("closed", "closed"), ("full", "file"), ("full", "full")]


def _signals(rng: random.Random) -> tuple[tuple[float, signal.Signals], ...]:
    at = rng.random() * 1.1
    first = rng.choice([signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
    if first != signal.SIGINT or rng.random() < 0.5:
        return ((at, first),)
    return ((at, first), (at + rng.choice([0.0, 0.01, 0.1, 0.3]) * rng.random(), signal.SIGINT))


class Process:
    """A run in a process of its own, until it ends.

    Attributes:
        status: its exit status, ``None`` if it did not end in time.
        said: what it wrote to standard output and standard error, as far as anybody read it.
        sealed: the newest step of which there was a checkpoint at some moment; -1 without any.
    """

    def __init__(self, storm: Storm, plan: Plan, sandbox: Path, *more: str) -> None:
        self._folder, self.sealed = _out(plan, sandbox), -1
        self._readers: dict[int, int] = {}
        read: list[bytes] = [b"", b""]
        command = [sys.executable, "-m", "hrlspec.run.cli", "run"]
        command += [*tiny.FLAGS, *tiny.PLANNER, "--total-steps", str(tiny.TOTAL), "--checkpoint-minutes", "0"]
        logs = [sandbox / "output", sandbox / "errors"]
        with contextlib.ExitStack() as stack:
            streams = [self._stream(i, plan.streams[i], logs[i], stack) for i in range(2)]
            process = subprocess.Popen(
                ["/bin/sh", "-c", _prelude(plan, storm), *command, f"--out={plan.name}", *more],
                cwd=_place(plan, sandbox),
                env=_environment(storm, plan),
                stdin=subprocess.DEVNULL,
                stdout=streams[0],
                stderr=streams[1],
                start_new_session=True,
            )
        send = functools.partial(os.killpg if plan.to_group else os.kill, process.pid)
        events: list[tuple[float, Callable[[], None]]] = [(at, functools.partial(send, s)) for at, s in plan.signals]
        events.append((plan.leaves, functools.partial(self._leave, read)))
        events.sort(key=lambda event: event[0])
        self.status = self._wait(process, [(at * storm.seconds, event) for at, event in events])
        self._leave(read)
        for i, log in enumerate(logs):
            read[i] += log.read_bytes() if log.exists() else b""
        self.said = tuple(part.decode(errors="replace") for part in read)

    def _stream(self, index: int, kind: str, log: Path, stack: contextlib.ExitStack) -> Any:
        if kind != "pipe":
            return stack.enter_context(open("/dev/full" if kind == "full" else log, "wb"))  # a closed one: see _prelude
        self._readers[index], writer = os.pipe()
        stack.callback(os.close, writer)
        return writer

    def _leave(self, read: list[bytes]) -> None:
        """Readers take what is there and go."""
        for index, reader in self._readers.items():
            os.set_blocking(reader, False)
            with contextlib.suppress(BlockingIOError):
                read[index] += os.read(reader, 1_000_000)
            os.close(reader)
        self._readers.clear()

    def _wait(self, process: subprocess.Popen[bytes], events: list[tuple[float, Callable[[], None]]]) -> int | None:
        begun = time.monotonic()
        try:
            while process.poll() is None:
                now = time.monotonic() - begun
                if now > PATIENCE:
                    return None
                while events and events[0][0] <= now:
                    with contextlib.suppress(ProcessLookupError):
                        events.pop(0)[1]()
                self.sealed = max([self.sealed, *_steps(self._folder)])
                time.sleep(0.01)
            return process.returncode
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _prelude(plan: Plan, storm: Storm) -> str:
    """What a shell does before it becomes the run. Forking by hand would meet the threads of JAX."""
    lines = ['/bin/rmdir "$(/bin/pwd)"'] if plan.place == "gone" else []
    if plan.hazard == "disk" and not storm.mounts:  # what it says goes into files as well, so there is room for that
        lines.append(f"ulimit -S -f {16 + int(plan.space * storm.largest / 512)}")
    closed = [f" {number}>&-" for number, kind in zip((1, 2), plan.streams, strict=True) if kind == "closed"]
    return "; ".join([*lines, 'exec "$0" "$@"' + "".join(closed)])


def _environment(storm: Storm, plan: Plan) -> dict[str, str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", **storm.cache}
    environment |= {name: value for name, value in plan.environment.items() if value is not None}
    return {name: value for name, value in environment.items() if plan.environment.get(name, "") is not None}


def _place(plan: Plan, sandbox: Path) -> Path:
    """The working directory; on the disk, if it has one of its own."""
    place = sandbox / "disk" / plan.place
    place.mkdir(parents=True, exist_ok=True)
    return place


def _out(plan: Plan, sandbox: Path) -> Path:
    return sandbox / "disk" / plan.place / plan.name


def _steps(folder: Path) -> list[int]:
    """Of the checkpoints in a run folder, which may be none or no longer there."""
    try:
        return checkpoint.steps(folder / "checkpoints")
    except OSError:
        return []


def _furnish(place: Path) -> None:
    """What some of the names lead to."""
    (place / "file").write_text("")
    (place / "full").mkdir()
    (place / "full" / "paper.tex").write_text("")
    (place / "target").mkdir()
    (place / "link").symlink_to("target")
    (place / "dangling").symlink_to("nothing")


@dataclasses.dataclass
class Storm:
    """All trials.

    Attributes:
        work: a folder for them.
        seed: of the plans.
        mounts: whether disks can be made.
    """

    work: Path
    seed: int

    def __post_init__(self) -> None:
        self.work.mkdir(parents=True, exist_ok=True)
        self.cache = {
            "JAX_COMPILATION_CACHE_DIR": os.environ.get("JAX_COMPILATION_CACHE_DIR", str(self.work / "cache")),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
        }
        self.mounts = _can_mount(self.work)
        self.seconds = float(PATIENCE)  # so that no event comes in the first run
        self.space = self.largest = 0
        for _ in range(2):  # the first one compiles
            sandbox = self._sandbox("calm")
            begun = time.monotonic()
            calm = Process(self, Plan("none"), sandbox)
            if calm.status != 0:
                raise RuntimeError(f"an undisturbed run ended with status {calm.status}: {calm.said}")
            elapsed = time.monotonic() - begun
        self.seconds = elapsed
        sizes = [file.stat().st_size for file in (sandbox / "disk").rglob("*") if file.is_file()]
        self.space, self.largest = sum(-(-size // 4096) * 4096 for size in sizes), max(sizes)
        experiment = experiment_of(read_record(sandbox / "disk" / "run")["config"], "run")
        self._target = Learner(experiment, experiment.preset).job().init()

    def trial(self, index: int) -> tuple[Plan, int | None, list[str]]:
        """Carries out a plan; returns it, the exit status and what is wrong."""
        plan = plan_of(self.seed, index)
        sandbox = self._sandbox(f"trial{index}")
        with self._disk(plan, sandbox) as free:
            place = _place(plan, sandbox)
            with contextlib.suppress(OSError):  # there may be no room
                _furnish(sandbox / "disk")
            before = _contents(sandbox / "disk")
            process = Process(self, plan, sandbox)
            wrong = list(self._wrong(plan, process, before, sandbox))
            free()
            if place.is_dir():
                wrong += self._lost(plan, process.sealed, sandbox, resume=index % RESUMED == 0)
            if wrong:
                (sandbox / "plan").write_text(f"{plan}\n" + "\n".join(wrong) + "\n")
                shutil.copytree(sandbox / "disk", sandbox / "kept", symlinks=True, dirs_exist_ok=True)
        if not wrong:
            shutil.rmtree(sandbox)
        return plan, process.status, wrong

    def _wrong(self, plan: Plan, process: Process, before: set[str], sandbox: Path) -> Iterator[str]:
        """What the process should not have done."""
        status, folder = process.status, _out(plan, sandbox)
        if status is None:
            yield f"no end within {PATIENCE} s"
        elif status not in (*STATUSES, *(-number for _, number in plan.signals)):
            yield f"status {status}"
        lines = [line for line in process.said[1].splitlines() if line.strip() and not line.startswith(PROGRESS)]
        if status != 0 and len(lines) > MOST_LINES and "COLUMNS" not in plan.environment:  # which break lines
            yield f"{len(lines)} lines"
        # A signal may meet Python before it has read anything of the project.
        if "Traceback" in process.said[1] and (not plan.signals or str(ROOT) in process.said[1]):
            yield "a traceback"
        if status == 2 and (left := _contents(sandbox / "disk") - before):
            yield f"left behind: {sorted(left)[:5]}"
        if status == 0 and read_summary(folder) is None:
            yield "status 0 without results"

    def _lost(self, plan: Plan, sealed: int, sandbox: Path, *, resume: bool) -> Iterator[str]:
        """Which checkpoints cannot be loaded, or what keeps the run from being resumed."""
        folder = _out(plan, sandbox)
        if sealed >= 0:
            try:
                restored = checkpoint.load(folder / "checkpoints", self._target)
            except checkpoint.CheckpointError as error:
                yield f"lost checkpoint of step {sealed}: {error}"
            else:
                if restored.step < sealed or restored.skipped:
                    yield f"lost checkpoint of step {sealed}: loaded {restored.step}, skipped {restored.skipped}"
            if not (folder / "config.json").exists():
                yield "checkpoints without config.json"
        if resume and os.path.exists(folder / "config.json"):
            process = Process(self, Plan("none", plan.name, plan.place), sandbox, "--resume")
            if process.status != 0:
                yield f"cannot be resumed: status {process.status}: {process.said[1][-500:]}"
            elif [row["env_steps"] for row in read_metrics(folder)] != ROWS or read_summary(folder) is None:
                yield "resumed to something else than the end of the run"

    def _sandbox(self, name: str) -> Path:
        sandbox = self.work / name
        shutil.rmtree(sandbox, ignore_errors=True)
        (sandbox / "disk").mkdir(parents=True)
        return sandbox

    @contextlib.contextmanager
    def _disk(self, plan: Plan, sandbox: Path) -> Iterator[Callable[[], object]]:
        """The trial's disk, and what makes it large."""
        disk = sandbox / "disk"
        if plan.hazard != "disk" or not self.mounts:
            yield lambda: None
            return
        size = 4096 * (2 + int(plan.space * self.space / 4096))
        _mount(disk, f"size={size}")
        try:
            yield lambda: _mount(disk, "remount,size=256m")
        finally:
            subprocess.run(["umount", "--lazy", str(disk)], check=True)


def _mount(disk: Path, options: str) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "storm", str(disk)], check=True, capture_output=True)


def _can_mount(work: Path) -> bool:
    with tempfile.TemporaryDirectory(dir=work) as folder:
        try:
            _mount(Path(folder), "size=8192")
        except (OSError, subprocess.CalledProcessError):
            return False
        subprocess.run(["umount", folder], check=True)
    return True


def _contents(folder: Path) -> set[str]:
    return {str(path) for path in folder.rglob("*")}


def main(argv: Sequence[str] | None = None) -> int:
    """Prints a line for each trial that went wrong and a last one; the exit status is 1 if any did."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200, help="how many there are")
    parser.add_argument("--seed", type=int, default=0, help="of the plans")
    parser.add_argument("--from", dest="first", type=int, default=0, help="the first that is carried out")
    parser.add_argument("--work", type=Path, help="where; a temporary folder by default")
    flags = parser.parse_args(argv)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that processes and disks are put away
    storm = Storm((flags.work or Path(tempfile.mkdtemp(prefix="storm-"))).absolute(), flags.seed)
    disks = "small ones" if storm.mounts else "limits on files"
    print(f"an undisturbed run takes {storm.seconds:.1f} s; disks are {disks}", flush=True)
    failed = 0
    for index in range(flags.first, flags.trials):
        plan, status, wrong = storm.trial(index)
        failed += bool(wrong)
        print(f"{'WRONG' if wrong else 'right'} {index}: status {status}, {plan}", *wrong, sep="\n      ", flush=True)
    print(f"{flags.trials - flags.first} trials, {failed} wrong; what is left of them is in {storm.work}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
