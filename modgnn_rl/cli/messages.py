"""Error messages of the command line: what Hydra, OmegaConf and YAML report, in one sentence."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, MissingMandatoryValue, OmegaConfBaseException

from modgnn_rl.errors import suggestion

__all__ = ["explain", "print_error", "unknown_setting"]


def print_error(message: str) -> None:
    """Print one error line to stderr."""
    print("error:", " ".join(message.split()), file=sys.stderr)


def unknown_setting(key: str, known: Sequence[str]) -> str:
    """Say that a setting does not exist, and which one was probably meant."""
    leaf = key.rpartition(".")[2]
    same_leaf = next((setting for setting in known if setting.rpartition(".")[2] == leaf and setting != key), None)
    hint = f"; did you mean '{same_leaf}'?" if same_leaf else suggestion(key, known)
    return f"unknown setting {key}{hint or '; --help lists them all'}"


def explain(error: BaseException, known: Sequence[str]) -> str:
    """Say what was wrong with a command line or a YAML file.

    Args:
        error: what Hydra, OmegaConf or YAML raised.
        known: dotted names of the command's settings.
    """
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if error.options:
            return f"{group}={choice} is not one of {', '.join(error.options)}{suggestion(choice, error.options)}"
        return f"{error.missing_cfg_file}.yaml was not found in the folders of configuration files"
    if isinstance(error, OverrideParseException):
        return f"cannot read '{error.override}': {error.message.splitlines()[0]}; expected key=value"
    if foreign := re.match(r"Could not override '([^']*)'\.\s+No match in the defaults list", str(error)):
        return f"this command has no group {foreign[1]}; --help lists its groups and choices"
    cause = error if isinstance(error, OmegaConfBaseException) else error.__cause__ or error.__context__
    if not isinstance(cause, OmegaConfBaseException):
        return str(error) or type(error).__name__
    file = re.match(r"In '([^']*)': ", str(error))
    key = cause.full_key or str(cause.key)
    if file and isinstance(cause, ConfigKeyError) and key in known:
        group = key.partition(".")[0]
        return (
            f"{file[1]}.yaml has settings of {group} but does not say of which: begin it with the lines "
            f"'defaults:', '  - flocking' or another choice of {group}=, and '  - _self_'"
        )
    return (file[0] if file else "") + _explain_value(cause, known)


def _explain_value(error: OmegaConfBaseException, known: Sequence[str]) -> str:
    """Say what was wrong with one value."""
    key = error.full_key or str(error.key)
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        return unknown_setting(key, known)
    if isinstance(error, MissingMandatoryValue):
        return f"{key} must be given, as in {key}=..."
    reason = str(error.msg or error).splitlines()[0]
    if "does not support deletion" in reason:
        return f"{key} cannot be removed"
    return f"{key}: {reason}" if error.full_key else reason
