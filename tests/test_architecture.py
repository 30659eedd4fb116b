"""Imports run one way: no cycle between packages, and the flocking task is known in few places only."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LINKED = ("configs", "envs", "trainers")  # folders at the top, imported as modgnn_rl.<name>


def modules() -> dict[str, Path]:
    """Every module of the library and its file."""
    found = {}
    for top in ("modgnn_rl", *LINKED):
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            parts = parts if top == "modgnn_rl" else ("modgnn_rl", *parts)
            if top == "modgnn_rl" and parts[1] in LINKED:
                continue
            found[".".join(part for part in parts if part != "__init__")] = path
    return found


MODULES = modules()


def exports() -> dict[str, str]:
    """The names that packages export lazily, as ``modgnn_rl.nn.ModGNN``, and where they come from."""
    found: dict[str, str] = {}
    for name, path in MODULES.items():
        stub = path.with_suffix(".pyi")
        for node in ast.parse(stub.read_text(encoding="utf-8")).body if stub.exists() else []:
            if isinstance(node, ast.ImportFrom):
                found |= {f"{name}.{alias.name}": f"{name}.{node.module}.{alias.name}" for alias in node.names}
    return found


EXPORTS = exports()


def imports(module: str) -> set[str]:
    """The modules of the library that a module imports, in functions too, but not for type checking alone."""
    found = set()
    for name in _imported_names(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        while name in EXPORTS:
            name = EXPORTS[name]
        if name.partition(".")[0] == "modgnn_rl":
            found.add(name if name in MODULES else name.rpartition(".")[0])
    return found - {module}


def _imported_names(node: ast.AST) -> Iterator[str]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        if isinstance(child, ast.Import):
            yield from (alias.name for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module:
            yield from (f"{child.module}.{alias.name}" for alias in child.names)
        yield from _imported_names(child)


def package(module: str) -> str:
    """The part of the library that a module belongs to: ``modgnn_rl.nn``, or a module at the top by itself."""
    return ".".join(module.split(".")[:2])


def is_flocking(module: str) -> bool:
    """Whether a module is part of the flocking task."""
    return module.startswith("modgnn_rl.envs.flocking")


def test_there_is_no_import_cycle_between_packages() -> None:
    graph: dict[str, set[str]] = {}
    for module in MODULES:
        others = {package(imported) for imported in imports(module)} - {package(module)}
        graph.setdefault(package(module), set()).update(others)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"packages import each other in a circle: {' -> '.join(reversed(error.args[1]))}")


def test_nothing_outside_envs_imports_the_flocking_task() -> None:
    found = {
        module for module in MODULES if package(module) != "modgnn_rl.envs" and any(map(is_flocking, imports(module)))
    }
    assert found == set(), "import modgnn_rl.task instead"


def test_settings_are_imported_from_the_schema() -> None:
    parts = {"modgnn_rl.configs.flocking", "modgnn_rl.configs.trainers"}
    direct = {module for module in MODULES if imports(module) & parts and package(module) != "modgnn_rl.configs"}
    assert direct == set(), "import modgnn_rl.configs.schema instead"


def test_the_reader_of_imports_sees_what_it_should() -> None:
    assert "modgnn_rl.configs.schema" in imports("modgnn_rl.train")
    assert "modgnn_rl.experiment.training" in imports("modgnn_rl.train")  # in a function
    assert "modgnn_rl.envs" in MODULES
    assert EXPORTS["modgnn_rl.nn.ModGNN"] == "modgnn_rl.nn.modgnn.ModGNN"
