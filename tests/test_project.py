"""What the project promises about itself: commands, packages, versions."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

import hrlspec.version

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_continuous_integration_runs_the_test_command_of_the_readme() -> None:
    (command,) = re.findall(r"^.*-m pytest.*$", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert command.startswith('python3 -m venv .venv && .venv/bin/pip install -q -e ".[test]" && ')
    tests = command.split(" && ")[-1].removeprefix(".venv/bin/")
    script = (ROOT / ".ci" / "run").read_text()
    assert re.search(rf"^ *{re.escape(tests)}\b", script, re.MULTILINE)
    # It installs what the linters and the site need on top of what the tests need.
    assert re.search(r'pip install .*-e "\.\[dev,docs\]"$', script, re.MULTILINE)
    assert "hrlspec[test]" in PROJECT["project"]["optional-dependencies"]["dev"]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_packages_are_typed_and_shipped() -> None:
    packages = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert packages == ["hrlspec", "envs_jax"]  # what is in it: tests/test_wheel.py
    assert all((ROOT / package / "py.typed").exists() for package in packages)
    (backend,) = PROJECT["build-system"]["requires"]
    assert backend in PROJECT["project"]["optional-dependencies"]["test"]


def test_dependencies_have_lower_bounds_only() -> None:
    """But for MuJoCo and MJX, which must be of the same minor version, and the site, whose theme needs MkDocs 1."""
    extras = PROJECT["project"]["optional-dependencies"].values()
    requirements = [*PROJECT["project"]["dependencies"], *(line for extra in extras for line in extra)]
    external = [line for line in requirements if not line.startswith("hrlspec[")]
    pair = {line for line in external if line.startswith("mujoco")}
    assert len({line.partition("~=")[2] for line in pair}) == 1
    bounded = [line for line in external if not re.fullmatch(r"[A-Za-z-]+(\[[a-z]+\])?>=[0-9.]+", line)]
    assert {*bounded} == {*pair, "mkdocs>=1.6,<2"}


def test_the_version_is_in_the_changelog() -> None:
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert re.fullmatch(r"\d+\.\d+\.\d+", hrlspec.version.__version__)
    assert "## Unreleased" in changelog or f"## {hrlspec.version.__version__}" in changelog


def test_the_citation_is_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^version: (.*)$", citation, re.MULTILINE) == [hrlspec.version.__version__]
    assert "](CITATION.cff)" in (ROOT / "README.md").read_text()
    assert f"version = {{{hrlspec.version.__version__}}}" in (ROOT / "docs" / "index.md").read_text()
