"""Checkpoints of a whole training state that are either restored exactly or refused.

Orbax writes the arrays. Around it stand the parts it does not have: a manifest with the SHA-256 of every file and
every leaf, checked on each load, since a flipped bit in an array file otherwise comes back as a wrong number without an
error; the fallback to the checkpoint before a damaged one; and support for typed keys, zero-size arrays and Python
numbers. A checkpoint is a folder::

    step_000000012800/
        arrays/          what orbax writes: one entry for each non-empty leaf
        manifest.json    metadata, the description of every leaf, the SHA-256 of every file under arrays/
        manifest.sha256  the SHA-256 of manifest.json, in the format of ``sha256sum -c``

It is written under a temporary name, flushed to the disk, read back and renamed, so a folder of that name is always
complete, and older ones are deleted only then.
One process writes; several processes that save into the same folder at once are out of scope. Where several train
together, one of them saves a state that it can read all of, and each loads what belongs on its devices.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import logging
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hrlspec.checkpoint.leaves import (
    PYTHON_NUMBERS,
    Kind,
    Leaf,
    as_target,
    flatten,
    is_extended,
    kind_of,
    path_name,
    state_hash,
)
from hrlspec.version import __version__

__all__ = [
    "CheckpointDamagedError",
    "CheckpointError",
    "CheckpointMismatchError",
    "CheckpointMissingError",
    "Restored",
    "load",
    "save",
    "state_hash",
    "steps",
]

State = TypeVar("State")

FORMAT = 1
_ARRAYS, _MANIFEST, _SEAL = "arrays", "manifest.json", "manifest.sha256"
_STEP_NAME = re.compile(r"step_(\d{12,})")
_SAVING, _REPLACED = ".saving_", ".replaced_"
_PLAIN = re.compile(r"[A-Za-z0-9_./-]*")

_log = logging.getLogger("hrlspec.checkpoint")


class CheckpointError(Exception):
    """A checkpoint cannot be used. The message is one clear line."""


class CheckpointMissingError(CheckpointError):
    """There is no checkpoint where one was expected."""


class CheckpointDamagedError(CheckpointError):
    """What a checkpoint holds is not what was written."""


class CheckpointMismatchError(CheckpointError):
    """The checkpoint is intact but holds a state of another structure, shape or type."""


@dataclasses.dataclass(frozen=True)
class Restored(Generic[State]):
    """What `load` returns.

    Attributes:
        state: the restored pytree, of the structure of the target.
        step: the step it was saved at.
        metadata: what was given to `save`, with ``step`` and ``versions`` added.
        path: the folder it came from.
        skipped: one line for each newer checkpoint that was damaged, newest first.
    """

    state: State
    step: int
    metadata: dict[str, Any]
    path: Path
    skipped: tuple[str, ...]


def steps(directory: str | os.PathLike[str]) -> list[int]:
    """The steps for which ``directory`` holds a checkpoint, intact or not, in ascending order."""
    root = Path(directory)
    if not root.is_dir():
        return []
    matches = (_STEP_NAME.fullmatch(entry.name) for entry in root.iterdir())
    return sorted(int(match[1]) for match in matches if match)


def save(
    directory: str | os.PathLike[str],
    step: int,
    state: Any,
    *,
    metadata: Mapping[str, Any] | None = None,
    keep: int = 3,
) -> Path:
    """Writes ``state`` as the checkpoint of ``step`` and deletes what is no longer needed.

    A checkpoint of the same step is replaced. Checkpoints of later steps are deleted: whoever saves an earlier step
    restarted from before them, because they were damaged or on purpose, and they would win over this one at the next
    load.

    Args:
        directory: holds the checkpoints of one run; made if missing.
        step: not negative, any size.
        state: any pytree of JAX and numpy arrays, typed keys, and Python bools, ints and floats.
        metadata: JSON-compatible facts to keep with it, such as the hash of the configuration.
        keep: how many checkpoints to keep, at least 1; with 1 there is nothing to fall back to.

    Returns:
        The checkpoint's folder.

    Raises:
        ValueError: ``step`` or ``keep`` is out of range, or two leaves have the same path.
        TypeError: a leaf or the metadata cannot be stored.
        OSError: the file system refused; the checkpoints that were there are untouched.
        CheckpointDamagedError: what was written is not what is read; again they are untouched.
    """
    if step < 0 or keep < 1:
        raise ValueError(f"a checkpoint needs step >= 0 and keep >= 1, found step = {step} and keep = {keep}")
    leaves = flatten(state)
    facts = {**(metadata or {}), "step": step, "versions": _versions()}
    root = Path(directory).absolute()
    root.mkdir(parents=True, exist_ok=True)
    for leftover in (*root.glob(_SAVING + "*"), *root.glob(_REPLACED + "*")):
        shutil.rmtree(leftover)
    final = _folder(root, step)
    if not _already_saved(final, leaves, facts):
        temporary, replaced = root / f"{_SAVING}{step}", root / f"{_REPLACED}{step}"
        try:
            temporary.mkdir()
            _write(temporary, leaves, facts)
            if final.exists():
                final.rename(replaced)
            temporary.rename(final)
        except BaseException:
            if replaced.exists() and not final.exists():
                replaced.rename(final)
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _flush(root)
        shutil.rmtree(replaced, ignore_errors=True)
    present = steps(root)
    kept = [known for known in present if known <= step][-keep:]
    for known in set(present) - set(kept):
        shutil.rmtree(_folder(root, known))
    return final


def load(
    directory: str | os.PathLike[str], target: State, *, step: int | None = None, partial: bool = False
) -> Restored[State]:
    """Restores the newest intact checkpoint, or that of a given step, after checking every file and every leaf.

    A damaged checkpoint is reported by a warning of the logger ``hrlspec.checkpoint`` and in ``skipped``, and the one
    before it is tried. With ``step`` given there is no such fallback.

    Args:
        directory: where `save` wrote.
        target: a state of the expected structure, for instance a fresh one, or its `jax.eval_shape`. Numpy leaves are
            restored as numpy arrays, the others as JAX arrays, placed as the target's leaf where that is committed.
        step: the step to restore instead of the newest.
        partial: accept that the checkpoint holds more than the target, as when only ``{"params": ...}`` is wanted.

    Raises:
        CheckpointMissingError: nothing to restore there.
        CheckpointDamagedError: no intact checkpoint is left, or the one asked for is damaged.
        CheckpointMismatchError: the checkpoint does not fit the target.
    """
    root = Path(directory)
    known = steps(root)
    if not known:
        raise CheckpointMissingError(f"no checkpoint in {root}")
    if step is not None and step not in known:
        raise CheckpointMissingError(f"no checkpoint of step {step} in {root}; there are {', '.join(map(str, known))}")
    skipped: list[str] = []
    for candidate in reversed(known) if step is None else [step]:
        path = _folder(root, candidate)
        try:
            manifest = _verify(path)
            state = _restore(path, manifest["leaves"], target, partial)
        except CheckpointDamagedError as error:
            skipped.append(str(error))
            continue
        for line in skipped:
            _log.warning("%s; falling back to step %d", line, candidate)
        return Restored(state, candidate, manifest["metadata"], path, tuple(skipped))
    raise CheckpointDamagedError(f"no intact checkpoint in {root}: {'; '.join(skipped)}")


# Writing ----------------------------------------------------------------------------------------------------------


def _write(folder: Path, leaves: Mapping[str, Leaf], metadata: Mapping[str, Any]) -> None:
    """Writes arrays, manifest and seal into an empty folder and flushes them to the disk."""
    # Orbax knows the leaves by their number: paths may hold characters that mean something to it. It refuses
    # zero-size arrays, which their kind restores anyway.
    arrays = {
        str(index): _as_builtin(leaf.value)
        for index, leaf in enumerate(leaves.values())
        if isinstance(leaf.value, np.ndarray) and leaf.value.size
    }
    if arrays:
        _check_room(folder, sum(array.nbytes for array in arrays.values()))
        with _orbax(folder) as (_, checkpointer, path):
            try:
                checkpointer.save(path, arrays)
            except Exception as error:  # the storage's own, of several types
                if isinstance(error, OSError):
                    raise
                said = " ".join(str(error).split())
                number = re.search(r"os_error_code='(\d+)'", said)
                if number:
                    raise OSError(int(number[1]), os.strerror(int(number[1]))) from error
                raise OSError(errno.EIO, said[:200]) from error
        read = _read_arrays(folder)
        if read.keys() != arrays.keys() or any(read[name].tobytes() != arrays[name].tobytes() for name in arrays):
            raise CheckpointDamagedError(f"checkpoint {folder} is damaged: what was written is not what is read")
    files = {}
    for path in sorted(folder.rglob("*")):
        _flush(path)
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = _file_digest(path)
    entries = [_entry(name, leaf) for name, leaf in leaves.items()]
    text = json.dumps({"format": FORMAT, "metadata": metadata, "leaves": entries, "files": files}, indent=1).encode()
    (folder / _MANIFEST).write_bytes(text)
    (folder / _SEAL).write_bytes(_seal(text))
    for path in (folder / _MANIFEST, folder / _SEAL, folder):
        _flush(path)


def _check_room(folder: Path, size: int) -> None:
    """Raises the system's error if there is not enough room: threads of the storage would tell of theirs at length."""
    if sys.platform in ("win32", "darwin"):  # which cannot be asked
        return
    with tempfile.TemporaryFile(dir=folder) as file:
        os.posix_fallocate(file.fileno(), 0, 2 * size + 2**20)


