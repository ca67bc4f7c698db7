"""Whatever is wrong with the input of ``hrlspec.run.commands.run``: one clear line, status 2, nothing written."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from hrlspec.config import evolve
from hrlspec.methods import METHODS
from hrlspec.presets import PRESETS, RewardSet, preset
from hrlspec.run.commands import run
from hrlspec.run.configuration import config_hash
from hrlspec.run.errors import UserError, main_guard
from hrlspec.run.experiment import Experiment, experiment_of
from hrlspec.run.folder import open_run
from hrlspec.run.run_flags import experiments_of, parse_run, schedules_moved
from tests.run.made import contents

ROOT = Path(__file__).parents[2]

BAD_FLAGS = [
    ("--env zones", "unknown environment 'zones', expected one of letter, letter12"),
    ("--env conveyor-33", "environment 'conveyor-33': k is 33, expected 1 to 32"),
    ("--env", "Missing value for argument '--env'"),
    ("--env nowhere:make", "nowhere:make cannot be used: ModuleNotFoundError: No module named 'nowhere'"),
    ("--env os:nothing", "module 'os' has no attribute 'nothing'"),
    ("--env os:sep", "os:sep is of type str, expected an environment"),
    ("--env math:sqrt", "math:sqrt cannot be used: TypeError: "),
    ("--env :", "Empty module name"),
    ("--method best", "unknown method 'best', expected one of ours, ltl2action"),
    ("--method envs_jax:Letter", "is of type Letter, expected a value of a subclass of hrlspec.methods.Method"),
    ("--recipe secret", "'--recipe'"),
    ("--reward-set 3", "'--reward-set'"),
    ("--seed x", "--seed"),
    ("--seed -1", "--seed is -1"),
    ("--seed 1.5", "--seed"),
    ("--seed 99999999999", "--seed is 99999999999"),
    ("--num-seeds 0", "--num-seeds is 0, expected at least 1"),
    ("--seed 2147483647 --num-seeds 2", "--num-seeds is 2, expected the last seed to be at most 2147483647"),
    ("--parallel-seeds", "--parallel-seeds is True, expected --num-seeds of 2 or more with it"),
    ("--num-seeds 2 --parallel-seeds --no-parallel-seeds", "expected no --no-parallel-seeds with it"),
    ("--num-seeds 2 --parallel-seeds --distributed auto", "--parallel-seeds is True, expected no --distributed: one"),
    ("--num-seeds 3 --parallel-seeds --devices 2", "--devices is 2, expected a divisor of 3, the number of seeds"),
    ("--num-seeds 2 --parallel-seeds --out missing --resume", "no run to resume in missing/seed0"),
    ("--total-steps 0", "--total-steps is 0, expected a number from 1 to"),
    ("--total-steps many", "--total-steps: found 'many', expected a whole number"),
    ("--total-steps 1.5e0", "--total-steps: found '1.5e0', expected a whole number"),
    (
        "--total-steps 10000000000000000000",
        "--total-steps is 10000000000000000000, expected a number from 1 to 109951162",
    ),
    ("--env [bold]zone", "unknown environment '[bold]zone'"),
    ("--total-steps -5", "total-steps is -5"),
    ("--devices 0", "--devices is 0, expected at least 1"),
    ("--devices few", "--devices: "),
    ("--config.blocks 2 --devices 3", "--devices is 3, expected a divisor of 2, the number of --config.blocks"),
    ("--config.blocks 3", "--config.blocks is 3, expected a divisor of 128, the number of environments"),
    ("--num-processes 2", "--num-processes is 2, expected --distributed HOST:PORT with it"),
    ("--distributed auto --process-id 0", "--process-id is 0, expected --distributed HOST:PORT with it"),
    ("--distributed auto", "--distributed auto: "),
    ("--distributed here", "--distributed is 'here', expected auto or HOST:PORT"),
    ("--distributed a:1 --num-processes 2", "--distributed is a:1, expected --num-processes and --process-id with it"),
    ("--distributed a:1 --num-processes 2 --process-id 2", "--process-id is 2, expected less than 2, the number of"),
    ("--checkpoint-minutes -1", "--checkpoint-minutes is -1"),
    ("--checkpoint-minutes nan", "--checkpoint-minutes is nan"),
    ("--no-such-flag", "Unrecognized options: --no-such-flag"),
    ("stray", "Unrecognized options: stray"),
    ("--config.num-envs 0", "--config.num-envs is 0"),
    ("--config.num-envs 2.5", "--config.num-envs"),
    ("--config.num-steps 1", "--config.num-steps is 1"),
    ("--config.discount 1.5", "--config.discount is 1.5"),
    ("--config.discount nan", "--config.discount is nan"),
    ("--config.network.task-scale 0", "--config.network.task-scale is 0"),
    ("--config.shield.enabled maybe", "Unrecognized options: maybe"),
    ("--config.shield.threshold 2", "--config.shield.threshold is 2"),
    ("--config.relabel.share -0.1", "--config.relabel.share is -0.1"),
    ("--config.curriculum.levels 0", "--config.curriculum.levels is 0"),
    ("--config.curriculum.levels 40", "--config.curriculum.max-nodes is 16, expected at least levels + 2, 42"),
    ("--config.curriculum.promotion 95", "--config.curriculum.promotion is 95"),
    ("--config.curriculum.max-nodes 3", "--config.curriculum.max-nodes is 3"),
    ("--config.low.optimiser.epochs 0", "--config.low.optimiser.epochs is 0"),
    ("--config.low.optimiser.minibatches 0", "--config.low.optimiser.minibatches is 0, expected at least 1"),
    (
        "--config.low.optimiser.minibatches 7",
        "--config.low.optimiser.minibatches is 7, expected a divisor of 80",
    ),
    ("--method.high.ppo.optimiser.minibatches 1000", "--method.high.ppo.optimiser.minibatches is 1000, expected a div"),
    ("--method.high.ppo.optimiser.learning-rate -1", "--method.high.ppo.optimiser.learning-rate is -1"),
    ("--config.low.optimiser.learning-rate inf", "--config.low.optimiser.learning-rate is inf"),
    ("--config.low.dual-clip 1.1", "--config.low.dual-clip is 1.1, expected at least 1 + clip, 1.2"),
    ("--config.network.latent 0", "--config.network.latent is 0"),
    ("--config.network.actor 64 -64", "--config.network.actor"),
    ("--config.num-evns 8", "Unrecognized options: --config.num-evns"),
    ("--method ltl2action --method.high.transe 0", "Unrecognized options: --method.high.transe"),
    ("--method option --no-transe", "--no-transe: the method option has no such technique"),
    ("--method ltl2action --no-max-operator", "--no-max-operator: the method ltl2action has no such technique"),
    ("--evaluation.every 0", "--evaluation.every is 0"),
    ("--evaluation.episodes 15", "--evaluation.episodes is 15"),
    ("--evaluation.contested 7", "--evaluation.contested is 7"),
    ("--out file", "file is a file"),
    ("--out full", "full is not empty and holds no run"),
    ("--out file/below", "file"),
    ("--out missing --resume", "no run to resume in missing"),
    ("--resume", "no run to resume in runs"),
    ("--num-seeds 2 --out missing --resume", "no run to resume in missing/seed0"),
    ("--out other", "other holds a run already: continue it with --resume"),
    ("--out other --resume", "other was begun with seed = 7, not 0"),
    ("--out other --seed 7 --resume --total-steps 100", "other was begun with --total-steps 2500000: give more, or"),
    ("--out other --seed 7 --resume --config.total-steps 9999999", "config.total_steps = 2500000, not 9999999"),
    ("--out damaged --resume", "cannot read damaged"),
    (f"--out {'n' * 300}", "cannot write to nnn"),
    ("--out gs://bucket/run", "--out is gs:/bucket/run, expected a path on this machine"),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with things that are in the way; no test changes it."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "file").write_text("x")
    (folder / "full").mkdir()
    (folder / "full" / "thesis.tex").write_text("x")
    ((other, path),) = experiments_of(parse_run(["--seed", "7", "--out", str(folder / "other")]))
    with open_run(path, other, tensorboard=False):
        pass
    (folder / "damaged").mkdir()
    (folder / "damaged" / "config.json").write_text("{")
    return folder


@pytest.mark.parametrize(("flags", "message"), BAD_FLAGS, ids=[flags for flags, _ in BAD_FLAGS])
def test_bad_input(
    flags: str, message: str, place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    before = contents(place)
    assert main_guard(lambda: run.main(flags.split())) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert message in err
    assert contents(place) == before


def test_bad_input_in_a_process_of_its_own(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "experiments.run", "--out", str(tmp_path / "x"), "--seed", "-1"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert ended.stderr == (
        "error: --seed is -1, expected a number from 0 to 2147483647 (see python -m experiments.run --help)\n"
    )
    assert not (tmp_path / "x").exists()


def test_help_shows_the_settings_of_what_was_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    def shown(*flags: str) -> str:
        with pytest.raises(SystemExit) as stop:
            parse_run([*flags, "--help"], program="hrlspec run")
        assert stop.value.code == 0
        return " ".join(capsys.readouterr().out.split())

    out = shown("--recipe", "paper")
    assert out.startswith("usage: hrlspec run ")
    for said in (*PRESETS, *(f"{method.name}: {method.about}" for method in METHODS.values())):
        assert said in out
    assert "any other as --env module:factory" in out
    assert "any other as --method module:VALUE" in out
    assert "--config.relabel.share" in out
    assert "--no-shield" in out
    assert "--method.high.transe" in out
    option = shown("--method", "option")
    assert "--method.high.decay" in option
    assert "--method.high.transe" not in option


@pytest.mark.parametrize(("env", "steps"), [("letter", 1), ("walk", 6), ("zone", 6)])
def test_how_near_the_shield_lets_one_come(env: str, steps: int) -> None:
    """The reach critic's value k steps from a region is discount^(k - 1)."""
    shield = preset(env).settings("ours", "paper")[0].shield
    assert shield.discount ** (steps - 1) > shield.threshold > shield.discount**steps


