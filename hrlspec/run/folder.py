"""The folder of one run: written by one process, resumable, readable by any tool.

::

    config.json      everything resolved, versions, commit, command; under "earlier" those of the processes before
    metrics.jsonl    one JSON object for each evaluation, in the order of env_steps
    checkpoints/     see hrlspec.checkpoint.store
    tensorboard/     event files with the same numbers as metrics.jsonl, and those of the final results
    wandb.json       project and id in Weights & Biases, if it is told as well; wandb/ what it keeps here
    plots/           pictures
    tasks/           test tasks, where the environment has no suites of its own
    summary.json     the final results; summary-<env_steps>.json those before it was made longer

A row of metrics is written before the checkpoint of its step. So after a kill at any moment the rows up to the newest
checkpoint are complete, and those after it, which the resumed run writes again, are dropped: no row appears twice.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Protocol, Self

from hrlspec.run.circumstances import circumstances
from hrlspec.run.configuration import config_hash, differences, dotted, plain
from hrlspec.run.errors import UserError
from hrlspec.run.files import write_atomically

FORMAT = 1
_LOCK = ".lock"
_LOCK_TRIES, _LOCK_PAUSE = 20, 0.01  # seconds
_LEFT_BY_A_KILL = {_LOCK, ".config.new.json"}  # all that a process killed at once after its start leaves
_BEGUN = (*_LEFT_BY_A_KILL, "config.json", "tensorboard", "wandb", "wandb.json")  # what `open_run` makes


class Recorder(Protocol):
    """Whoever is told a run's numbers beside the folder itself; a context manager that ends when the run is left."""

    def add(self, step: int, values: Mapping[str, float]) -> None:
        """Adds numbers under their names. It raises nothing: what is lost is no reason to stop a run."""

    def __enter__(self) -> Self:
        """Begins, or goes on."""

    def __exit__(self, *exception: object) -> None:
        """Ends."""


