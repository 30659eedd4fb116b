"""Names of tasks, models, trainers and metrics, known before the code behind them is imported.

Something is registered where it is defined, with a decorator::

    from modgnn_rl.registry import MODELS


    @MODELS.register("gcn", layers=1)
    def gcn(spec: LayerSpec) -> ModGNNLayer: ...

The library's own entries are found by reading its files, not by importing them, so that ``--help`` and error messages
need not wait for torch; a file is imported when its entry is used. A script registers its entries by running the
decorator, an installed package through an entry point, which is imported when its entry is used::

    [project.entry-points."modgnn_rl.models"]
    my_model = "my_package.my_module:my_model"
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeVar

from modgnn_rl.errors import InputError, suggestion

__all__ = ["METRICS", "MODELS", "TASKS", "TRAINERS", "Entry", "Reference", "Registry"]

T = TypeVar("T")


@dataclass(frozen=True)
class Reference:
    """An object by the module it is defined in and its name there; `load` imports it."""

    module: str
    name: str

    @property
    def is_cheap(self) -> bool:
        """Whether `load` is quick: the module is imported already, or holds settings, which do not import torch."""
        return self.module in sys.modules or self.module.startswith("modgnn_rl.configs.")

    def load(self) -> Any:
        """Import the module and return the object."""
        return getattr(importlib.import_module(self.module), self.name)


@dataclass(frozen=True)
class Entry:
    """What is registered under a name.

    Attributes:
        name: the name.
        target: the registered object, or a `Reference` to it.
        options: keyword arguments of the decorator. Literals are as written; names of objects are a `Reference` until
            the entry is used.
        doc: first line of the docstring.
    """

    name: str
    target: Any
    options: Mapping[str, Any] = field(default_factory=dict)
    doc: str = ""

    def load(self) -> Any:
        """The registered object; its module is imported if need be."""
        return self.target.load() if isinstance(self.target, Reference) else self.target

    def option(self, name: str, default: Any = None) -> Any:
        """One keyword argument of the decorator; an object is imported from the module that it is defined in."""
        value = self.options.get(name, default)
        return value.load() if isinstance(value, Reference) else value


class Registry(Mapping[str, Entry]):
    """Entries by name: those in the library's files, those of installed packages, and those registered at run time.

    Args:
        kind: what an entry is, for messages, as in ``"model"``.
        variable: name of the registry where it is used as a decorator, as in ``"MODELS"``.
        packages: packages whose files are read, as in ``"modgnn_rl.models"``.
        plugins: group of the entry points through which installed packages add entries; default: none.
    """

    def __init__(self, kind: str, variable: str, *packages: str, plugins: str | None = None) -> None:
        self.kind, self.variable, self.packages, self.plugins = kind, variable, packages, plugins
        self._added: dict[str, Entry] = {}

    @functools.cached_property
    def built_in(self) -> dict[str, Entry]:
        """The entries of the library's own files, in the order of files and lines."""
        found: dict[str, Entry] = {}
        # The package knows its folder, whether that is a link, mapped by an editable installation, or in a wheel.
        for package in self.packages:
            spec = importlib.util.find_spec(package)
            for folder in map(Path, spec.submodule_search_locations or [] if spec else []):
                for path in sorted(folder.rglob("*.py")):
                    module = ".".join([package, *path.relative_to(folder).with_suffix("").parts])
                    found |= {entry.name: entry for entry in _read(path, module, self.variable)}
        return found

    def register(self, name: str, **options: Any) -> Callable[[T], T]:
        """Decorator that registers an object under a name.

        Args:
            name: a new name, or one registered before: the new object replaces the old one.
            options: further facts about the entry, such as ``settings=`` of a trainer.

        Raises:
            InputError: the name belongs to an entry of the library.
        """

        def decorate(target: T) -> T:
            mine = self.built_in.get(name)
            if mine is not None and mine.target.module != getattr(target, "__module__", None):
                raise InputError(f"{self.kind} '{name}' is built in; choose another name")
            doc = (getattr(target, "__doc__", None) or "").partition("\n")[0]
            self._added[name] = Entry(name, target, options, doc)
            return target

        return decorate

    def names(self) -> list[str]:
        """All names, the library's first."""
        return list(self)

    def peek(self, name: str) -> Entry | None:
        """The entry of a name if it is known without importing an installed package."""
        return self._added.get(name) or self.built_in.get(name)

    def __getitem__(self, name: str) -> Entry:
        """The entry of a name; that of an installed package, or of a name ``<module>:<name>``, is imported now.

        Raises:
            InputError: unknown name, or a module that cannot be imported.
        """
        if self.peek(name) is None and ":" in name:
            self._added[name] = self._imported(name)
        if self.peek(name) is None and self.plugins is not None:
            for plugin in entry_points(group=self.plugins, name=name):
                target = plugin.load()  # which may run the decorator
                if name not in self._added:
                    self.register(name)(target)
        entry = self.peek(name)
        if entry is None:
            names = self.names()
            raise InputError(f"{self.kind} '{name}' is not one of {', '.join(names)}{suggestion(name, names)}")
        return entry

    def _imported(self, name: str) -> Entry:
        """The entry of a name ``<module>:<name>``, with the options of the decorator if the object has one."""
        module, _, attribute = name.partition(":")
        if "" not in sys.path:
            sys.path.append("")  # a module in the working directory, also for commands that are installed scripts
        try:
            target = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise InputError(
                f"{self.kind} '{name}' cannot be imported ({error}): expected <module>:<name>, with a module in this "
                "folder or an installed one"
            ) from error
        known = (entry for entry in self._added.values() if entry.target is target)
        options = next(known, Entry(name, target)).options
        return Entry(name, target, options, (getattr(target, "__doc__", None) or "").partition("\n")[0])

    def __iter__(self) -> Iterator[str]:
        plugins = sorted(entry_points(group=self.plugins).names) if self.plugins is not None else []
        return iter(dict.fromkeys([*self.built_in, *plugins, *self._added]))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in list(self) or (isinstance(name, str) and ":" in name)


def _read(path: Path, module: str, variable: str) -> Iterator[Entry]:
    """Yield what a module's file registers with ``@<variable>.register(...)`` at its top level."""
    source = path.read_text(encoding="utf-8")
    if f"@{variable}.register(" not in source:
        return
    body = ast.parse(source).body
    imports = {
        alias.asname or alias.name: Reference(str(node.module), alias.name)
        for node in body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for node in body:
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            continue
        doc = (ast.get_docstring(node) or "").partition("\n")[0]
        for call in node.decorator_list:
            if isinstance(call, ast.Call) and ast.unparse(call.func) == f"{variable}.register":
                options = {str(word.arg): _value(word.value, module, imports) for word in call.keywords}
                yield Entry(ast.literal_eval(call.args[0]), Reference(module, node.name), options, doc)


def _value(node: ast.expr, module: str, imports: Mapping[str, Reference]) -> Any:
    """The value of a decorator's argument: a literal, or a reference to the object that a name stands for."""
    if isinstance(node, ast.Name):
        return imports.get(node.id, Reference(module, node.id))
    return ast.literal_eval(node)


TASKS = Registry("task", "TASKS", "modgnn_rl.envs", plugins="modgnn_rl.tasks")
MODELS = Registry("model", "MODELS", "modgnn_rl.models", plugins="modgnn_rl.models")
TRAINERS = Registry("trainer", "TRAINERS", "modgnn_rl.trainers", plugins="modgnn_rl.trainers")
METRICS = Registry("metric", "METRICS", "modgnn_rl.envs", "modgnn_rl.evaluation")