@pytest.mark.parametrize("env", ["letter", pytest.param("letter12", marks=pytest.mark.slow), "walk", "zone"])
@pytest.mark.parametrize("recipe", ["paper", "hrlspec"])
@pytest.mark.parametrize("method", METHODS)
def test_every_preset_is_accepted(env: str, recipe: Any, method: str) -> None:
    reward_sets: tuple[RewardSet, ...] = (1, 2)
    for reward_set in reward_sets:
        flags = ["--env", env, "--recipe", recipe, "--method", method, f"--reward-set={reward_set}"]
        parsed = parse_run(flags)
        assert (parsed.config, parsed.method_settings) == preset(env).settings(method, recipe, reward_set)
        ((experiment, folder),) = experiments_of(parsed)
        assert str(folder) == f"runs/{env}-{method}-{recipe}-set{reward_set}-seed0"
        assert experiment_of(json.loads(json.dumps(dataclasses.asdict(experiment))), "here") == experiment


def test_switches_and_overrides() -> None:
    def made(*flags: str) -> Experiment:
        return experiments_of(parse_run(flags))[0][0]

    plain = made()
    assert (plain.config, plain.method_settings) == preset("letter").settings()

    def changed(config: Mapping[str, Any], high: Mapping[str, Any]) -> Experiment:
        method = plain.method_settings.replace(**high)
        return dataclasses.replace(plain, config=evolve(plain.config, config), method_settings=method)

    assert made("--no-shield", "--recipe", "paper").config.shield.enabled is False
    assert made("--no-max-operator", "--recipe", "paper").method_settings.high.max_operator is False
    assert made("--no-transe") == changed({}, {"transe": 0.0})
    # Minibatches are as large as before, a fifth of whose rows were copies.
    assert plain.config.low.optimiser.minibatches == 40
    without = changed({"relabel.share": 0.0, "low.optimiser.minibatches": 32}, {})
    assert made("--no-relabel") == without
    assert made("--config.relabel.share", "0", "--config.low.optimiser.minibatches", "32") == without
    assert made("--total-steps", "1e6") == made("--total-steps", "1000000")
    assert made("--evaluation.every", "5E4").evaluation.every == 50_000
    assert made("--total-steps", "7") == changed({"total_steps": 7}, {}) == made("--config.total-steps", "7")
    assert made("--method.high.transe-margin", "3") == changed({}, {"transe_margin": 3.0})
    curriculum = made("--no-curriculum").config.curriculum
    assert curriculum.promotion == curriculum.window == 0
    assert curriculum.earlier == pytest.approx(1 - 1 / curriculum.levels)


