"""The pages of the Python API, one a package, from the packages themselves: nothing is listed by hand."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import modgnn_rl

__all__ = ["api_pages", "packages"]

ROOT = Path(modgnn_rl.__file__).parent
LINKED = ("configs", "envs", "trainers")  # folders at the top of the repository

INDEX = """\
# Python API

One page a package. A module's public names are those of its `__all__`; the names that most scripts need are
also exported by the package, as in `from modgnn_rl.nn import GraphAttention`.

| package | |
|---|---|
{rows}

```{{toctree}}
:hidden:

{pages}
```
"""

MODULE = """\
## {module}

```{{eval-rst}}
.. automodule:: {module}
   :members:
```
"""


def packages() -> dict[str, list[str]]:
    """The modules of each package, by the package's dotted name; private ones are left out."""
    found: dict[str, list[str]] = {}
    for path in sorted(_files()):
        parts = path.relative_to(ROOT).with_suffix("").parts
        package = ".".join(["modgnn_rl", *parts[:-1]])
        names = found.setdefault(package, [])
        if not parts[-1].startswith("_"):
            names.append(".".join([package, parts[-1]]))
    return found


def api_pages() -> dict[str, str]:
    """The pages by their file names, ``index.md`` among them."""
    pages, rows = {}, []
    for package, modules in packages().items():
        name = package.removeprefix("modgnn_rl.")
        summary = ast.get_docstring(ast.parse(_init(package).read_text(encoding="utf-8"))) or ""
        sections = "\n".join(MODULE.format(module=module) for module in modules)
        pages[f"{name}.md"] = f"# {package}\n\n{summary.partition(chr(10))[0]}\n\n{sections}"
        rows.append(f"| [`{package}`]({name}.md) | {summary.partition(chr(10))[0]} |")
    names = "\n".join(Path(page).stem if page.count(".") == 1 else page.removesuffix(".md") for page in pages)
    return {**pages, "index.md": INDEX.format(rows="\n".join(rows), pages=names)}


def _files() -> Iterator[Path]:
    """Every Python file of the library; a linked folder is walked from its real place."""
    for folder in (ROOT, *(ROOT / name for name in LINKED)):
        for path in folder.rglob("*.py"):
            if folder != ROOT or path.relative_to(ROOT).parts[0] not in LINKED:
                yield path


def _init(package: str) -> Path:
    return ROOT.joinpath(*package.split(".")[1:], "__init__.py")