@dataclasses.dataclass
class RunFolder:
    """An open run folder, from `open_run`; this process alone writes to it.

    Attributes:
        path: the folder.
        config: the resolved configuration as in ``config.json``.
        config_hash: its SHA-256, to be kept with each checkpoint.
        earlier_hashes: those of the configurations that this one replaced.
        resumed: whether the folder held this run before.
    """

    path: Path
    config: dict[str, Any]
    config_hash: str
    earlier_hashes: frozenset[str]
    resumed: bool
    _tensorboard: bool
    _wandb: str | None
    _stack: contextlib.ExitStack
    _last_step: int | None = None  # of metrics.jsonl; None until a resumed run says where it resumes
    _recorders: list[Recorder] = dataclasses.field(default_factory=list)

    @property
    def checkpoints(self) -> Path:
        """Where the checkpoints go."""
        return self.path / "checkpoints"

    @property
    def plots(self) -> Path:
        """Where the pictures go; made on first use."""
        folder = self.path / "plots"
        folder.mkdir(exist_ok=True)
        return folder

    def rewind(self, env_steps: int) -> int:
        """Drops the rows after ``env_steps``. A resumed run says so first, before it adds rows.

        Args:
            env_steps: the step of the checkpoint it resumes from; -1 when there is none and it begins anew.

        Returns:
            How many rows were dropped, a half-written last line included.
        """
        rows, dropped = _read_rows(self.path)
        kept = [row for row in rows if row["env_steps"] <= env_steps]
        dropped += len(rows) - len(kept)
        if dropped:
            write_atomically(self.path / "metrics.jsonl", "".join(json.dumps(row) + "\n" for row in kept))
        self._begin(env_steps)
        return dropped

    def append(self, row: Mapping[str, Any]) -> None:
        """Adds one evaluation to ``metrics.jsonl``, on the disk when this returns, and tells its numbers.

        Args:
            row: ``env_steps`` and any JSON-like values; numpy and JAX scalars and arrays become numbers and lists, and
                numbers that are not finite become ``null``, which every JSON reader understands.
        """
        entries = plain(row)
        if not isinstance(entries.get("env_steps"), int):
            raise ValueError(f"a row of metrics needs an integer env_steps, found {entries.get('env_steps')!r}")
        if self._last_step is None:
            raise RuntimeError("a resumed run calls rewind before it adds rows")
        if entries["env_steps"] < self._last_step:
            raise ValueError(f"row of env_steps {entries['env_steps']} after one of {self._last_step}")
        self._last_step = entries["env_steps"]
        with (self.path / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(entries, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self.tell(entries.pop("env_steps"), entries)

    def tell(self, env_steps: int, values: Mapping[str, Any]) -> None:
        """Tells TensorBoard, and Weights & Biases if asked to, what is a number; nested ones under names with slashes.

        Args:
            env_steps: to which they belong.
            values: any JSON-like values.
        """
        numbers = {
            name.replace(".", "/"): value
            for name, value in dotted(plain(values)).items()
            if isinstance(value, int | float) and not isinstance(value, bool)
        }
        for recorder in self._recorders:
            recorder.add(env_steps, numbers)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Writes ``summary.json``, replacing an earlier one as a whole; it has an entry ``env_steps``."""
        write_atomically(self.path / "summary.json", json.dumps(plain(summary), indent=2, allow_nan=False) + "\n")

    def write_tasks(self, name: str, text: str) -> None:
        """Writes a test suite."""
        folder = self.path / "tasks"
        folder.mkdir(exist_ok=True)
        write_atomically(folder / f"{name}.txt", text)

    def _begin(self, env_steps: int) -> None:
        """Accepts rows from ``env_steps`` on; TensorBoard is told to forget what an earlier process wrote after it."""
        self._last_step = env_steps
        if self._tensorboard:
            try:
                from hrlspec.run.events import EventFile
            except ImportError as error:
                raise UserError('TensorBoard event files need the extra "cli": pip install "hrlspec[cli]"') from error
            self._record(EventFile(self.path / "tensorboard", env_steps + 1 if self.resumed else None))
        if self._wandb is not None:
            try:
                from hrlspec.run.weights_and_biases import WandbRun
            except ImportError as error:
                raise UserError('--wandb needs the extra "wandb": pip install "hrlspec[wandb]"') from error
            self._record(WandbRun(self.path, self._wandb, self.config))

    def _record(self, recorder: Recorder) -> None:
        self._recorders.append(self._stack.enter_context(recorder))


@contextlib.contextmanager
def open_run(
    path: str | os.PathLike[str],
    config: Any,
    *,
    resume: bool = False,
    may_change: Sequence[str] = (),
    tensorboard: bool = True,
    wandb: str | None = None,
) -> Iterator[RunFolder]:
    """Makes a run folder, or opens that of a run to be resumed, and locks it until the context ends.

    Args:
        path: the folder; a new run needs one that is missing or empty.
        config: everything that determines the run, as a dataclass or a mapping of JSON-like values.
        resume: continue the run that the folder holds.
        may_change: dotted names of the configuration in which a resumed run may differ, such as ``total_steps``.
        tensorboard: whether rows also go to TensorBoard event files.
        wandb: the project in Weights & Biases to which they go too; ``None`` for none.

    Raises:
        UserError: the folder holds another run, or none to resume, or is in use, or cannot be written, or Weights &
            Biases cannot be told.
    """
    with contextlib.ExitStack() as stack:
        with _refusals_told(Path(path)):
            run = _open(stack, Path(path), config, resume, may_change, tensorboard, wandb)
        yield run


@contextlib.contextmanager
def followed_run(path: Path, config: Any, *, resume: bool) -> Iterator[RunFolder]:
    """The folder of a run that another process has open, to read from."""
    resolved = plain(config)
    with contextlib.ExitStack() as stack:
        yield RunFolder(path, resolved, config_hash(resolved), frozenset(), resume, False, None, stack)


def check_place(folder: Path, *, resume: bool) -> None:
    """Refuses what `open_run` would refuse, as far as that shows before anything is made in or beside the folder.

    Args:
        folder: of the run.
        resume: whether it is to hold a run, or none.

    Raises:
        UserError: it holds a run, or none to resume, or something else, or cannot be written.
    """
    check_writable(folder)
    begun = holds_run(folder)
    with _refusals_told(folder):
        if resume and not begun:
            raise UserError(f"there is no run to resume in {folder}")
        if begun and not resume:
            raise UserError(f"{folder} holds a run already: continue it with --resume, or choose another --out")
        if not begun and folder.is_dir() and {entry.name for entry in folder.iterdir()} - _LEFT_BY_A_KILL:
            raise UserError(f"{folder} is not empty and holds no run; choose another --out")


def holds_run(folder: Path) -> bool:
    """Whether a run was begun in the folder.

    Raises:
        UserError: the system does not say.
    """
    with _refusals_told(folder):
        return (folder / "config.json").exists()


def check_file(flag: str, file: Path, endings: Sequence[str]) -> None:
    """Whether a file that a flag names can be written, before the work for it begins.

    Raises:
        UserError: it has another ending, is a folder, or nothing can be written there.
    """
    if file.suffix not in endings:
        raise UserError(f"{flag} {file}: expected a file that ends in {', '.join(endings[:-1])} or {endings[-1]}")
    if file.is_dir():
        raise UserError(f"{flag} {file}: expected a file, found a folder")
    check_writable(file.parent)


def check_writable(folder: Path) -> None:
    """Refuses a folder in which nothing can be made, or which cannot be made.

    Raises:
        UserError: it is below a file, or is one, or the system says no.
    """
    with _refusals_told(folder):
        place = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
        if not place.is_dir():
            raise UserError(f"cannot write to {folder}: {place} is a file, not a folder")
        if not os.access(place, os.W_OK | os.X_OK):
            raise UserError(f"cannot write to {folder}: {place} is not writable")


@contextlib.contextmanager
def _refusals_told(folder: Path) -> Iterator[None]:
    """What the system refuses, as one line."""
    try:
        yield
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror or error}") from error


def _open(
    stack: contextlib.ExitStack,
    folder: Path,
    config: Any,
    resume: bool,
    may_change: Sequence[str],
    tensorboard: bool,
    wandb: str | None,
) -> RunFolder:
    """`open_run` up to the point where the caller takes over; what must be undone goes on the stack."""
    resolved = plain(config)
    check_place(folder, resume=resume)
    with contextlib.ExitStack() as undo:
        undo.callback(_remove_empty, [place for place in (folder, *folder.parents) if not place.exists()])
        folder.mkdir(parents=True, exist_ok=True)
        _lock(stack.enter_context((folder / _LOCK).open("a")), folder)
        check_place(folder, resume=resume)  # again under the lock: another process may have begun a run meanwhile
        if not resume:
            undo.callback(_remove_beginnings, folder)
        record = {"format": FORMAT, "config": resolved, "config_hash": config_hash(resolved), **circumstances()}
        if resume:
            record["earlier"] = _replaced(folder, resolved, may_change)
        write_atomically(folder / "config.json", json.dumps(record, indent=2) + "\n")
        earlier = frozenset(entry["config_hash"] for entry in record.get("earlier", []) if "config_hash" in entry)
        run = RunFolder(folder, resolved, record["config_hash"], earlier, resume, tensorboard, wandb, stack)
        if not resume:
            run._begin(-1)
        undo.pop_all()
    return run


def _replaced(folder: Path, config: Any, may_change: Sequence[str]) -> list[dict[str, Any]]:
    """What the new record says of those before it. The results of another configuration are set aside."""
    record = read_record(folder)
    check_same(folder, record["config"], config, may_change)
    entry = {name: value for name, value in record.items() if name not in ("format", "config", "earlier")}
    changed = {name: there for name, (there, _) in differences(record["config"], config).items()}
    if changed:
        entry["changed"] = changed
        summary = read_summary(folder)
        if summary is not None:
            (folder / "summary.json").replace(folder / f"summary-{summary['env_steps']}.json")
    return [*record.get("earlier", []), entry]


def _remove_beginnings(folder: Path) -> None:
    for path in (folder / name for name in _BEGUN):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in folders:
        with contextlib.suppress(OSError):  # it is not empty, or was never made
            folder.rmdir()


def read_record(path: str | os.PathLike[str]) -> dict[str, Any]:
    """``config.json`` of a run: ``config``, ``config_hash``, ``versions``, ``commit``, ``command``, ``started``.

    Raises:
        UserError: this is not a run folder, or its record is damaged or of another format.
    """
    file = Path(path) / "config.json"
    try:
        record = json.loads(file.read_text())
    except FileNotFoundError as error:
        raise UserError(f"{path} is not a run folder: there is no {file.name} in it") from error
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {file}: {error}") from error
    if not isinstance(record, dict) or record.get("format") != FORMAT or not isinstance(record.get("config"), dict):
        raise UserError(f"{file} is not the record of a run in format {FORMAT}")
    if record.get("config_hash") != config_hash(record["config"]):
        raise UserError(f"{file} was changed by hand: its configuration does not match its config_hash")
    return record


def read_metrics(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The rows of ``metrics.jsonl``, without a last line that was cut off; empty when there is none yet.

    Raises:
        UserError: a line before the last is not a row.
    """
    return _read_rows(Path(path))[0]


def read_summary(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """``summary.json`` of a run, ``None`` while the run is not finished.

    Raises:
        UserError: it is damaged.
    """
    file = Path(path) / "summary.json"
    try:
        summary = json.loads(file.read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {file}: {error}; without it --resume writes it anew") from error
    if not isinstance(summary, dict):
        raise UserError(f"{file} is not a summary; without it --resume writes it anew")
    return summary


def check_same(folder: Path, there: Any, here: Any, may_change: Sequence[str]) -> None:
    """Refuses to continue a run under another configuration.

    Args:
        folder: of the run.
        there: its configuration, from its record.
        here: the one it is to have.
        may_change: dotted names of what may differ.

    Raises:
        UserError: something else differs; it names the first such difference.
    """
    differing = {name: values for name, values in differences(there, here).items() if name not in may_change}
    if differing:
        first, (old, new) = next(iter(differing.items()))
        more = f" ({len(differing) - 1} more differ)" if len(differing) > 1 else ""
        raise UserError(
            f"{folder} was begun with {first} = {old!r}, not {new!r}"
            f"{more}: resume with the flags it was begun with, or choose another --out"
        )


def is_being_written(folder: Path) -> bool:
    """Whether a process holds the folder now; where the system has no such locks it looks as if none did."""
    if sys.platform == "win32":
        return False
    import fcntl

    # To ask is to hold it for an instant, along with any others that ask; who comes to write waits for longer.
    with contextlib.suppress(FileNotFoundError), (folder / _LOCK).open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _lock(file: IO[str], folder: Path) -> None:
    """Holds the folder for this process while the file is open. The system frees it however the process ends."""
    if sys.platform == "win32":
        return  # there are no such locks; the other checks hold
    import fcntl

    for last in (*[False] * _LOCK_TRIES, True):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError as error:
            if last:
                message = f"another process is writing to {folder}; wait for it, or choose another --out"
                raise UserError(message) from error
            time.sleep(_LOCK_PAUSE)  # it may be somebody who only looks, see `is_being_written`


def _read_rows(folder: Path) -> tuple[list[dict[str, Any]], int]:
    """The complete rows, and 1 if a half-written line follows them, else 0."""
    file = folder / "metrics.jsonl"
    if not file.exists():
        return [], 0
    lines = file.read_text(errors="replace").split("\n")
    rows = []
    for number, line in enumerate(lines[:-1], start=1):
        try:
            row = json.loads(line)
            row["env_steps"] + 0
        except (ValueError, TypeError, KeyError) as error:
            raise UserError(f"{file}, line {number}: not a row of metrics") from error
        rows.append(row)
    return rows, int(lines[-1] != "")