def _entry(path: str, leaf: Leaf) -> dict[str, Any]:
    """A leaf's line in the manifest."""
    entry = {"path": path, **dataclasses.asdict(leaf.kind), "sha256": leaf.digest()}
    if isinstance(leaf.value, str):
        entry["value"] = leaf.value
    if leaf.implementation:
        entry["implementation"] = leaf.implementation
    return entry


def _already_saved(folder: Path, leaves: Mapping[str, Leaf], metadata: Mapping[str, Any]) -> bool:
    """Whether the folder is an intact checkpoint of exactly this, as after a resume that is interrupted at once."""
    try:
        manifest = _verify(folder)
    except CheckpointError:
        return False
    wanted = {"leaves": [_entry(path, leaf) for path, leaf in leaves.items()], "metadata": metadata}
    return all(manifest[name] == json.loads(json.dumps(value)) for name, value in wanted.items())


# Reading ----------------------------------------------------------------------------------------------------------


def _verify(folder: Path) -> dict[str, Any]:
    """The manifest, after checking its seal and the SHA-256 of every file it lists."""
    try:
        text = (folder / _MANIFEST).read_bytes()
        if (folder / _SEAL).read_bytes() != _seal(text):
            raise CheckpointDamagedError(f"checkpoint {folder} is damaged: {_MANIFEST} does not match {_SEAL}")
        manifest: dict[str, Any] = json.loads(text)
        if manifest["format"] != FORMAT:
            raise CheckpointMismatchError(
                f"checkpoint {folder} has format {manifest['format']}, this version of hrlspec reads format {FORMAT}"
            )
        if _folder(folder.parent, manifest["metadata"]["step"]).name != folder.name:
            raise CheckpointDamagedError(
                f"checkpoint {folder} is damaged: its content is that of step {manifest['metadata']['step']}"
            )
        for name, digest in manifest["files"].items():
            if _file_digest(folder / name) != digest:
                raise CheckpointDamagedError(f"checkpoint {folder} is damaged: {name} does not match its SHA-256")
    except OSError as error:
        raise CheckpointDamagedError(f"checkpoint {folder} is damaged: {error.filename}: {error.strerror}") from error
    return manifest


