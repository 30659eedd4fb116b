"""The ``--help`` of a command: summary, examples, choices, and every setting with its documentation and range."""

from __future__ import annotations

import dataclasses
import inspect
import json
import shutil
import textwrap
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from omegaconf import DictConfig, OmegaConf

__all__ = ["FLAGS", "children", "fields", "help_text", "legal_values"]

FLAGS = {
    "--multirun": "one run for each combination of comma-separated values, as in seed=0,1,2",
    "--config-dir DIR": "further choices as YAML files, for example DIR/env/mine.yaml for env=mine",
    "--cfg job": "print the configuration and exit",
    "--help": "print this help, for the choices and settings on the command line",
}


def help_text(main: Callable[..., Any], name: str, config: DictConfig) -> str:
    """The help text for a composed configuration, as wide as the terminal.

    Args:
        main: the command; its docstring, examples included, heads the help.
        name: of the command.
        config: the whole configuration, including Hydra's own part.
    """
    width = min(max(shutil.get_terminal_size((120, 24)).columns, 60), 120)
    choices = list(_choices(config, width))
    usage = f"python -m modgnn_rl.{name} {'[group=choice ...] ' if choices else ''}[setting=value ...] [flags]"
    summary, _, more = inspect.cleandoc(main.__doc__ or "").partition("\n\n")
    sections = [[usage], [textwrap.fill(summary, width)], [more.replace("::\n\n", ":\n")]]
    if choices:
        sections.append(["Choices (in use: *)", *choices])
    sections += _settings(config, width)
    sections.append(["Flags", *(_entry(flag, text, width) for flag, text in FLAGS.items())])
    return "\n\n".join(filter(None, map("\n".join, sections)))


def children(config: DictConfig) -> Iterator[tuple[str, DictConfig]]:
    """Yield the nodes of a configuration that are dataclasses themselves."""
    for key in map(str, config):
        if OmegaConf.is_missing(config, key) or OmegaConf.is_interpolation(config, key):
            continue
        if isinstance(child := config[key], DictConfig) and dataclasses.is_dataclass(OmegaConf.get_type(child)):
            yield key, child


def fields(config: DictConfig) -> tuple[dataclasses.Field[Any], ...]:
    """The fields of the dataclass behind a configuration."""
    return dataclasses.fields(typing.cast(type, OmegaConf.get_type(config)))


def _choices(config: DictConfig, width: int) -> Iterator[str]:
    """Yield the choices of each group of the command, the one in use marked."""
    loader = GlobalHydra.instance().config_loader()
    chosen = config.hydra.runtime.choices
    for group in sorted(set(loader.list_groups("")) & set(chosen)):
        options = loader.get_group_options(group, ObjectType.CONFIG)
        if options:
            text = f"  {group}=" + ", ".join(f"{o}*" if chosen.get(group) == o else o for o in options)
            yield textwrap.fill(text, width, subsequent_indent=" " * (len(group) + 3))


def _settings(config: DictConfig, width: int, prefix: str = "") -> Iterator[list[str]]:
    """Yield heading and lines for a configuration, then for each one nested in it."""
    raw = typing.cast(dict[str, Any], OmegaConf.to_container(config, resolve=False))
    names = {field.name for field in fields(config)}
    nested = {name: child for name, child in children(config) if name in names}  # without Hydra's own part
    heading = f"{prefix}* {_summary(config)}" if prefix else "Settings, with their values under these choices"
    lines = [textwrap.fill(heading.strip(), width)]
    for field in fields(config):
        if field.name not in nested:
            value = raw[field.name]
            shown = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
            head = f"{prefix}{field.name}={'<required>' if value == '???' else shown}"
            lines.append(_entry(head, f"{field.metadata.get('help', '')}{legal_values(field.metadata)}", width))
    yield lines
    # Shortest first: the long list of the environment would hide the others.
    for name in sorted(nested, key=lambda name: len(nested[name])):
        yield from _settings(nested[name], width, f"{prefix}{name}.")


def _summary(config: DictConfig) -> str:
    """The first line of the docstring of the dataclass behind a configuration, unless Python generated it."""
    kind = typing.cast(type, OmegaConf.get_type(config))
    doc = kind.__doc__ or ""
    return "" if doc.startswith(f"{kind.__name__}(") else doc.partition("\n")[0].replace("`", "")


def _entry(head: str, text: str, width: int) -> str:
    """A term with its explanation next to it, or below it if the term is long."""
    head = f"  {head}"
    indent = " " * (40 if width >= 100 else 30)
    body = textwrap.fill(text, width, initial_indent=indent, subsequent_indent=indent)
    return head + body[len(head) :] if len(head) < len(indent) - 1 else f"{head}\n{body}".rstrip()


def legal_values(rule: Mapping[str, Any]) -> str:
    """The legal values of a setting in brackets, or an empty string."""
    if rule.get("choices"):
        return f" [{', '.join(map(str, rule['choices']))}]"
    words = {"ge": "at least", "gt": "greater than", "le": "at most"}
    bounds = [f"{word} {rule[key]}" for key, word in words.items() if rule.get(key) is not None]
    return f" [{', '.join(bounds)}]" if bounds else ""
