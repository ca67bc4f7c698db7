"""The host loop on a toy: rows, checkpoints, resumption to the bit, signals, divergence."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from hrlspec import checkpoint
from hrlspec.checkpoint import state_hash
from hrlspec.run import signals
from hrlspec.run.errors import Interrupted
from hrlspec.run.folder import RunFolder, open_run, read_metrics
from hrlspec.run.loop import Loop, Together
from hrlspec.run.track import PATIENCE, DivergedError, Job, Track, UnsavedError
from tests.run.made import rows

STEPS, ITERATIONS, EVERY = 8, 13, 20


@jax.jit
def step(state: dict[str, Any], index: jax.Array) -> tuple[dict[str, Any], dict[str, jax.Array]]:
    key, draw = jax.random.split(state["key"])
    params = state["params"] * 0.9 + jax.random.normal(draw, (3,)) + index
    return {"params": params, "key": key}, {"loss": params.sum(), "net/skipped": jnp.float32(0)}


def toy(**changes: Any) -> Job:
    parts: dict[str, Any] = {
        "init": lambda: {"params": jnp.zeros(3), "key": jax.random.key(5)},
        "iterate": step,
        "evaluate": lambda state, env_steps: {"eval/score": float(state["params"][0]), "eval/at": env_steps},
        "summarise": lambda sums, iterations: {name: value / iterations for name, value in sums.items()},
        "healthy": lambda state: bool(jnp.isfinite(state["params"]).all()),
        "steps_per_iteration": STEPS,
        "num_iterations": ITERATIONS,
        "evaluate_every": EVERY,
    }
    return Job(**parts | changes)


class Recorder:
    """A display that remembers, and may do something at an iteration."""

    def __init__(self, at: int = -1, action: Callable[[], None] = lambda: None) -> None:
        self.steps: list[int] = []
        self.losses: list[float] = []
        self.rows: list[Any] = []
        self._at, self._action = at, action

    def advance(self, env_steps: int, metrics: Any) -> None:
        self.steps.append(env_steps)
        self.losses.append(metrics["loss"])
        if len(self.steps) == self._at:
            self._action()

    def row(self, row: Any) -> None:
        self.rows.append(row)


@contextmanager
def loop(folder: Path, job: Job, display: Any = None, *, resume: bool = False, seconds: float = 1e9) -> Iterator[Loop]:
    with open_run(folder, {"seed": 0}, resume=resume, tensorboard=False) as run:
        yield Loop([Track(job, run, display or Recorder())], checkpoint_seconds=seconds)


def train(folder: Path, job: Job, display: Any = None, *, resume: bool = False, seconds: float = 1e9) -> Any:
    with loop(folder, job, display, resume=resume, seconds=seconds) as it:
        return it.train(it.restore())


def stop() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, list[float]]:
    """An uninterrupted run, the hash of its end, and its losses."""
    folder, display = tmp_path_factory.mktemp("loop") / "run", Recorder()
    state = train(folder, toy(), display)
    assert display.steps == [STEPS * (i + 1) for i in range(ITERATIONS)]
    return folder, state_hash(state), display.losses


def test_rows_come_where_an_evaluation_is_due(reference: tuple[Path, str, list[float]]) -> None:
    folder, _, losses = reference
    rows = read_metrics(folder)
    # Each time a multiple of 20 is passed, and at the end.
    assert [row["env_steps"] for row in rows] == [24, 40, 64, 80, 104]
    begin = 0
    for row in rows:
        end = row["env_steps"] // STEPS
        assert row["loss"] == pytest.approx(sum(losses[begin:end]) / (end - begin), rel=1e-12)
        assert row["eval/at"] == row["env_steps"]
        assert row["train/steps_per_s"] > 0
        begin = end
    assert [row["wall_s"] for row in rows] == sorted(row["wall_s"] for row in rows)
    assert checkpoint.steps(folder / "checkpoints") == [ITERATIONS * STEPS]


def test_neither_the_compiler_nor_an_evaluation_slows_the_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("hrlspec.run.loop.time.monotonic", lambda: now)

    def iterate(state: Any, index: int) -> Any:
        nonlocal now
        now += 2.0 if index else 500.0
        return step(state, index)

    def evaluate(state: Any, env_steps: int) -> dict[str, Any]:
        nonlocal now
        now += 30.0
        return {}

    train(tmp_path, toy(iterate=iterate, evaluate=evaluate))
    rows = read_metrics(tmp_path)
    assert [row["train/steps_per_s"] for row in rows] == [STEPS / 2] * 5
    assert [row["wall_s"] for row in rows] == [504, 538, 574, 608, 644]


def test_dispatch_runs_one_iteration_ahead_of_the_metrics(tmp_path: Path) -> None:
    events: list[str] = []

    def iterate(state: Any, index: int) -> Any:
        events.append(f"go {index}")
        return step(state, index)

    class Watcher(Recorder):
        def advance(self, env_steps: int, metrics: Any) -> None:
            events.append(f"got {env_steps // STEPS - 1}")

    train(tmp_path, toy(iterate=iterate, num_iterations=4, evaluate_every=10**9), Watcher())
    assert events == ["go 0", "got 0", "go 1", "go 2", "got 1", "go 3", "got 2", "got 3"]


@pytest.mark.parametrize("at", [1, 2, 3, 7, ITERATIONS - 1, ITERATIONS])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_run_goes_on_as_if_nothing_had_happened(
    tmp_path: Path, reference: tuple[Path, str, list[float]], at: int, number: signal.Signals
) -> None:
    display = Recorder(at, lambda: os.kill(os.getpid(), number))
    with pytest.raises(Interrupted, match=rf"{number.name} after .*--resume"):
        train(tmp_path, toy(), display)
    saved = checkpoint.steps(tmp_path / "checkpoints")
    assert saved
    assert saved[-1] == display.steps[-1]  # nothing is lost
    again = Recorder()
    state = train(tmp_path, toy(), again, resume=True)
    assert display.losses + again.losses == reference[2]
    assert state_hash(state) == reference[1]
    assert rows(tmp_path) == rows(reference[0])


def test_before_the_first_iteration_is_compiled_there_is_nothing_to_wait_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def iterate(state: Any, index: int) -> Any:
        if index == 0:
            stop()
        return step(state, index)

    monkeypatch.setattr(signals, "_end", said.append)
    with pytest.raises(Interrupted):  # the process would be gone
        train(tmp_path, toy(iterate=iterate))
    assert said == [f"--resume continues from what is in {tmp_path}"]


def test_a_signal_during_an_evaluation_waits_for_its_row(
    tmp_path: Path, reference: tuple[Path, str, list[float]]
) -> None:
    def evaluate(state: Any, env_steps: int) -> dict[str, Any]:
        if env_steps == 40:
            stop()
        return dict(toy().evaluate(state, env_steps))

    with pytest.raises(Interrupted, match="SIGTERM after 40 of 104 environment steps"):
        train(tmp_path, toy(evaluate=evaluate))
    assert [row["env_steps"] for row in read_metrics(tmp_path)] == [24, 40]
    assert checkpoint.steps(tmp_path / "checkpoints") == [40]
    state = train(tmp_path, toy(), resume=True)
    assert state_hash(state) == reference[1]
    assert rows(tmp_path) == rows(reference[0])


def test_a_crash_between_row_and_checkpoint_loses_no_row_and_repeats_none(
    tmp_path: Path, reference: tuple[Path, str, list[float]]
) -> None:
    def crash() -> None:
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        train(tmp_path, toy(), Recorder(8, crash), seconds=0)
    last = checkpoint.steps(tmp_path / "checkpoints")[-1]
    (folder,) = (tmp_path / "checkpoints").glob(f"*{last}")
    damaged = next(file for file in sorted(folder.rglob("*")) if file.parent.name == "d" and file.stat().st_size)
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    with loop(tmp_path, toy(), resume=True, seconds=0) as it:
        state = it.restore()
        assert it.position.done * STEPS < last
        state = it.train(state)
    assert state_hash(state) == reference[1]
    assert rows(tmp_path) == rows(reference[0])


def test_a_run_killed_before_its_first_checkpoint_begins_anew(
    tmp_path: Path, reference: tuple[Path, str, list[float]]
) -> None:
    def crash() -> None:
        raise RuntimeError

    with pytest.raises(RuntimeError):
        train(tmp_path, toy(), Recorder(6, crash))
    assert [row["env_steps"] for row in read_metrics(tmp_path)] == [24, 40]
    assert checkpoint.steps(tmp_path / "checkpoints") == []
    assert state_hash(train(tmp_path, toy(), resume=True)) == reference[1]
    assert rows(tmp_path) == rows(reference[0])


def test_checkpoints_of_another_run_are_refused(tmp_path: Path) -> None:
    train(tmp_path / "a", toy())
    with open_run(tmp_path / "b", {"seed": 1}, tensorboard=False):
        pass
    shutil.copytree(tmp_path / "a" / "checkpoints", tmp_path / "b" / "checkpoints")
    with open_run(tmp_path / "b", {"seed": 1}, resume=True, tensorboard=False) as run:
        it = Loop([Track(toy(), run, Recorder())], checkpoint_seconds=1e9)
        with pytest.raises(checkpoint.CheckpointMismatchError, match="belongs to another run"):
            it.restore()


def test_a_finished_run_becomes_longer(tmp_path: Path, reference: tuple[Path, str, list[float]]) -> None:
    """Where nothing depends on the share that is done it ends as if it had been of that length at once."""
    for length, resume in ((7, False), (9, True), (ITERATIONS, True)):
        config = {"length": length}
        with open_run(tmp_path, config, resume=resume, may_change=("length",), tensorboard=False) as run:
            it = Loop([Track(toy(num_iterations=length), run, Recorder())], checkpoint_seconds=1e9)
            state = it.train(it.restore())
    assert state_hash(state) == reference[1]
    assert [row["env_steps"] for row in read_metrics(tmp_path)] == [24, 40, 56, 64, 72, 80, 104]


@pytest.mark.parametrize("what", ["row", "checkpoint"])
def test_a_full_disk_ends_the_run_and_costs_no_more_than_the_last_steps(
    tmp_path: Path, reference: tuple[Path, str, list[float]], monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    def full(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    def fill() -> None:
        monkeypatch.setattr(*((RunFolder, "append", full) if what == "row" else (checkpoint, "save", full)))

    with pytest.raises(UnsavedError) as error:
        train(tmp_path, toy(), Recorder(4, fill), seconds=0)
    message = str(error.value)
    assert message.startswith(f"cannot write to {tmp_path} at environment step ")
    assert ": No space left on device; the last checkpoint, in " in message
    assert message.endswith("--resume goes on from there")
    monkeypatch.undo()
    assert state_hash(train(tmp_path, toy(), resume=True)) == reference[1]
    assert rows(tmp_path) == rows(reference[0])


def skipping(first: int, last: int) -> Callable[[Any, int], Any]:
    def iterate(state: Any, index: int) -> Any:
        state, metrics = step(state, index)
        return state, {**metrics, "net/skipped": jnp.float32(0.25 if first <= index < last else 0)}

    return iterate


def test_updates_skipped_for_too_long_end_the_run(tmp_path: Path) -> None:
    job = toy(iterate=skipping(5, 10**9), num_iterations=100)
    display = Recorder()
    with pytest.raises(
        DivergedError, match=rf"not finite in {PATIENCE} iterations in a row.*step {8 * 25}; nothing was"
    ):
        train(tmp_path, job, display)
    assert len(display.steps) == 5 + PATIENCE


def test_updates_skipped_now_and_then_are_counted(tmp_path: Path) -> None:
    train(tmp_path, toy(iterate=skipping(0, PATIENCE - 1), num_iterations=PATIENCE + 1, evaluate_every=10**9))
    (row,) = read_metrics(tmp_path)
    assert row["net/skipped"] == pytest.approx(0.25 * (PATIENCE - 1) / (PATIENCE + 1))


def test_parameters_that_are_not_finite_are_never_saved(tmp_path: Path) -> None:
    def iterate(state: Any, index: int) -> Any:
        state, metrics = step(state, index)
        if index == 6:
            state["params"] = state["params"] * jnp.nan
        return state, metrics

    with pytest.raises(
        DivergedError, match=r"not finite at environment step 56; the last checkpoint, .* is of step 48"
    ):
        train(tmp_path, toy(iterate=iterate), seconds=0)
    assert checkpoint.steps(tmp_path / "checkpoints")[-1] == 48


# --- Several runs side by side ---

SEEDS = (5, 6, 7)


def seed_job(seed: int, **changes: Any) -> Job:
    return toy(init=lambda: {"params": jnp.zeros(3), "key": jax.random.key(seed)}, **changes)


def jointly() -> Together:
    """A list in place of a leading axis."""

    def iterate(states: Any, index: int) -> Any:
        both = [step(state, index) for state in states]
        return [state for state, _ in both], jax.tree.map(lambda *x: jnp.stack(x), *(metrics for _, metrics in both))

    return Together(join=list, split=list, iterate=iterate)


@contextmanager
def loop_of_all(folder: Path, displays: Sequence[Any], *, resume: bool = False, seconds: float = 1e9) -> Iterator[Loop]:
    with ExitStack() as stack:
        tracks = []
        for seed, display in zip(SEEDS, displays, strict=True):
            run = open_run(folder / f"seed{seed}", {"seed": seed}, resume=resume, tensorboard=False)
            tracks.append(Track(seed_job(seed), stack.enter_context(run), display))
        yield Loop(tracks, jointly(), checkpoint_seconds=seconds)


def train_one(folder: Path, seed: int, *, resume: bool = False) -> Any:
    with open_run(folder, {"seed": seed}, resume=resume, tensorboard=False) as run:
        it = Loop([Track(seed_job(seed), run, Recorder())], checkpoint_seconds=1e9)
        return it.train(it.restore())


@pytest.fixture(scope="module")
def each_alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("alone")
    for seed in SEEDS:
        train_one(folder / f"seed{seed}", seed)
    return folder


def assert_as_alone(folder: Path, each_alone: Path) -> None:
    """Rows, and the checkpoints that an ordinary run would have left."""
    for seed in SEEDS:
        here, there = folder / f"seed{seed}", each_alone / f"seed{seed}"
        assert rows(here) == rows(there)
        states = [checkpoint.load(one / "checkpoints", seed_job(seed).init()) for one in (here, there)]
        assert state_hash(states[0].state) == state_hash(states[1].state)
        for some in states:
            for name in ("wall", "training"):
                del some.metadata["position"][name]
        assert states[0].metadata == states[1].metadata


def test_runs_side_by_side_are_those_alone(tmp_path: Path, each_alone: Path) -> None:
    displays = [Recorder() for _ in SEEDS]
    with loop_of_all(tmp_path, displays) as it:
        it.train(it.restore())
    assert_as_alone(tmp_path, each_alone)
    for display in displays:
        assert display.steps == [STEPS * (i + 1) for i in range(ITERATIONS)]
        assert [row["env_steps"] for row in display.rows] == [24, 40, 64, 80, 104]
    assert len({tuple(display.losses) for display in displays}) == len(SEEDS)


def test_stopped_side_by_side_they_go_on_alone_and_together(tmp_path: Path, each_alone: Path) -> None:
    """After a signal all stand at the same step; each of them is an ordinary run."""
    with (
        pytest.raises(Interrupted, match=rf"in each of {tmp_path}/seed5 to {tmp_path}/seed7, --resume"),
        loop_of_all(tmp_path, [Recorder(), Recorder(5, stop), Recorder()]) as it,
    ):
        it.train(it.restore())
    stopped = [checkpoint.steps(tmp_path / f"seed{seed}" / "checkpoints") for seed in SEEDS]
    assert stopped == [stopped[0]] * len(SEEDS)
    shutil.copytree(tmp_path, tmp_path / "copy")
    for seed in SEEDS:
        train_one(tmp_path / "copy" / f"seed{seed}", seed, resume=True)
    assert_as_alone(tmp_path / "copy", each_alone)
    with loop_of_all(tmp_path, [Recorder() for _ in SEEDS], resume=True) as it:
        it.train(it.restore(stopped[0][-1]))
    assert_as_alone(tmp_path, each_alone)


def test_killed_between_their_checkpoints_they_go_on_from_the_last_that_all_have(
    tmp_path: Path, each_alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save, killed = checkpoint.save, []

    def second_of_the_last(folder: Path, step: int, *args: Any, **kwargs: Any) -> Path:
        if step == 48 and "seed6" in str(folder):
            killed.append(step)
            raise RuntimeError("killed")
        return save(folder, step, *args, **kwargs)

    monkeypatch.setattr(checkpoint, "save", second_of_the_last)
    with (
        pytest.raises(RuntimeError, match="killed"),
        loop_of_all(tmp_path, [Recorder() for _ in SEEDS], seconds=0) as it,
    ):
        it.train(it.restore())
    monkeypatch.undo()
    newest = [checkpoint.steps(tmp_path / f"seed{seed}" / "checkpoints")[-1] for seed in SEEDS]
    assert newest == [48, 40, 40]
    with loop_of_all(tmp_path, [Recorder() for _ in SEEDS], resume=True) as it:
        state = it.restore(40)
        assert it.position.done == 5
        it.train(state)
    assert_as_alone(tmp_path, each_alone)


def test_one_of_them_that_diverges_is_named(tmp_path: Path) -> None:
    """All stop: the others have been saved until then."""
    with loop_of_all(tmp_path, [Recorder() for _ in SEEDS], seconds=0) as it:
        iterate = it._iterate

        def poisoned(states: Any, index: int) -> Any:
            states, metrics = iterate(states, index)
            if index == 6:
                states[1]["params"] = states[1]["params"] * jnp.nan
            return states, metrics

        it._iterate = poisoned
        with pytest.raises(DivergedError, match=r"step 56; the last checkpoint, in .*seed6, is of step 48; try"):
            it.train(it.restore())
