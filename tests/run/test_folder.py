"""A run folder belongs to one run and one process, and no row of metrics is lost or written twice."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.proto import event_pb2
from tensorboardX.record_writer import RecordWriter

from hrlspec.run.configuration import config_hash
from hrlspec.run.errors import UserError
from hrlspec.run.folder import open_run, read_metrics, read_record, read_summary
from tests.run.made import contents

ROOT = Path(__file__).parents[2]


@dataclasses.dataclass(frozen=True)
class Network:
    sizes: tuple[int, ...] = (64, 32)


@dataclasses.dataclass(frozen=True)
class Config:
    seed: int = 0
    total_steps: int = 10
    rate: float = 1e-3
    network: Network = Network()


def events(file: Path) -> list[event_pb2.Event]:
    """The records of an event file: length, its checksum, content, its checksum."""
    found, content = [], file.read_bytes()
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        found.append(event_pb2.Event.FromString(content[12 : 12 + length]))
        content = content[16 + length :]
    return found


def scalars(file: Path) -> list[tuple[int, float]]:
    return [(event.step, value.simple_value) for event in events(file) for value in event.summary.value]


def test_a_new_run_records_what_it_is(tmp_path: Path) -> None:
    with open_run(tmp_path / "a" / "run", Config()) as run:
        assert not run.resumed
        assert run.checkpoints == tmp_path / "a" / "run" / "checkpoints"
        assert run.plots.is_dir()
        run.write_summary({"env_steps": 10, "success": np.float32(0.5), "by_depth": {2: jnp.ones(2)}})
    record = read_record(run.path)
    assert record["config"] == run.config
    assert run.config == {"seed": 0, "total_steps": 10, "rate": 1e-3, "network": {"sizes": [64, 32]}}
    assert record["config_hash"] == run.config_hash == config_hash(run.config)
    assert {"hrlspec", "jax", "numpy", "python"} <= record["versions"].keys()
    assert record["commit"] is None or len(record["commit"].removesuffix("+changes")) == 40
    assert json.loads((run.path / "summary.json").read_text()) == {
        "env_steps": 10,
        "success": 0.5,
        "by_depth": {"2": [1.0, 1.0]},
    }


def test_the_commit_is_that_of_the_code_not_of_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    head = subprocess.run(["git", "-C", str(ROOT), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    if head.returncode:
        pytest.skip("not a git checkout")
    with open_run("run", Config()):
        pass
    assert read_record("run")["commit"].removesuffix("+changes") == head.stdout.strip()


def test_the_hash_depends_on_values_not_on_order() -> None:
    assert config_hash({"a": 1, "b": {"c": 2, "d": 3}}) == config_hash({"b": {"d": 3, "c": 2}, "a": 1})
    assert config_hash({"a": 1}) != config_hash({"a": 2})


def test_rows_are_plain_json_and_go_to_tensorboard(tmp_path: Path) -> None:
    with open_run(tmp_path, Config()) as run:
        run.append({"env_steps": 0, "loss": float("nan"), "eval/by_depth": {"2": np.array([0.5])}})
        run.append({"env_steps": np.int64(2**33), "loss": jnp.float32(0.25), "method": "ours"})
    lines = (tmp_path / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line, parse_constant=pytest.fail) for line in lines] == read_metrics(tmp_path)
    assert read_metrics(tmp_path) == [
        {"env_steps": 0, "loss": None, "eval/by_depth": {"2": [0.5]}},
        {"env_steps": 2**33, "loss": 0.25, "method": "ours"},
    ]
    (file,) = (tmp_path / "tensorboard").iterdir()
    assert scalars(file) == [(2**33, 0.25)]


def test_records_of_event_files_are_those_of_the_library(tmp_path: Path) -> None:
    with open_run(tmp_path / "run", Config()) as run:
        run.append({"env_steps": 3, "loss": 0.5})
    (file,) = (tmp_path / "run" / "tensorboard").iterdir()
    writer = RecordWriter(str(tmp_path / "expected"))
    for event in events(file):
        writer.write(event.SerializeToString())
    writer.close()
    assert file.read_bytes() == (tmp_path / "expected").read_bytes()
    assert "tfevents" in file.name


def test_event_files_that_cannot_be_written_stop_nothing(tmp_path: Path) -> None:
    with open_run(tmp_path, Config()) as run:
        run.append({"env_steps": 1, "loss": 0.5})
        (file,) = (tmp_path / "tensorboard").iterdir()
        file.rename(tmp_path / "before")
        file.mkdir()
        for step in range(2, 40):
            run.append({"env_steps": step, "loss": 0.5})
    assert len(read_metrics(tmp_path)) == 39
    assert scalars(tmp_path / "before") == [(1, 0.5)]


def test_bad_rows_are_bugs(tmp_path: Path) -> None:
    with open_run(tmp_path, Config(), tensorboard=False) as run:
        run.append({"env_steps": 5})
        with pytest.raises(ValueError, match="needs an integer env_steps"):
            run.append({"loss": 1.0})
        with pytest.raises(ValueError, match="env_steps 4 after one of 5"):
            run.append({"env_steps": 4})
        with pytest.raises(TypeError, match="no form in JSON"):
            run.append({"env_steps": 6, "what": object()})
    assert read_metrics(tmp_path) == [{"env_steps": 5}]
    assert not (tmp_path / "tensorboard").exists()


def test_a_resumed_run_has_each_row_once(tmp_path: Path) -> None:
    with open_run(tmp_path, Config()) as run:
        for step in (0, 10, 20, 30):
            run.append({"env_steps": step, "process": 1})
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 40, "pro')  # killed while writing
    assert [row["env_steps"] for row in read_metrics(tmp_path)] == [0, 10, 20, 30]
    with open_run(tmp_path, Config(), resume=True) as run:
        assert run.resumed
        with pytest.raises(RuntimeError, match="rewind"):
            run.append({"env_steps": 20})
        assert run.rewind(10) == 3
        for step in (20, 30):
            run.append({"env_steps": step, "process": 2})
    rows = [(row["env_steps"], row["process"]) for row in read_metrics(tmp_path)]
    assert rows == [(0, 1), (10, 1), (20, 2), (30, 2)]
    record = read_record(tmp_path)
    assert set(record["earlier"][0]) == set(record) - {"format", "config", "earlier"}
    first, second = sorted((tmp_path / "tensorboard").iterdir(), key=lambda file: file.suffix)
    assert [step for step, _ in scalars(first)] == [0, 10, 20, 30]
    assert scalars(second) == [(20, 2.0), (30, 2.0)]
    # TensorBoard drops what earlier files hold from the step of this record on.
    assert [event.step for event in events(second) if event.HasField("session_log")] == [11]
    with open_run(tmp_path, Config(), resume=True) as run:
        assert run.rewind(-1) == 4
        run.append({"env_steps": 0})
    assert read_metrics(tmp_path) == [{"env_steps": 0}]
    assert len(read_record(tmp_path)["earlier"]) == 2


def test_another_run_is_never_touched(tmp_path: Path) -> None:
    with open_run(tmp_path, Config()) as run:
        run.append({"env_steps": 1})
    before = contents(tmp_path)
    for config in (Config(), Config(seed=1)):
        with (
            pytest.raises(UserError, match="holds a run already: continue it with --resume"),
            open_run(tmp_path, config),
        ):
            pass
    with (
        pytest.raises(UserError, match="begun with seed = 0, not 1: "),
        open_run(tmp_path, Config(seed=1), resume=True),
    ):
        pass
    other = Config(seed=1, network=Network((1,)))
    with (
        pytest.raises(UserError, match=r"network.sizes = \[64, 32\], not \[1\] \(1 more differ\)"),
        open_run(tmp_path, other, resume=True),
    ):
        pass
    assert contents(tmp_path) == before


def test_what_may_change_is_recorded(tmp_path: Path) -> None:
    with open_run(tmp_path, Config()) as run:
        run.write_summary({"env_steps": 10})
        first = run.config_hash
        assert run.earlier_hashes == frozenset()
    for _ in range(2):  # as it was, it needs no leave to change
        with open_run(tmp_path, Config(total_steps=20), resume=True, may_change=("total_steps",)) as run:
            run.rewind(-1)
            assert first in run.earlier_hashes
            assert first != run.config_hash
    record = read_record(tmp_path)
    assert record["config"]["total_steps"] == 20
    assert [entry.get("changed") for entry in record["earlier"]] == [{"total_steps": 10}, None]
    assert read_summary(tmp_path) is None  # the results of a shorter run are not this one's
    assert json.loads((tmp_path / "summary-10.json").read_text()) == {"env_steps": 10}


def test_places_that_are_refused_stay_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    before = contents(tmp_path)
    for name, resume, message in [
        ("file", False, "cannot write to .*file: .*file is a file, not a folder"),
        ("file/below", False, "cannot write to .*below: .*file is a file, not a folder"),
        ("full", False, "is not empty and holds no run"),
        ("full", True, "no run to resume"),
        ("missing", True, "no run to resume"),
        ("n" * 300, False, "cannot write to .*: File name too long"),
        ("new/" + "n" * 300, False, "cannot write to .*: File name too long"),
        ("new/" + "n" * 250 + "/n" * 2000, False, "cannot write to .*: File name too long"),
    ]:
        with pytest.raises(UserError, match=message), open_run(tmp_path / name, Config(), resume=resume):
            pass
    assert contents(tmp_path) == before
    assert not (tmp_path / "missing").exists()


def test_a_folder_without_permission_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, *args: object, **kwargs: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)  # modes do not bind a superuser
    with pytest.raises(UserError, match=r"run: Permission denied"), open_run(tmp_path / "run", Config()):
        pass


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("failing", ["config.json", "events"])
def test_what_cannot_begin_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: bool, failing: str
) -> None:
    """Such as on a disk that is full."""

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    folder = tmp_path / "a" / "b"
    if there:
        folder.mkdir(parents=True)
    before = contents(tmp_path)
    if failing == "config.json":
        monkeypatch.setattr(os, "fsync", full)
    else:
        monkeypatch.setattr("hrlspec.run.events.EventFile.__init__", full)
    with pytest.raises(UserError, match=r"cannot write to .*b: No space left on device"), open_run(folder, Config()):
        pass
    assert contents(tmp_path) == before
    assert folder.exists() == (tmp_path / "a").exists() == there


def test_an_error_inside_is_not_dressed_up(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), open_run(tmp_path, Config()):
        raise FileNotFoundError


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "cannot read"),
        ("[]", "not the record of a run"),
        ('{"format": 99, "config": {}}', "not the record of a run"),
        ('{"format": 1, "config": 3}', "not the record of a run"),
        ('{"format": 1, "config": {"seed": 7}, "config_hash": "0"}', "changed by hand"),
        ("\ud800", "cannot read"),
    ],
)
def test_damaged_records_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "config.json").write_bytes(text.encode(errors="surrogatepass"))
    with pytest.raises(UserError, match=message):
        read_record(tmp_path)
    with pytest.raises(UserError, match=message), open_run(tmp_path, Config(), resume=True):
        pass


def test_folders_that_are_not_runs(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a run folder"):
        read_record(tmp_path)
    assert read_metrics(tmp_path) == []
    (tmp_path / "metrics.jsonl").write_text('{"env_steps": 1}\nnonsense\n{"env_steps": 2}\n')
    with pytest.raises(UserError, match="line 2: not a row"):
        read_metrics(tmp_path)


HOLDER = """
import sys, time
from hrlspec.run.folder import open_run
with open_run(sys.argv[1], {"seed": 0}, tensorboard=False) as run:
    run.append({"env_steps": 1})
    print("open", flush=True)
    time.sleep(60)
"""


def test_two_processes_never_write_the_same_folder(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=dict(os.environ, JAX_PLATFORMS="cpu"),
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "open\n"
        with pytest.raises(UserError, match="another process is writing"), open_run(tmp_path, {"seed": 0}, resume=True):
            pass
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    # The lock of a killed process is gone.
    with open_run(tmp_path, {"seed": 0}, resume=True, tensorboard=False) as run:
        assert run.rewind(1) == 0
    assert read_metrics(tmp_path) == [{"env_steps": 1}]


def test_a_process_killed_at_its_start_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    (tmp_path / ".lock").touch()
    (tmp_path / ".config.new.json").write_text("{")
    with open_run(tmp_path, Config()) as run:
        assert not run.resumed
