"""Imports point down, nothing goes round in a circle, and environments are asked for capabilities, not for names."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

import envs_jax

ROOT = Path(__file__).parent.parent
PACKAGES = ("envs_jax", "hrlspec", "experiments", "benchmarks")

LAYERS: tuple[tuple[str, ...], ...] = (
    ("hrlspec.version",),
    ("envs_jax",),
    ("hrlspec.spec",),
    ("hrlspec.config",),
    ("hrlspec.tasks",),
    ("hrlspec.exact",),
    ("hrlspec.agent",),
    ("hrlspec.learning",),
    ("hrlspec.methods",),
    ("hrlspec.checkpoint",),
    ("hrlspec.evaluation",),
    ("hrlspec.presets",),
    ("hrlspec.agent_files",),
    ("hrlspec.api", "hrlspec.gymnasium"),
    ("hrlspec",),  # what its __init__ offers
    ("hrlspec.run",),
    ("experiments", "benchmarks"),
)
"""From the bottom to the top; a module belongs to the longest name that it begins with."""

Graph = Mapping[str, frozenset[str]]


def imported(source: str) -> Iterator[tuple[str, str | None]]:
    """Modules that a source names, with what is taken from them; in functions and for type checkers alone as well."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((name.name, None) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from ((str(node.module), name.name) for name in node.names)


@functools.cache
def sources() -> dict[str, str]:
    """Source by name of the module; a package's own is its ``__init__``."""
    found = {}
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            parts = file.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file.read_text()
    return found


@functools.cache
def imports() -> Graph:
    """The modules of the project that each of them imports."""
    graph = {}
    for name, source in sources().items():
        targets = (
            f"{module}.{taken}" if f"{module}.{taken}" in sources() else module for module, taken in imported(source)
        )
        graph[name] = frozenset(target for target in targets if target in sources()) - {name}
    return graph


def layer_of(module: str) -> int:
    """Counted from the bottom."""
    names = [name for layer in LAYERS for name in layer if f"{module}.".startswith(f"{name}.")]
    longest = max(names, key=len)
    return next(height for height, layer in enumerate(LAYERS) if longest in layer)


def by_folder(graph: Graph) -> Graph:
    """The same between the packages right below a top-level one, and the modules beside them."""

    def unit(module: str) -> str:
        return ".".join(module.split(".")[:2])

    folders: dict[str, set[str]] = {}
    for module, targets in graph.items():
        folders.setdefault(unit(module), set()).update(unit(target) for target in targets)
    return {folder: frozenset(targets - {folder}) for folder, targets in folders.items()}


def cycles(graph: Graph) -> list[list[str]]:
    """A circle through every node that has one."""

    def path(start: str) -> list[str] | None:
        routes, seen = [[start]], set()
        for route in routes:  # grows while it is read
            for target in sorted(graph.get(route[-1], ())):
                if target == start:
                    return [*route, start]
                if target not in seen:
                    seen.add(target)
                    routes.append([*route, target])
        return None

    return [found for found in map(path, sorted(graph)) if found]


def test_what_the_reader_of_imports_sees() -> None:
    source = """
import a.b, c as d
if TYPE_CHECKING:
    from e import f
def function():
    from g.h import (i, j)
"""
    assert set(imported(source)) == {("a.b", None), ("c", None), ("e", "f"), ("g.h", "i"), ("g.h", "j")}


def test_what_counts_as_a_circle() -> None:
    graph = {"a": frozenset("b"), "b": frozenset("c"), "c": frozenset("b"), "d": frozenset("a")}
    assert cycles(graph) == [["b", "c", "b"], ["c", "b", "c"]]


def test_every_module_has_its_layer() -> None:
    assert layer_of("envs_jax.zone.world") < layer_of("hrlspec.spec") < layer_of("hrlspec.agent.networks.tree")
    assert layer_of("hrlspec.run.plots") > layer_of("hrlspec") > layer_of("hrlspec.api")
    beside = {module for module in sources() if layer_of(module) == layer_of("hrlspec") and module != "hrlspec"}
    assert not beside, "modules without a place among the layers"


def test_imports_point_down() -> None:
    up = [
        f"{module} imports {target}"
        for module, targets in imports().items()
        for target in sorted(targets)
        if layer_of(target) > layer_of(module)
    ]
    assert not up, "\n".join(up)


@pytest.mark.parametrize("level", ["modules", "packages"])
def test_imports_do_not_go_round(level: str) -> None:
    graph = imports() if level == "modules" else by_folder(imports())
    found = [" -> ".join(circle) for circle in cycles(graph)]
    assert not found, "\n".join(found)


def test_environments_know_nothing_of_tasks() -> None:
    names = {
        module for name, source in sources().items() if name.startswith("envs_jax") for module, _ in imported(source)
    }
    assert not {name for name in names if name.split(".")[0] in ("hrlspec", "experiments", "benchmarks")}


def test_nothing_looks_for_attributes_of_environments() -> None:
    """Capabilities are asked for with isinstance. Leaves of a checkpoint are of any type, so there it may be needed."""
    found = []
    for module, source in sources().items():
        if not module.startswith(("envs_jax", "hrlspec")) or module.startswith("hrlspec.checkpoint"):
            continue
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args:
                of = ast.unparse(node.args[0]).split(".")[-1]
                if node.func.id == "hasattr" or (node.func.id == "getattr" and of in ("env", "environment")):
                    found.append(f"{module}:{node.lineno}: {ast.unparse(node)}")
    assert not found, "\n".join(found)


def test_no_environment_is_known_by_its_name() -> None:
    """Outside of the presets, and of docstrings."""
    found = []
    for module, source in sources().items():
        if not module.startswith("hrlspec") or module.startswith("hrlspec.presets"):
            continue
        tree = ast.parse(source)
        docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and id(node) not in docs and node.value in envs_jax.registered():
                found.append(f"{module}:{node.lineno}: {node.value!r}")
    assert not found, "\n".join(found)
