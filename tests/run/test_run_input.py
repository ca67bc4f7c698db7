"""Whatever is wrong with the input of ``hrlspec.run.commands.run``: one clear line, status 2, nothing written."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest

from hrlspec.presets.settings import preset
from hrlspec.run.commands import run
from hrlspec.run.errors import UserError, main_guard
from hrlspec.run.experiment import RunFlags, check_config, experiment_of, experiments_of, parse_run
from hrlspec.run.folder import config_hash, open_run

ROOT = Path(__file__).parents[2]

BAD_FLAGS = [
    ("--env zones", "'zones' for argument '--env'"),
    ("--env", "Missing value for argument '--env'"),
    ("--method best", "'--method'"),
    ("--recipe secret", "'--recipe'"),
    ("--reward-set 3", "'--reward-set'"),
    ("--seed x", "--seed"),
    ("--seed -1", "--seed is -1"),
    ("--seed 1.5", "--seed"),
    ("--seed 99999999999", "--seed is 99999999999"),
    ("--num-seeds 0", "--num-seeds is 0"),
    ("--total-steps 0", "--config.total-steps is 0"),
    ("--total-steps many", "--total-steps"),
    ("--total-steps -5", "total-steps is -5"),
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
    ("--config.shield.mode maybe", "--config.shield.mode"),
    ("--config.shield.threshold 2", "--config.shield.threshold is 2"),
    ("--config.relabel.share -0.1", "--config.relabel.share is -0.1"),
    ("--config.curriculum.levels 0", "--config.curriculum.levels is 0"),
    ("--config.curriculum.levels 40", "--config.curriculum.max-nodes is 16, expected at least 42"),
    ("--config.curriculum.promotion 95", "--config.curriculum.promotion is 95"),
    ("--config.curriculum.max-nodes 3", "--config.curriculum.max-nodes is 3"),
    ("--config.low.epochs 0", "--config.low.epochs is 0"),
    ("--config.low.minibatches 0", "--config.low.minibatches is 0"),
    ("--config.low.minibatches 7 --config.num-envs 64", "--config.low.minibatches is 7, expected a divisor of"),
    ("--config.high.minibatches 1000000", "--config.high.minibatches is 1000000, expected a divisor of"),
    ("--config.high.learning-rate -1", "--config.high.learning-rate is -1"),
    ("--config.low.learning-rate inf", "--config.low.learning-rate is inf"),
    ("--config.low.most-ratio 1.1", "--config.low.most-ratio is 1.1, expected a number from 1.2 to"),
    ("--config.network.latent 0", "--config.network.latent is 0"),
    ("--config.network.actor 64 -64", "--config.network.actor"),
    ("--config.num-evns 8", "Unrecognized options: --config.num-evns"),
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
    ("--out damaged --resume", "cannot read damaged"),
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


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


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
    command = [sys.executable, "-m", "experiments.run", "--out", str(tmp_path / "x"), "--config.shield.mode", "maybe"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (2, "", 1)
    assert ended.stderr.startswith("error: invalid choice 'maybe' for argument '--config.shield.mode'")
    assert not (tmp_path / "x").exists()


def test_help_shows_the_preset_of_the_chosen_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        parse_run(["--recipe", "paper", "--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert "--config.relabel.share" in out
    assert "--no-shield" in out


@pytest.mark.parametrize(("env", "steps"), [("letter", 1), ("walk", 6), ("zone", 6)])
def test_how_near_the_shield_lets_one_come(env: str, steps: int) -> None:
    """The reach critic's value k steps from a region is discount^(k - 1)."""
    shield = preset(env, "paper", 1, "ours").shield
    assert shield.discount ** (steps - 1) > shield.threshold > shield.discount**steps


@pytest.mark.parametrize("env", ["letter", "letter12", "walk", "zone"])
@pytest.mark.parametrize("recipe", ["paper", "hrlspec"])
@pytest.mark.parametrize("method", ["ours", "ltl2action", "option", "myopic-low", "no-er"])
def test_every_preset_is_accepted(env: str, recipe: str, method: str) -> None:
    for reward_set in (1, 2):
        flags = ["--env", env, "--recipe", recipe, "--method", method, f"--reward-set={reward_set}"]
        parsed = parse_run(flags)
        assert parsed.config == preset(env, recipe, reward_set, method)
        ((experiment, folder),) = experiments_of(parsed)
        assert str(folder) == f"runs/{env}-{method}-{recipe}-set{reward_set}-seed0"
        assert experiment_of(json.loads(json.dumps(dataclasses.asdict(experiment))), "here") == experiment


def test_switches_and_overrides() -> None:
    def config_of(*flags: str) -> object:
        return experiments_of(parse_run(flags))[0][0].config

    plain = parse_run([]).config
    assert config_of() == plain
    assert config_of("--no-max-operator") == dataclasses.replace(plain, max_operator=False)
    assert config_of("--no-transe") == dataclasses.replace(plain, transe=0.0)
    assert config_of("--no-shield") == dataclasses.replace(plain, shield=dataclasses.replace(plain.shield, mode="off"))
    assert config_of("--no-relabel") == config_of("--config.relabel.share", "0")
    assert config_of("--total-steps", "7") == config_of("--config.total-steps", "7")
    everything = config_of("--no-curriculum").curriculum  # type: ignore[attr-defined]
    assert everything.promotion == everything.window == 0
    assert everything.earlier == pytest.approx(1 - 1 / everything.levels)


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
    for changed, message in [
        ({**record, "extra": 1}, "the setting 'extra'"),
        ({name: record[name] for name in record if name != "seed"}, "the setting 'seed'"),
        ({**record, "config": {**record["config"], "zeta": 1}}, "the setting 'config.zeta'"),
        ({**record, "config": 3}, "the setting 'config."),
        ({**record, "seed": "0"}, "seed is '0'"),
        ({**record, "method": "magic"}, "method is 'magic'"),
        ({**record, "env": "nowhere"}, "unknown environment 'nowhere'"),
    ]:
        with pytest.raises(UserError, match=message):
            experiment_of(changed, "there")
    with pytest.raises(UserError, match="num-envs is 0"):
        check_config(dataclasses.replace(RunFlags().config, num_envs=0))
