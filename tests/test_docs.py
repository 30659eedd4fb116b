"""The documentation site: what its pages must hold, and that every command on any page is one that can be typed."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import re
import runpy
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import pytest

from modgnn_rl.command import run_command
from modgnn_rl.configs import schema

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if page.parent != DOCS / "reference"]
TEXTS = [*sorted(ROOT.glob("*.md")), *PAGES]
KINDS = [kind for name in schema.__all__ if dataclasses.is_dataclass(kind := getattr(schema, name))]


def load(name: str) -> ModuleType:
    """A module of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look for it there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def reference() -> dict[str, str]:
    pages: dict[str, str] = load("generate").reference_pages()
    return pages


def row_of(page: str, setting: str) -> str:
    """The row of a table that documents a setting."""
    return next(line for line in page.splitlines() if line.startswith(f"| [`{setting}`]"))


def commands() -> list[str]:
    """Each command of ours on any page, once, with what stands behind it."""
    found: dict[str, None] = {}
    for page in TEXTS:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ")
        code = re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        spans = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))
        for line in [*(line for block in code for line in block.splitlines()), *spans]:
            for command in re.findall(r"-m modgnn_rl\.(\w+.*)", line):
                # What the shell or the reader puts there: $NAME, {} of xargs, <date>.
                plain = re.sub(r"\$\{?\w+\S*\}|\$\w+|\{\}", "1", command)
                found[" ".join(shlex.split(re.split(r" [&;|] |;|\)", plain)[0], comments=True))] = None
    return list(found)


def test_every_public_module_is_on_a_page_of_the_api() -> None:
    folders = {"modgnn_rl": "modgnn_rl", "envs": "modgnn_rl.envs", "trainers": "modgnn_rl.trainers"}
    modules = {f"{package}.{file.stem}" for folder, package in folders.items() for file in (ROOT / folder).glob("*.py")}
    text = "\n".join(page.read_text(encoding="utf-8") for page in (DOCS / "api").glob("*.md"))
    shown = re.findall(r"^\.\. automodule:: (.*)$", text, re.MULTILINE)
    assert len(shown) == len(set(shown))
    assert {module for module in modules if not module.endswith("__")} <= set(shown)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_setting_is_on_the_pages_with_its_documentation(kind: type, reference: dict[str, str]) -> None:
    text = "".join(reference.values())
    for field in dataclasses.fields(kind):
        if doc := field.metadata.get("doc"):
            assert re.search(rf"^\| \[`([\w.]+\.)?{field.name}`\].*{re.escape(doc[:12])}", text, re.MULTILINE), (
                field.name
            )


def test_a_setting_shows_its_default_its_range_and_what_choices_make_of_it(reference: dict[str, str]) -> None:
    row = row_of(reference["settings.md"], "env.separation_gain")
    assert row.split(" | ")[1:3] == ["`0.8`", "number, at least 0"]
    assert row.endswith("<br>*`0.7` with `env=paper`* |")
    assert "`bc`" in row_of(reference["settings.md"], "trainer.name")
    assert "**`moment_force`**" in reference["commands.md"]


def test_every_command_is_on_the_page(reference: dict[str, str]) -> None:
    for file in (ROOT / "configs").glob("*.yaml"):
        assert f"\n## {file.stem}\n" in reference["commands.md"]


@pytest.mark.parametrize("line", commands())
def test_commands_on_the_pages_compose(
    line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    preset = tmp_path / "mine" / "env" / "windy.yaml"  # of docs/recipes.md
    preset.parent.mkdir(parents=True)
    preset.write_text("comm_range: 5\nmessage_loss: 0.2\n")
    monkeypatch.chdir(tmp_path)
    name, *arguments = shlex.split(line)
    assert (ROOT / "configs" / f"{name}.yaml").is_file()
    monkeypatch.setattr(sys, "argv", [name, *arguments])

    def compose(main: object, *declared: Any, **nodes: Any) -> None:
        run_command(lambda config: None, *declared, **nodes)

    with contextlib.suppress(SystemExit), mock.patch("modgnn_rl.command.run_command", compose):
        runpy.run_path(str(ROOT / "modgnn_rl" / f"{name}.py"), run_name="__main__")
    assert capsys.readouterr().err == ""
