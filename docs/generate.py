"""Reference pages generated from the code: every command, every choice, every setting.

``docs/conf.py`` writes them with `write_pages` whenever the site is built. Each YAML file at the
top of ``configs/`` belongs to a command, whose module passes its function and settings to
`modgnn_rl.cli.command.run_command`.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import re
import runpy
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import yaml
from omegaconf import MISSING

import modgnn_rl
from modgnn_rl.cli.composition import choice_settings
from modgnn_rl.cli.help import FLAGS, legal_values

PACKAGE = Path(modgnn_rl.__file__).parent
CONFIGS = PACKAGE / "configs"
ROOT = Path(__file__).parent.parent
WORDS = {bool: "true or false", int: "whole number", float: "number", str: "text"}


class Command(NamedTuple):
    """What a command passes to `run_command`: its function, and the dataclass of its settings."""

    name: str
    main: Callable[..., Any]
    schema: type


@dataclasses.dataclass
class Section:
    """The settings of one dataclass at one place in the configuration.

    Attributes:
        prefix: where they are, as in ``env``; empty for a command's own.
        kind: the dataclass.
        commands: names of the commands with these settings.
        presets: values set by choices, as in ``{"env=paper": {"separation_gain": 0.7}}``.
    """

    prefix: str
    kind: type
    commands: list[str] = dataclasses.field(default_factory=list)
    presets: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)


@functools.cache
def commands() -> list[Command]:
    """Every command, in alphabetical order."""
    found = []

    def declare(main: Callable[..., Any], schema: type, name: str) -> None:
        found.append(Command(name, main, schema))

    for file in sorted(CONFIGS.glob("*.yaml")):
        with mock.patch("modgnn_rl.cli.command.run_command", declare), mock.patch.object(sys, "argv", [file.stem]):
            runpy.run_path(str(PACKAGE / f"{file.stem}.py"), run_name="__main__")
    return found


def write_pages(folder: Path, pages: Mapping[str, str]) -> None:
    """Write the pages that changed into a folder, and remove those that no longer exist."""
    folder.mkdir(parents=True, exist_ok=True)
    for page in folder.glob("*.md"):
        if page.name not in pages:
            page.unlink()
    for name, text in pages.items():
        page = folder / name
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def reference_pages() -> dict[str, str]:
    """The pages by file name."""
    known = commands()
    sections = _sections(known)
    return {"commands.md": _commands_page(known, sections), "settings.md": _settings_page(sections)}


def root_pages() -> dict[str, str]:
    """The README and the other pages at the top of the repository, for a folder two levels below it."""
    pages = {}
    for file in ROOT.glob("*.md"):
        text = re.sub(r"\]\(docs/", "](../", file.read_text(encoding="utf-8"))
        text = re.sub(r"\]\(([A-Z]+)\.md", lambda link: f"]({link[1].lower()}.md", text)
        pages[f"{file.stem.lower()}.md"] = re.sub(r"\]\((?![a-z]+:|#|\.\./|[a-z]+\.md)", "](../../", text)
    return pages


def groups_of(command: Command) -> dict[str, str]:
    """The choice that a command makes by default, by group."""
    return {
        group: choice for entry in _defaults(command.name) if isinstance(entry, dict) for group, choice in entry.items()
    }  # a choice is None where the task decides


def choices_of(command: Command, group: str) -> list[str]:
    """The choices of a group in alphabetical order: what is registered, and what has a YAML file."""
    field = {field.name: field for field in dataclasses.fields(command.schema)}[group]
    files = [file.stem for file in (CONFIGS / group).glob("*.yaml")]
    return sorted({*files, *field.metadata.get("registry", ())})


def _defaults(name: str) -> list[Any]:
    """The defaults list of a YAML file."""
    return _yaml(name).get("defaults", [])


def _yaml(name: str) -> dict[str, Any]:
    return yaml.safe_load((CONFIGS / f"{name}.yaml").read_text(encoding="utf-8")) or {}


def preset_of(command: Command, group: str, choice: str) -> tuple[type | None, dict[str, Any]]:
    """The dataclass of a choice, if it has one of its own, and the values that it sets other than the defaults."""
    field = {field.name: field for field in dataclasses.fields(command.schema)}[group]
    if choice in field.metadata.get("registry", ()):
        return type(choice_settings(field, choice, load=True)), {"name": choice}
    kind: type | None = None
    values: dict[str, Any] = {}
    for entry in _defaults(f"{group}/{choice}"):
        if entry != "_self_":  # another choice that this one begins with
            kind, values = preset_of(command, group, entry)
    return kind, values | {key: value for key, value in _yaml(f"{group}/{choice}").items() if key != "defaults"}


def _sections(known: Iterable[Command]) -> list[Section]:
    """All settings, one section for each dataclass and place, with what each choice of a group sets."""
    found: dict[tuple[str, type], Section] = {}

    def section_of(command: Command, prefix: str, kind: type) -> Section:
        section = found.setdefault((prefix, kind), Section(prefix, kind))
        section.commands += [] if command.name in section.commands else [command.name]
        return section

    for command in known:
        groups = groups_of(command)
        section_of(command, "", command.schema)
        hints = typing.get_type_hints(command.schema)
        for field in dataclasses.fields(command.schema):
            kind: Any = hints[field.name] if dataclasses.is_dataclass(hints[field.name]) else field.default_factory
            for choice in choices_of(command, field.name) if field.name in groups else []:
                own, values = preset_of(command, field.name, choice)
                values.pop("name", None)  # of the choice itself
                section_of(command, field.name, own or kind).presets[f"{field.name}={choice}"] = values
            if field.name not in groups and dataclasses.is_dataclass(kind):
                section_of(command, field.name, kind)
    return list(found.values())


def _default(field: dataclasses.Field[Any]) -> Any:
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def _commands_page(known: list[Command], sections: list[Section]) -> str:
    """One section for each command: what it does, its choices, its settings."""
    lines = ["# Commands", "", "Every command takes choices and settings in any order, and flags before or after them."]
    lines += ["`--help` lists them with their values under the choices on the command line.", ""]
    lines += ["| command | |", "|---|---|"]
    lines += [f"| [`python -m modgnn_rl.{c.name}`](#{c.name}) | {_cell(_summary(c))} |" for c in known]
    for command in known:
        lines += ["", f"## {command.name}", "", _summary(command), "", "```text"]
        groups = groups_of(command)
        chooses = " [group=choice ...]" if groups else ""
        lines += [f"python -m modgnn_rl.{command.name}{chooses} [setting=value ...] [flags]", "```", ""]
        if groups:
            lines += ["| group | choices, the default in bold |", "|---|---|"]
        for group, chosen in groups.items():
            choices = choices_of(command, group)
            shown = ", ".join(f"**`{choice}`**" if choice == chosen else f"`{choice}`" for choice in choices)
            lines.append(f"| `{group}=` | {shown} |")
        here = [section for section in sections if command.name in section.commands]
        own = next(section for section in here if section.kind is command.schema)
        lines += ["", *_table(own, f"{command.name}.")]
        beyond = [
            f"[{title}](settings.md#{_slug(title)})" for title in sorted(_title(s, sections) for s in here) if title
        ]
        lines += ["", f"Further settings: {', '.join(beyond)}."] if beyond else []
    flags = [f"| `{flag}` | {_cell(text)} |" for flag, text in FLAGS.items()]
    return "\n".join([*lines, "", "## Flags", "", "| flag | |", "|---|---|", *flags, ""])


def _settings_page(sections: list[Section]) -> str:
    """One section for each dataclass nested in the settings of a command."""
    lines = ["# Settings", "", "Set on the command line, as in `env.comm_range=5`, or in a YAML file whose folder"]
    lines += ["is given by `--config-dir`. The values that presets set are listed with each setting;"]
    lines += ["for settings of a single command see [commands](commands.md).", ""]
    for section in sorted((section for section in sections if section.prefix), key=lambda s: _title(s, sections)):
        title = _title(section, sections)
        used = ", ".join(f"[{name}](commands.md#{name})" for name in section.commands)
        lines += [f"## {title}", "", inspect.cleandoc(section.kind.__doc__ or ""), "", f"*In {used}.*", ""]
        lines += _names(section) if _is_repeated(section, sections) else _table(section, f"{title}.")
        lines.append("")
    return "\n".join(lines)


def _title(section: Section, sections: Iterable[Section]) -> str:
    """Title of a section: its place, and the choice or the command if several sections are there."""
    alike = [other for other in sections if other.prefix == section.prefix]
    if not section.prefix or len(alike) == 1 or len(section.presets) > 1:
        return section.prefix
    return next(iter(section.presets), f"{section.prefix} of {', '.join(section.commands)}")


def _is_repeated(section: Section, sections: Iterable[Section]) -> bool:
    """Whether another section documents all settings of this one, apart from their defaults."""
    mine = [field.metadata for field in dataclasses.fields(section.kind)]
    others = [other for other in sections if other.prefix == section.prefix and len(other.presets) > 1]
    return any(
        all(rule in [field.metadata for field in dataclasses.fields(other.kind)] for rule in mine)
        for other in others
        if other is not section
    )


def _names(section: Section) -> list[str]:
    """The names of the settings of a section, linked to their documentation."""
    names = [f"{section.prefix}.{field.name}" for field in dataclasses.fields(section.kind)]
    return [", ".join(f"[`{name}`](#{_slug(name, '-')})" for name in names) + "."]


def _table(section: Section, place: str) -> list[str]:
    """A table of the settings of a section: default, legal values, documentation, values set by choices."""
    hints = typing.get_type_hints(section.kind)
    lines = ["{.settings}", "| setting | default | legal | what it does |", "|---|---|---|---|"]
    for field in dataclasses.fields(section.kind):
        if "help" not in field.metadata:
            continue
        default = _default(field)
        name = f"{section.prefix}.{field.name}".lstrip(".")
        others = [
            f"{_shown(p[field.name])} with `{choice}`" for choice, p in section.presets.items() if field.name in p
        ]
        doc = _cell(field.metadata["help"]) + (f"<br>*{'; '.join(others)}*" if others else "")
        shown = "required" if default == MISSING else _shown(default)
        anchor = _slug(f"{place}{field.name}", "-")
        lines.append(f"| [`{name}`]{{#{anchor}}} | {shown} | {_legal(field, hints[field.name])} | {doc} |")
    return lines if len(lines) > 3 else []


def _legal(field: dataclasses.Field[Any], hint: Any) -> str:
    """The legal values of a setting in words."""
    if field.metadata["choices"]:
        words = ", ".join(f"`{choice}`" for choice in field.metadata["choices"])
    else:
        kinds = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
        items = [kind for kind in kinds if kind is not types.NoneType]
        listed = [f"{WORDS[typing.get_args(kind)[0]]}s" for kind in items if typing.get_origin(kind) is list]
        plain = [WORDS[kind] for kind in items if kind in WORDS]
        words = ", ".join([*plain, *(f"list of {kind}" for kind in listed)])
        words = words or ("whole number or a list" if field.metadata["whole"] else "any")
        bounds = legal_values(field.metadata).strip(" []")
        words = f"{words}, {bounds}" if bounds else words
    may_be_null = field.default is None
    return f"{words}, or null" if may_be_null else words


def _shown(value: Any) -> str:
    """A value as it is written on the command line."""
    if value == float("inf"):
        return "`.inf`"
    return f"`{value if isinstance(value, str) else json.dumps(value, separators=(',', ':'))}`"


def _summary(command: Command) -> str:
    return inspect.cleandoc(command.main.__doc__ or "").splitlines()[0]


def _cell(text: str) -> str:
    """Plain text as a cell of a Markdown table."""
    return re.sub(r"([|*\[\]])", r"\\\1", text).replace("<", "&lt;")


def _slug(title: str, between: str = "") -> str:
    """The anchor of a title, as GitHub makes it; with ``between``, that of a setting."""
    return re.sub(r"[^\w -]", between, title.lower()).replace(" ", "-")
