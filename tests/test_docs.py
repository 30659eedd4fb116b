"""The documentation site: what its pages must hold, and that every command on any page is one that can be typed."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

import modgnn_rl
from modgnn_rl.configs import schema
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.utils.internals import parse_hydra_flags

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.parent != DOCS / "reference"]
TEXTS = [*sorted(ROOT.glob("*.md")), *PAGES]
# The settings of `TaskConfig` are shown as those of each task.
NAMES = [name for name in schema.__all__ if name != "TaskConfig"]
KINDS = [kind for name in NAMES if dataclasses.is_dataclass(kind := getattr(schema, name))]


@pytest.fixture(scope="module")
def scripts() -> Iterator[Callable[[str], ModuleType]]:
    """The modules in docs/ by name."""
    sys.path.insert(0, str(DOCS))
    yield importlib.import_module
    sys.path.remove(str(DOCS))


@pytest.fixture(scope="module")
def generate(scripts: Callable[[str], ModuleType]) -> ModuleType:
    """The module docs/generate.py, as docs/conf.py imports it."""
    return scripts("generate")


@pytest.fixture(scope="module")
def reference(generate: ModuleType) -> dict[str, str]:
    pages: dict[str, str] = generate.reference_pages()
    return pages


def row_of(page: str, setting: str) -> str:
    """The row of a table that documents a setting."""
    return next(line for line in page.splitlines() if line.startswith(f"| [`{setting}`]"))


def commands() -> list[str]:
    """Each command of ours on any page, once, with what stands behind it."""
    found: dict[str, None] = {}
    for page in TEXTS:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        text = re.sub(r"<!-- unfinished -->.*?<!-- finished -->", "", text, flags=re.DOTALL)
        code = re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        spans = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
        for line in [*(line for block in code for line in block.splitlines()), *spans]:
            for command in re.findall(r"-m modgnn_rl\.(\w+.*)", line):
                # What the shell or the reader puts there: $NAME, {} of xargs, <date>.
                plain = re.sub(r"\$\{?\w+\S*\}|\$\w+|\{\}|<[^>]*>", "1", command)
                found[" ".join(shlex.split(re.split(r" [&;|] |;|\)", plain)[0], comments=True))] = None
    return list(found)


def test_every_module_is_on_a_page_of_the_api(scripts: Callable[[str], ModuleType]) -> None:
    found = pkgutil.walk_packages(modgnn_rl.__path__, "modgnn_rl.")
    modules = [
        module.name for module in found if not module.ispkg and not module.name.rpartition(".")[2].startswith("_")
    ]
    pages = scripts("api").api_pages()
    shown = re.findall(r"^\.\. automodule:: (.*)$", "\n".join(pages.values()), re.MULTILINE)
    assert sorted(shown) == sorted(modules)
    linked = re.findall(r"\]\((.*?\.md)\)", pages["index.md"])
    assert sorted([*linked, "index.md"]) == sorted(pages)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_setting_is_on_the_pages_with_its_documentation(kind: type, reference: dict[str, str]) -> None:
    text = "".join(reference.values())
    for field in dataclasses.fields(kind):
        if doc := field.metadata.get("help"):
            assert re.search(rf"^\| \[`([\w.]+\.)?{field.name}`\].*{re.escape(doc[:12])}", text, re.MULTILINE), (
                field.name
            )


def test_a_setting_shows_its_default_its_range_and_what_choices_make_of_it(reference: dict[str, str]) -> None:
    row = row_of(reference["settings.md"], "env.separation_gain")
    assert row.split(" | ")[1:3] == ["`0.8`", "number, at least 0"]
    assert row.endswith("<br>*`0.7` with `env=paper`* |")
    assert "`bc`" in row_of(reference["settings.md"], "trainer.name")
    assert "**`flocking`**" in reference["commands.md"]


def test_the_tables_of_results_are_those_of_the_files_in_results(scripts: Callable[[str], ModuleType]) -> None:
    """Else: python docs/results_tables.py."""
    tables = scripts("results_tables")
    for page in tables.PAGES:
        text = page.read_text(encoding="utf-8")
        assert "<!-- table" in text
        assert tables.renewed(text) == text, page


def test_every_command_is_on_the_page(reference: dict[str, str]) -> None:
    for file in (ROOT / "configs").glob("*.yaml"):
        assert f"\n## {file.stem}\n" in reference["commands.md"]


@pytest.mark.parametrize("line", commands())
def test_commands_on_the_pages_can_be_typed(line: str, generate: ModuleType) -> None:
    compose(line, generate)


@pytest.mark.parametrize(
    "line",
    [
        "trian",
        "train model=gnc",
        "train env.comm_rang=2",
        "train trainer=bc trainer.rounds=2",
        "train --multirun env.comm_range=3,-1",
        "train seed=a",
        "train seed",
        "train --colour",
    ],
)
def test_commands_that_cannot_be_typed_are_found(line: str, generate: ModuleType) -> None:
    with pytest.raises((FileNotFoundError, InputError, HydraException, OmegaConfBaseException, KeyError, SystemExit)):
        compose(line, generate)


def compose(line: str, generate: ModuleType) -> None:
    """Apply a command line to a command's settings and check them; Hydra would take half a second for each."""
    name, *arguments = shlex.split(line)
    command = {command.name: command for command in generate.commands()}[name]
    flags = parse_hydra_flags(arguments)
    if flags.shell_completion:
        return
    overrides = {o.key_or_group: o for o in OverridesParser.create().parse_overrides(flags.overrides)}
    settings = OmegaConf.structured(command.schema)
    for group, default in generate.groups_of(command).items():
        for choice in values_of(overrides.pop(group)) if group in overrides else [default]:
            if choice is None:  # the task decides
                continue
            if choice in generate.choices_of(command, group) or not flags.config_dir:  # else a choice of the user's own
                kind, values = generate.preset_of(command, group, choice)
                settings[group] = OmegaConf.structured(kind) if kind else settings[group]
                settings[group].update(values)
    for key, override in overrides.items():
        for value in values_of(override):
            OmegaConf.update(settings, key, value)
            check(OmegaConf.to_object(settings))


def values_of(override: Override) -> list[Any]:
    """The value that an override gives, or all of them in a multirun."""
    value = override.value()
    return value.list if isinstance(value, ChoiceSweep) else [value]