def test_what_a_longer_run_does_to_schedules() -> None:
    def said(*flags: str) -> str:
        return schedules_moved(experiments_of(parse_run([*flags, "--total-steps", str(2 * 10 * 8192)]))[0][0], 10, 10)

    sizes = "--config.num-envs", "128", "--config.num-steps", "64"
    assert said(*sizes) == (
        "--config.low.entropy from 0.004 to 0.012, --config.low.entropy-floor from 0.03 to 0.075, "
        "--config.low.optimiser.learning-rate from 0 to 0.00035, "
        "--method.high.ppo.optimiser.learning-rate from 0 to 0.00015"
    )
    assert "floor" not in said(*sizes, "--config.low.entropy-floor", "0")
    assert said(*sizes, "--method", "option", "--config.low.entropy", "0.1", "--config.low.final-entropy", "0.1") == (
        "--config.low.entropy-floor from 0.03 to 0.075, --config.low.optimiser.learning-rate from 0 to 0.0007"
    )


def test_no_curriculum_reaches_the_last_level_at_once() -> None:
    import jax.numpy as jnp

    from hrlspec.tasks import curriculum

    config = experiments_of(parse_run(["--no-curriculum"]))[0][0].config.curriculum
    state = curriculum.initial()
    for _ in range(config.levels - 1):
        state = curriculum.update(state, jnp.int32(0), jnp.int32(0), config)
    assert int(state.level) == config.levels - 1


