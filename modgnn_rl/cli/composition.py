"""From a command line to a checked dataclass: what Hydra is told of a command, and what is made of its answer."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import typing
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import hydra
import yaml
from hydra.conf import HelpConf, HydraConf, JobConf, RunDir, SweepDir
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from modgnn_rl.cli.help import children, fields, help_text
from modgnn_rl.cli.messages import explain, unknown_setting
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.registry import Reference, Registry

__all__ = [
    "Command",
    "choice_settings",
    "compose",
    "job_name",
    "known_settings",
    "register",
    "settings_given",
    "validate",
]


class Command(NamedTuple):
    """A command.

    Attributes:
        main: function of the settings; its docstring heads the help, its return value is the exit code.
        schema: dataclass of the settings.
        name: name of the command and of its YAML file.
        config_path: where Hydra looks for YAML files.
    """

    main: Callable[[Any], int | None]
    schema: type
    name: str
    config_path: str


def register(
    command: Command, arguments: Sequence[str], *, load_all: bool, scratch: str, config_dir: str | None = None
) -> None:
    """Give Hydra the command's dataclasses, its registered choices, its help, and defaults that write nothing.

    Args:
        command: the command.
        arguments: command line; a choice whose settings are slow to import is imported if an argument mentions it.
        load_all: import all of them, since YAML files of the user may mention them.
        config_dir: folder with YAML files of the user, which may begin with a choice ``<module>:<name>``.
        scratch: folder for the file that Hydra writes in a multirun whatever its settings say.

    Raises:
        InputError: settings of a registered choice that do not fit.
    """
    store = ConfigStore.instance()
    grouped = [field for field in dataclasses.fields(command.schema) if "registry" in field.metadata]
    # A default that a group replaces must not have settings of its own.
    bases = {field.name: field.metadata["base"]() for field in grouped if field.default is dataclasses.MISSING}
    store.store(name=f"{command.name}_schema", node=command.schema(**bases))
    for field in grouped:
        store.repo.pop(field.name, None)  # choices of a command that ran before in this process
        for choice in (*field.metadata["registry"], *_references(field.name, arguments, config_dir)):
            load = load_all or any(choice in argument for argument in arguments)
            store.store(group=field.name, name=choice, node=choice_settings(field, choice, load=load))
    quiet = {"hydra_logging": "none", "job_logging": "none"}
    defaults = [{**entry, **{key: quiet[key] for key in entry if key in quiet}} for entry in HydraConf().defaults]
    conf = HydraConf(
        defaults=[*defaults, "_self_"],
        run=RunDir("."),
        sweep=SweepDir(scratch, "."),
        output_subdir=None,
        job=JobConf(name=command.name),
        help=HelpConf(app_name=command.name, header="", footer="", template="${modgnn_rl_help:}"),
    )
    store.store(group="hydra", name="config", node=conf)

    def show_help(*, _root_: DictConfig) -> str:
        return help_text(command.main, command.name, _root_).replace("$", "$$")

    OmegaConf.register_new_resolver("modgnn_rl_help", show_help, replace=True)


def _references(group: str, arguments: Sequence[str], config_dir: str | None) -> list[str]:
    """The choices of a group that name an object in a module, ``<module>:<name>``, typed or in files of the user."""
    given = [argument.partition("=")[2] for argument in arguments if argument.startswith(f"{group}=")]
    for file in Path(config_dir, group).glob("*.yaml") if config_dir else ():
        with contextlib.suppress(OSError, yaml.YAMLError, AttributeError):  # Hydra reports them
            given += map(str, yaml.safe_load(file.read_text(encoding="utf-8")).get("defaults", []))
    return [choice for value in given for choice in value.split(",") if ":" in choice and "{" not in choice]


def choice_settings(field: dataclasses.Field[Any], choice: str, *, load: bool) -> Any:
    """The settings of one choice of a field declared with `modgnn_rl.configs.settings.group`, with their defaults.

    Args:
        field: the field.
        choice: a name in its registry.
        load: import what is needed; otherwise the choice of an installed package, or one whose settings are declared
            beside code that imports torch, appears with the shared settings alone.

    Raises:
        InputError: the choice is registered with settings that are not derived from those that all choices share.
    """
    registry: Registry = field.metadata["registry"]
    base: type = field.metadata["base"]
    entry = registry[choice] if load else registry.peek(choice)
    declared = entry.options.get("settings") if entry else None
    is_slow = isinstance(declared, Reference) and not declared.is_cheap
    kind = base if entry is None or (is_slow and not load) else entry.option("settings", base)
    if not (isinstance(kind, type) and issubclass(kind, base)):
        raise InputError(f"{registry.kind} '{choice}' is registered with settings={kind}: expected a {base.__name__}")
    return typing.cast(Any, kind)(name=choice)


def compose(command: Command, job: Callable[[DictConfig], None]) -> None:
    """Let Hydra read ``sys.argv`` and call ``job`` with the configuration, once, or for each job of a multirun."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="provider=.* is not available")
        hydra.main(version_base="1.3", config_path=command.config_path, config_name=command.name)(job)()


def validate(command: Command, config: DictConfig) -> Any:
    """Turn a composed configuration into the command's dataclass and check it.

    Raises:
        InputError: an unknown setting, a missing one, or one out of range.
    """
    kind = OmegaConf.get_type(config)
    if not (isinstance(kind, type) and issubclass(kind, command.schema)):
        schema = f"{command.name}_schema"
        raise InputError(f"{command.name}.yaml has untyped settings: its defaults list must begin with {schema}")
    # +key=value and ~key change a configuration without asking its dataclass.
    for key, is_known in _changed_keys(config):
        raise InputError(
            f"{key} cannot be removed" if is_known else unknown_setting(key, known_settings(command.schema))
        )
    try:
        settings = OmegaConf.to_object(config)
    except OmegaConfBaseException as error:
        raise InputError(explain(error, known_settings(command.schema))) from error
    check(settings)
    return settings


def _changed_keys(config: DictConfig, prefix: str = "") -> Iterator[tuple[str, bool]]:
    """Yield each dotted key that the configuration has or its dataclasses have, but not both; true for the latter."""
    declared = {field.name for field in fields(config)}
    for key in declared ^ set(map(str, config)):
        yield f"{prefix}{key}", key in declared
    for key, child in children(config):
        yield from _changed_keys(child, f"{prefix}{key}.")


def known_settings(schema: type, prefix: str = "") -> list[str]:
    """Dotted names of all settings of a dataclass, those of all choices included."""
    hints = typing.get_type_hints(schema)
    found: dict[str, None] = {}
    for field in dataclasses.fields(schema):
        choices = field.metadata.get("registry", ())
        kinds = [hints[field.name], field.default_factory]
        kinds += [type(choice_settings(field, choice, load=False)) for choice in choices]
        names = [prefix + field.name]
        for kind in kinds:
            if dataclasses.is_dataclass(kind):
                names += known_settings(typing.cast(type, kind), f"{prefix}{field.name}.")
        found |= dict.fromkeys(names)
    return list(found)


def settings_given(config: Any) -> dict[str, Any]:
    """The settings named on the command line of the running command, by dotted name, with their composed values."""
    overrides = OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task))
    keys = [override.key_or_group for override in overrides]
    return {key: functools.reduce(getattr, key.split("."), config) for key in keys}


def job_name() -> str:
    """The command line of the running job of a multirun."""
    return ",".join(HydraConfig.get().overrides.task)