def _restore(folder: Path, entries: list[dict[str, Any]], target: State, partial: bool) -> State:
    """The state in a verified checkpoint, each leaf compared with its digest."""
    stored = {
        entry["path"]: (index, entry, Kind(entry["kind"], entry["dtype"], tuple(entry["shape"])))
        for index, entry in enumerate(entries)
    }
    with_paths, structure = jax.tree_util.tree_flatten_with_path(target)
    wanted = {path_name(path): leaf for path, leaf in with_paths}
    _check_fit(folder, {path: kind for path, (_, _, kind) in stored.items()}, wanted, partial)
    values = _read_arrays(folder)
    restored = []
    for path, like in wanted.items():
        index, entry, kind = stored[path]
        implementation = entry.get("implementation", "")
        if kind.kind in PYTHON_NUMBERS:
            leaf = Leaf(kind, entry["value"])
        elif str(index) in values:
            value = values[str(index)]
            leaf = Leaf(kind, value if implementation else value.view(np.dtype(jnp.dtype(kind.dtype))), implementation)
        else:
            leaf = Leaf(kind, _empty(kind, implementation), implementation)
        if leaf.digest() != entry["sha256"]:
            raise CheckpointDamagedError(f"checkpoint {folder} is damaged: leaf {path!r} does not match its SHA-256")
        restored.append(as_target(leaf, like))
    return jax.tree_util.tree_unflatten(structure, restored)


