"""Settings: dataclass fields that carry their own documentation and range.

A setting is declared once, in a dataclass beside the code it configures::

    @dataclass
    class FlockingConfig:
        comm_range: float = setting(3.5, "distance within which agents hear each other (m)", gt=0)

`check` compares any such dataclass, including nested ones, with the declared ranges: on the command line, and for
objects built in Python.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from omegaconf import MISSING

from modgnn_rl.errors import InputError, suggestion

__all__ = ["as_list", "check", "flat", "group", "overrides_of", "setting"]


def setting(
    default: Any,
    help: str,
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    choices: Collection[Any] | None = None,
    whole: bool = False,
    length: int | None = None,
) -> Any:
    """Declare a dataclass field with its documentation and its legal values.

    Args:
        default: default value; lists and dictionaries are copied for each instance.
        help: one line that says what the setting does, with its unit in brackets.
        ge: smallest legal value.
        gt: exclusive lower bound.
        le: largest legal value.
        choices: the legal values, if they can be listed, or a registry, whose names they are.
        whole: accept only integers and lists of integers, for settings typed as `Any`.
        length: length of a list.
    """
    metadata: dict[str, Any] = {"help": help, "ge": ge, "gt": gt, "le": le, "whole": whole, "length": length}
    metadata["choices"] = choices
    if isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=lambda: copy.copy(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def group(registry: Mapping[str, Any], base: type, *, default: type | None = None, required: bool = False) -> Any:
    """Declare a dataclass field whose choices are the entries of a registry, each with its own settings.

    ``<field>=<name>`` on the command line chooses an entry. Its settings are an instance, with that ``name``, of the
    dataclass that it was registered with (``settings=``), by default of ``base``.

    Args:
        registry: a `modgnn_rl.registry.Registry`.
        base: dataclass with a field ``name``, from which the settings of all entries are derived.
        default: dataclass of the default; default: ``base``.
        required: whether the field has no default, for dataclasses built in Python.
    """
    metadata = {"registry": registry, "base": base}
    if required:
        return dataclasses.field(default=MISSING, metadata=metadata)
    return dataclasses.field(default_factory=default or base, metadata=metadata)


def overrides_of(settings: type) -> type:
    """A dataclass with the settings of a task, all of them None, for changes to the environment of a training run.

    Args:
        settings: dataclass of the task's settings. Its name, and what an evaluation sets itself, are left out.
    """
    entries = [
        (entry.name, Any, dataclasses.field(default=None, metadata=entry.metadata))
        for entry in dataclasses.fields(settings)
        if entry.name not in ("name", "num_agents", "max_steps")
    ]
    doc = "Changes to the environment of the training run; null: as in training."
    return dataclasses.make_dataclass("EnvOverrides", entries, namespace={"__module__": __name__, "__doc__": doc})


def check(config: Any, path: str = "") -> None:
    """Check every setting of a dataclass against its declared range.

    Args:
        config: a dataclass instance whose fields were declared with `setting`; nested dataclasses are followed.
        path: name of ``config`` on the command line, for example ``env``.

    Raises:
        InputError: the first setting out of range, with what was expected.
    """
    for field in dataclasses.fields(config):
        name = f"{path}.{field.name}" if path else field.name
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            check(value, name)
            if "registry" in field.metadata:
                _check_group(name, value, field.metadata["registry"])
        elif "help" in field.metadata:
            if value is None and field.default is None:
                continue
            _check_list(name, value, field.metadata)


def _check_group(name: str, value: Any, registry: Any) -> None:
    """Raise InputError unless the settings of a field declared with `group` are those of the entry that they name."""
    if value.name is not None and not isinstance(value, registry[value.name].option("settings", object)):
        raise InputError(
            f"{name}.name={value.name} does not fit settings of type {type(value).__name__}: choose it by "
            f"{name}={value.name}"
        )


def _check_list(name: str, value: Any, rule: Any) -> None:
    """Raise InputError unless a value, or each item of a list, obeys the range declared with `setting`."""
    items = list(value) if isinstance(value, (list, tuple)) else [value]
    length = rule["length"] or max(1, len(items))
    if len(items) != length:
        raise InputError(f"{name}={items} has {len(items)} values; it needs {length} ({rule['help']})")
    for item in items:
        _check_value(name, item, rule)


def _check_value(name: str, value: Any, rule: Any) -> None:
    """Raise InputError unless one value obeys the range declared with `setting`."""
    choices = rule["choices"]
    if choices is not None and value not in choices:
        hint = suggestion(str(value), [str(choice) for choice in choices])
        raise InputError(f"{name}={value} is not one of {', '.join(map(str, choices))}{hint}")
    if rule["whole"] and (isinstance(value, bool) or not isinstance(value, int)):
        raise InputError(f"{name}={value} is not a whole number or a list of them ({rule['help']})")
    if all(rule[bound] is None for bound in ("ge", "gt", "le")):
        return
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{name}={value} is not a number ({rule['help']})")
    if math.isnan(value):
        raise InputError(f"{name} is not a number; expected {rule['help']}")
    bounds = (
        (rule["ge"] is not None and value < rule["ge"], f"at least {rule['ge']}"),
        (rule["gt"] is not None and value <= rule["gt"], f"greater than {rule['gt']}"),
        (rule["le"] is not None and value > rule["le"], f"at most {rule['le']}"),
    )
    for broken, expected in bounds:
        if broken:
            raise InputError(f"{name}={value} is out of range: it must be {expected} ({rule['help']})")


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name, as in ``{"env.comm_range": 3.5}``."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        leaves |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return leaves


def as_list(value: Any) -> list[Any]:
    """A setting that is one value or a list of them, as a list."""
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
