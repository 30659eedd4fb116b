"""The layout: folders at the top of the repository that are imported as parts of modgnn_rl, and nowhere else."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import modgnn_rl

ROOT = Path(__file__).parent.parent
LINKED = ["configs", "envs", "trainers"]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
SETUPTOOLS: dict[str, Any] = PROJECT["tool"]["setuptools"]

# Distributions whose module has another name.
MODULES = {"hydra-core": "hydra", "lazy-loader": "lazy_loader", "pyyaml": "yaml"}


def sources(*folders: str) -> list[Path]:
    """Return the Python files of some top-level folders, each once."""
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py")) if path.is_file()]


def imports(path: Path) -> Iterator[str]:
    """Yield the top-level name of every module that a file imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.partition(".")[0]


def test_packages_are_the_folders_with_code() -> None:
    found = set()
    for top, name in [("modgnn_rl", "modgnn_rl"), *((folder, f"modgnn_rl.{folder}") for folder in LINKED)]:
        for folder in {path.parent.relative_to(ROOT / top) for path in (ROOT / top).rglob("*.py")}:
            if not (top == "modgnn_rl" and folder.parts[:1] and folder.parts[0] in LINKED):
                found.add(".".join([name, *folder.parts]))
    assert set(SETUPTOOLS["packages"]) == found
    for package in SETUPTOOLS["packages"]:
        assert (ROOT / "modgnn_rl" / Path(*package.split(".")[1:]) / "__init__.py").is_file()


@pytest.mark.parametrize("folder", LINKED)
def test_links_lead_to_the_folders_that_setuptools_maps(folder: str) -> None:
    link = ROOT / "modgnn_rl" / folder
    assert link.is_symlink()
    assert link.readlink() == Path("..") / folder
    assert link.resolve() == (ROOT / folder).resolve()
    assert SETUPTOOLS["package-dir"][f"modgnn_rl.{folder}"] == folder


def test_package_data_covers_every_file_that_is_not_code() -> None:
    covered = {
        path
        for key, patterns in SETUPTOOLS["package-data"].items()
        for package in (SETUPTOOLS["packages"] if key == "*" else [key])
        for pattern in patterns
        for path in (ROOT / "modgnn_rl" / Path(*package.split(".")[1:])).glob(pattern)
    }
    folders = [ROOT / "modgnn_rl", *(ROOT / "modgnn_rl" / folder for folder in LINKED)]
    files = {path for folder in folders for path in folder.rglob("*") if path.is_file()}
    assert {path for path in files if path.suffix not in {".py", ".pyc"}} == covered


def test_nothing_imports_the_folders_by_their_bare_names() -> None:
    files = sources("modgnn_rl", *LINKED, "tests", "benchmarks")
    assert files
    assert [str(path) for path in files if set(imports(path)) & set(LINKED)] == []


def test_ruff_bans_the_bare_names() -> None:
    banned = PROJECT["tool"]["ruff"]["lint"]["flake8-tidy-imports"]["banned-api"]
    assert set(LINKED) <= set(banned)


def test_every_import_is_a_declared_dependency() -> None:
    project = PROJECT["project"]
    extras = project["optional-dependencies"]
    runtime = [
        *project["dependencies"],
        *(line for name in extras if name not in {"dev", "test"} for line in extras[name]),
    ]
    names = {re.split(r"[<>=\[ ]", line)[0] for line in runtime}
    declared = {MODULES.get(name, name) for name in names} | {"modgnn_rl"} | sys.stdlib_module_names
    used = {name for path in sources("modgnn_rl", *LINKED) for name in imports(path)}
    assert used <= declared


def test_dependencies_have_lower_and_upper_bounds() -> None:
    project = PROJECT["project"]
    lines = [*project["dependencies"], *(line for extra in project["optional-dependencies"].values() for line in extra)]
    assert [line for line in lines if not re.fullmatch(r"[\w-]+>=[\d.]+,<[\d.]+", line)] == []
    assert "torch>=2.13,<2.14" in lines


def test_version_is_a_literal_that_setuptools_can_read() -> None:
    assert SETUPTOOLS["dynamic"]["version"] == {"attr": "modgnn_rl.__version__"}
    tree = ast.parse((ROOT / "modgnn_rl" / "__init__.py").read_text())
    values = [
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__version__"]
    ]
    assert values == [modgnn_rl.__version__]


def test_importing_the_package_and_its_settings_does_not_load_torch() -> None:
    code = "import sys, modgnn_rl, modgnn_rl.cli.command, modgnn_rl.configs.schema; print('torch' in sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (process.stdout, process.stderr) == ("False\n", "")


def exporting_packages() -> list[str]:
    """The packages that export names of their modules, as their ``__init__.pyi`` lists them."""
    folders = [ROOT / "modgnn_rl", *(ROOT / "modgnn_rl" / folder for folder in LINKED)]
    stubs = {path for folder in folders for path in folder.rglob("__init__.pyi")}
    return sorted(".".join(path.relative_to(ROOT).parent.parts) for path in stubs)


@pytest.mark.parametrize("package", exporting_packages())
def test_exported_names_resolve_and_are_not_those_of_submodules(package: str) -> None:
    module = importlib.import_module(package)
    submodules = {found.name for found in pkgutil.iter_modules(module.__path__)}
    assert module.__all__
    assert set(module.__all__) & submodules == set()
    for name in module.__all__:
        assert getattr(module, name) is not None
    stub = ast.parse((Path(module.__path__[0]) / "__init__.pyi").read_text())
    for node in [node for node in stub.body if isinstance(node, ast.ImportFrom)]:
        for alias in node.names:
            assert alias.asname == alias.name  # so that type checkers take it as exported
            home = importlib.import_module(f"{package}.{node.module}")
            assert getattr(module, alias.name) is getattr(home, alias.name)
            assert alias.name in home.__all__


def test_importing_a_package_does_not_load_torch() -> None:
    code = f"import sys, {', '.join(exporting_packages())}; print('torch' in sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (process.stdout, process.stderr) == ("False\n", "")


def test_readme_has_one_line_to_run_and_one_to_test() -> None:
    readme = (ROOT / "README.md").read_text()
    for marker, ending in [("run", "-m modgnn_rl.train"), ("tests", "pytest")]:
        blocks = re.findall(rf"^<!-- {marker} -->\n```bash\n(.*)\n```$", readme, flags=re.MULTILINE)
        assert len(blocks) == 1
        assert blocks[0].endswith(ending)