def _check_fit(folder: Path, stored: Mapping[str, Kind], wanted: Mapping[str, Any], partial: bool) -> None:
    """Refuses a checkpoint whose leaves are not the target's."""
    differences = [
        f"{path!r} is {kind} here and {stored.get(path, 'missing')} there"
        for path, kind in ((path, kind_of(path, leaf)) for path, leaf in wanted.items())
        if stored.get(path) != kind
    ]
    if not partial:
        differences += [f"{path!r} is missing here and {stored[path]} there" for path in stored.keys() - wanted.keys()]
    if differences:
        more = f" ({len(differences) - 1} more leaves differ)" if len(differences) > 1 else ""
        raise CheckpointMismatchError(f"checkpoint {folder} holds another state: {min(differences)}{more}")


def _read_arrays(folder: Path) -> dict[str, np.ndarray]:
    """What orbax wrote."""
    if not (folder / _ARRAYS).exists():  # every leaf is empty or a Python number
        return {}
    with _orbax(folder) as (ocp, checkpointer, arrays):
        try:
            names = checkpointer.metadata(arrays).item_metadata.tree.keys()
            as_numpy = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in names}
            return checkpointer.restore(arrays, args=ocp.args.PyTreeRestore(restore_args=as_numpy))
        except Exception as error:  # whatever orbax and its storage raise on content that they cannot read
            said = " ".join(str(error).split())[:200]
            raise CheckpointDamagedError(f"checkpoint {folder} is damaged: {said}") from error


# Small things -----------------------------------------------------------------------------------------------------


def _as_builtin(value: np.ndarray) -> np.ndarray:
    """Extended types as unsigned integers of the same width, since not every storage driver knows them."""
    return value.view(f"u{value.dtype.itemsize}") if is_extended(value.dtype) else value


def _empty(kind: Kind, implementation: str) -> np.ndarray:
    """The value of a leaf without elements."""
    if kind.kind == "array":
        return np.zeros(kind.shape, np.dtype(jnp.dtype(kind.dtype)))
    words = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0, impl=implementation))).shape
    return np.zeros((*kind.shape, *words), np.uint32)


def _folder(root: Path, step: int) -> Path:
    return root / f"step_{step:012d}"


def _seal(text: bytes) -> bytes:
    return f"{hashlib.sha256(text).hexdigest()}  {_MANIFEST}\n".encode()


def _file_digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _flush(path: Path) -> None:
    """Asks the operating system to put a file, or the entries of a folder, on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _versions() -> dict[str, str]:
    """Bits differ between versions of JAX, so a checkpoint records them."""
    return {"hrlspec": __version__, "jax": jax.__version__, "numpy": np.__version__}


@contextlib.contextmanager
def _orbax(folder: Path) -> Iterator[tuple[Any, Any, Path]]:
    """Orbax, its checkpointer, and the path of the checkpoint's arrays as orbax can be told it."""
    import orbax.checkpoint as ocp  # takes a second to import, and only checkpoints need it

    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # orbax logs through absl, to the terminal
    try:
        here = jax.process_index()  # or orbax would wait for the others
        alone = ocp.options.MultiprocessingOptions(
            primary_host=here, active_processes={here}, barrier_sync_key_prefix=f"hrlspec-{here}"
        )
        with (
            _plainly_named(folder.absolute()) as plain,
            ocp.Checkpointer(
                ocp.PyTreeCheckpointHandler(multiprocessing_options=alone), multiprocessing_options=alone
            ) as checkpointer,
        ):
            yield ocp, checkpointer, plain / _ARRAYS
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def _plainly_named(folder: Path) -> Iterator[Path]:
    """A path to the folder without what orbax and its storage read as patterns, escapes and names of services."""
    if _PLAIN.fullmatch(str(folder)):
        yield folder
        return
    with tempfile.TemporaryDirectory() as scratch:
        link = Path(scratch, "folder")
        link.symlink_to(folder, target_is_directory=True)
        yield link
