"""What pip installs: the two packages with all they need, and a command that works in any folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from hrlspec.agent_files import packaged_agents
from hrlspec.presets import PRESETS
from hrlspec.run.play.page import TEMPLATES
from hrlspec.run.replay import page
from hrlspec.version import __version__
from tests.run import tiny

ROOT = Path(__file__).parents[1]
SCRIPTS = "Scripts" if os.name == "nt" else "bin"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def scripts(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a fresh environment with the wheel, that borrows its dependencies, but no checkout, from this one."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder, with_pip=True)  # this environment may have been made without
    python = folder / SCRIPTS / "python"
    where = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    packages = Path(subprocess.run(where, check=True, capture_output=True, text=True).stdout.strip())
    borrowed = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    (packages / "borrowed.pth").write_text("\n".join(borrowed) + "\n")
    pip = [str(python), "-m", "pip", "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(pip, check=True, capture_output=True, timeout=120)
    return folder / SCRIPTS


def call(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    environ = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(command, cwd=cwd, env=environ, capture_output=True, text=True, timeout=600, check=False)


def test_what_is_inside(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        entry_points = archive.read(f"hrlspec-{__version__}.dist-info/entry_points.txt").decode()
    assert {name.split("/")[0] for name in names} == {"hrlspec", "envs_jax", f"hrlspec-{__version__}.dist-info"}
    assert {"hrlspec/py.typed", "envs_jax/py.typed"} <= names
    for preset in PRESETS.values():
        files = {f"{name}.txt" for name in preset.suites} | {"reserved.hex"}
        assert {f"hrlspec/presets/suites/{preset.name}/{file}" for file in files} <= names
    templates = {f"hrlspec/run/replay/{file}" for file in ("page.html", "page.css", *page.SCRIPTS)}
    templates |= {f"hrlspec/run/play/{file}" for file in TEMPLATES}
    assert templates <= names
    agents = {f"hrlspec/agent_files/packaged/{name}" for name in packaged_agents()}
    assert {f"{agent}.{kind}" for agent in agents for kind in ("json", "safetensors")} <= names
    assert "hrlspec = hrlspec.run.cli:console" in entry_points
    modules = {
        str(file.relative_to(ROOT)) for package in ("hrlspec", "envs_jax") for file in (ROOT / package).rglob("*.py")
    }
    assert {name for name in names if name.endswith(".py")} == modules


def test_the_packages_are_those_of_the_wheel(scripts: Path, tmp_path: Path) -> None:
    code = (
        "import hrlspec, envs_jax; print(hrlspec.__file__, envs_jax.__file__, len(hrlspec.preset('walk').suite('dag')))"
    )
    said = call(scripts / "python", "-c", code, cwd=tmp_path)
    assert said.returncode == 0, said.stderr
    *files, tasks = said.stdout.split()
    assert all(Path(file).is_relative_to(scripts.parent) for file in files)
    assert tasks == "200"
    assert "No module named 'experiments'" in call(scripts / "python", "-c", "import experiments", cwd=tmp_path).stderr
    assert call(scripts / "hrlspec", "--version", cwd=tmp_path).stdout == f"hrlspec {__version__}\n"


@pytest.mark.slow
def test_an_agent_acts_without_training(scripts: Path, tmp_path: Path) -> None:
    flags = ["--pretrained", "letter", "--spec", "achieve a", "--episodes", "20", "--json"]
    said = call(scripts / "hrlspec", "evaluate", *flags, cwd=tmp_path)
    assert said.returncode == 0, said.stderr
    assert json.loads(said.stdout)["success_rate"] > 0.5
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_the_command(scripts: Path, tmp_path: Path) -> None:
    """Help, a run of a few steps with pictures, what only a checkout can do."""
    hrlspec = scripts / "hrlspec"
    assert "evaluate" in call(hrlspec, "--help", cwd=tmp_path).stdout
    ended = call(hrlspec, "run", *tiny.arguments(Path("here")), cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    summary = json.loads((tmp_path / "here" / "summary.json").read_text())
    assert summary["env_steps"] == tiny.TOTAL
    assert "plots/curves.png" in summary["pictures"]
    refused = call(hrlspec, "reproduce", cwd=tmp_path)
    assert refused.returncode == 2
    assert "checkout" in refused.stderr