def test_several_seeds_have_folders_of_their_own() -> None:
    runs = experiments_of(parse_run(["--seed", "5", "--num-seeds", "3", "--out", "here"]))
    assert [(experiment.seed, str(folder)) for experiment, folder in runs] == [
        (5, "here/seed5"),
        (6, "here/seed6"),
        (7, "here/seed7"),
    ]
    runs = experiments_of(parse_run(["--num-seeds", "2"]))
    assert [folder.name for _, folder in runs] == ["letter-ours-hrlspec-set1-seed0", "letter-ours-hrlspec-set1-seed1"]


def test_records_of_other_versions_are_refused() -> None:
    ((experiment, _),) = experiments_of(parse_run([]))
    record = json.loads(json.dumps(dataclasses.asdict(experiment)))
    assert len(config_hash(record)) == 64
    settings = record["method_settings"]
    for changed, message in [
        ({**record, "extra": 1}, "the setting 'extra'"),
        ({name: record[name] for name in record if name != "seed"}, "the setting 'seed'"),
        ({**record, "config": {**record["config"], "zeta": 1}}, "the setting 'config.zeta'"),
        ({**record, "config": 3}, "config is 3"),
        ({**record, "method_settings": {**settings, "zeta": 1}}, "the setting 'method_settings.zeta'"),
        ({**record, "method_settings": {"high": {}}}, "the setting 'method_settings.high."),
        ({**record, "seed": "0"}, "seed is '0'"),
        ({**record, "recipe": "stew"}, "recipe is 'stew'"),
        ({**record, "method": "magic"}, "there is a run that cannot be read here: unknown method 'magic'"),
        ({**record, "env": "nowhere"}, "there is a run that cannot be read here: unknown environment 'nowhere'"),
        ({**record, "config": {**record["config"], "num_envs": 0}}, "Config.num_envs is 0, expected at least 1"),
    ]:
        with pytest.raises(UserError, match=message):
            experiment_of(changed, "there")
