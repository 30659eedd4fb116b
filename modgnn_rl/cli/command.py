"""What every ``python -m modgnn_rl.<command>`` shares: its configuration, its help and its error messages.

A command is a function of one dataclass::

    def main(config: TrainConfig) -> None:
        \"\"\"Train a flock.\"\"\"
        from modgnn_rl.experiment.training import train  # heavy imports only now: a typing error must be reported at
        once

        train(config)


    if __name__ == "__main__":
        run_command(main, TrainConfig, "train", nodes={"trainer/dagger": DaggerConfig})

Hydra composes the configuration from ``configs/``; nothing is written and the working directory is kept. Whatever
the user can mend is one line on stderr and exit code 2; a bug keeps its traceback.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import io
import os
import re
import sys
import tempfile
import traceback
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import hydra
import yaml
from hydra.conf import HelpConf, HydraConf, JobConf, RunDir, SweepDir
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from modgnn_rl.cli.help import children, fields, help_text
from modgnn_rl.cli.overview import completion
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.registry import MODELS
from modgnn_rl.utils.internals import parse_hydra_flags
from modgnn_rl.utils.signals import Stopped

__all__ = ["run_command", "settings_given"]

Config = TypeVar("Config")

PIPE_CLOSED = 141  # what a shell says of a tool that SIGPIPE ended

# What Hydra raises for a command line or a YAML file that the user can mend, as long as no job has begun.
USER_ERRORS = (HydraException, OmegaConfBaseException, yaml.YAMLError, OSError, UserWarning, ValueError)


def run_command(
    main: Callable[[Config], int | None],
    schema: type[Config],
    name: str,
    *,
    nodes: Mapping[str, type] | None = None,
    config_path: str = "pkg://modgnn_rl.configs",
) -> None:
    """Compose the configuration that the command line asks for and call ``main`` with it.

    The folder behind ``config_path`` holds ``<name>.yaml``, whose defaults list begins with ``<name>_schema``, and one
    folder of YAML files for each group. A group whose choices have different settings types its files through
    ``nodes``: the entry ``"trainer/dagger"`` is listed in ``trainer/dagger.yaml`` as ``/trainer_dagger_schema@_here_``.

    Args:
        main: the command; its docstring heads the help, its return value is the exit code (``None`` counts as 0).
        schema: dataclass of the whole configuration, declared with `modgnn_rl.configs.settings.setting`.
        name: name of the command and of its YAML file.
        nodes: dataclasses of single choices, by ``"group/choice"``.
        config_path: where Hydra looks for the YAML files.

    Raises:
        SystemExit: with code 2 after an error that the user can mend, 130 after Ctrl-C, 143 after SIGTERM, 141 when
            who reads the output has seen enough, as in ``| head``, or the code of ``main``. In a multirun a job that
            fails does not stop the others; the code is then the highest.
    """
    nodes = nodes or {}
    known = [*_dotted(schema), *(f"{k.split('/')[0]}.{key}" for k, node in nodes.items() for key in _dotted(node))]
    codes: list[int] = []
    failed: list[str] = []
    job_began = False

    def job_for(act: Callable[[Config], int | None]) -> Callable[[DictConfig], None]:
        def job(config: DictConfig) -> None:
            nonlocal job_began
            job_began = True
            try:
                code = act(_settings(config, schema, name, known)) or 0
                codes.extend([code] if act is main else [])
            except InputError as error:
                code = _report(str(error))
                if not (goes_on and act is main):
                    # SystemExit passes through Hydra without the lines that Hydra adds to a failed job.
                    raise SystemExit(code) from error
                codes.append(code)
                failed.append(_job_name())
            except Exception as error:
                if isinstance(error, BrokenPipeError) and _reader_has_left():
                    raise SystemExit(PIPE_CLOSED) from error
                if not (goes_on and act is main):
                    raise
                traceback.print_exc()
                codes.append(1)
                failed.append(_job_name())

        return job

    # Hydra's own error messages run over several lines; with this set it raises what happened instead.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    flags = _flags()
    if flags.multirun and "TORCHELASTIC_RUN_ID" in os.environ:
        sys.exit(_report("torchrun starts one run, --multirun several; start torchrun once for each run"))
    # All jobs of a multirun are checked before the first begins, unless the user brings a launcher or a sweeper.
    rehearse = flags.multirun and not any(override.startswith("hydra/") for override in flags.overrides)
    goes_on = flags.multirun  # a job that fails does not stop the others
    # A multirun writes its multirun.yaml whatever the settings say; our run folders hold all that it says.
    with tempfile.TemporaryDirectory(prefix="modgnn_rl-") as scratch:
        _register(main, schema, name, nodes, scratch)
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("error", message="provider=.* is not available")
                for act in [lambda _: 0, main] if rehearse else [main]:
                    start = hydra.main(version_base="1.3", config_path=config_path, config_name=name)(job_for(act))
                    _answer_tab(start, flags.overrides, schema) if flags.shell_completion else start()
                sys.stdout.flush()  # here a pipe that is closed is still ours to see
        except Stopped as stop:
            sys.exit(stop.code)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            sys.exit(130)
        except BrokenPipeError:
            if not _reader_has_left():
                raise
            sys.exit(PIPE_CLOSED)
        except USER_ERRORS as error:
            if job_began:
                raise
            sys.exit(_report(_explain(error, known)))
    if failed:
        print(f"{len(failed)} of {len(codes)} jobs failed: {'; '.join(failed)}", file=sys.stderr)
    if any(codes):
        sys.exit(max(codes))


def _answer_tab(hydra_main: Callable[[], Any], arguments: list[str], schema: type) -> None:
    """Print our script for ``install=<shell>``, since Hydra's knows no ``python -m``, or what Hydra offers to Tab.

    What it offers beside this command's settings, choices of other commands and settings of its own, is kept back.
    """
    if arguments[:1] and arguments[0].startswith("install="):
        print(completion(arguments[0].removeprefix("install=")))
        return
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        hydra_main()
    own = {field.name for field in dataclasses.fields(schema)}
    print("\n".join(word for word in output.getvalue().split() if re.split("[.=]", word.lstrip("+~"))[0] in own))


def _reader_has_left() -> bool:
    """Whether it is the standard output that cannot be written any more; Python must then not try again at its end."""
    try:
        print(flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def settings_given(config: Any) -> dict[str, Any]:
    """The settings that the command line of the running command names, by their dotted names, as composed."""
    overrides = OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task))
    keys = [override.key_or_group for override in overrides]
    return {key: functools.reduce(getattr, key.split("."), config) for key in keys}


def _job_name() -> str:
    """What the command line says of one of several jobs."""
    return ",".join(HydraConfig.get().overrides.task)


def _report(message: str) -> int:
    """Print one error line; return the exit code that goes with it."""
    print("error:", " ".join(message.split()), file=sys.stderr)
    return 2


def _flags() -> argparse.Namespace:
    """Parse the command line as Hydra will; report a flag it does not know in one line, without argparse's usage."""
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            return parse_hydra_flags(sys.argv[1:])
    except SystemExit as stop:
        if not stop.code:
            raise
        reason = output.getvalue().rpartition("error: ")[2]
        sys.exit(_report(f"{reason.strip()}; flags stand before or after all settings, and --help lists them"))


def _register(main: Callable[..., Any], schema: type, name: str, nodes: Mapping[str, type], sweep_folder: str) -> None:
    """Give Hydra the dataclasses, and defaults under which it writes nothing."""
    store = ConfigStore.instance()
    store.store(name=f"{name}_schema", node=schema)
    for key, node in nodes.items():
        store.store(name=f"{key.replace('/', '_')}_schema", node=node)
    for model in MODELS:  # model=<name> needs no YAML file
        store.store(group="model", name=model, node={"name": model})
    quiet = {"hydra_logging": "none", "job_logging": "none"}
    defaults = [{**entry, **{key: quiet[key] for key in entry if key in quiet}} for entry in HydraConf().defaults]
    conf = HydraConf(
        defaults=[*defaults, "_self_"],
        run=RunDir("."),
        sweep=SweepDir(sweep_folder, "."),
        output_subdir=None,
        job=JobConf(name=name),
        help=HelpConf(app_name=name, header="", footer="", template="${modgnn_rl_help:}"),
    )
    store.store(group="hydra", name="config", node=conf)
    OmegaConf.register_new_resolver(
        "modgnn_rl_help", lambda *, _root_: help_text(main, name, _root_).replace("$", "$$"), replace=True
    )


def _settings(config: DictConfig, schema: type[Config], name: str, known: list[str]) -> Config:
    """Turn a composed configuration into its dataclass and check it.

    Raises:
        InputError: an unknown setting, one that is missing, or one out of range.
    """
    if not (isinstance(kind := OmegaConf.get_type(config), type) and issubclass(kind, schema)):
        raise InputError(f"the configuration has no types: its defaults list must begin with {name}_schema")
    # +key=value and ~key change a configuration without asking its dataclass.
    for key, is_known in _changed(config):
        raise InputError(f"{key} cannot be taken away" if is_known else _unknown_setting(key, known))
    try:
        settings = OmegaConf.to_object(config)
    except OmegaConfBaseException as error:
        raise InputError(_explain(error, known)) from error
    check(settings)
    return typing.cast(Config, settings)


def _changed(config: DictConfig, prefix: str = "") -> Iterator[tuple[str, bool]]:
    """Yield each dotted key that the configuration has or its dataclasses have, but not both; true for the latter."""
    declared = {field.name for field in fields(config)}
    for key in declared ^ set(map(str, config)):
        yield f"{prefix}{key}", key in declared
    for key, child in children(config):
        yield from _changed(child, f"{prefix}{key}.")


def _dotted(schema: type, prefix: str = "") -> Iterator[str]:
    """Yield the dotted key of every setting of a dataclass."""
    hints = typing.get_type_hints(schema)
    for field in dataclasses.fields(schema):
        yield prefix + field.name
        if dataclasses.is_dataclass(hint := hints[field.name]):
            yield from _dotted(typing.cast(type, hint), f"{prefix}{field.name}.")


def _unknown_setting(key: str, known: list[str]) -> str:
    """Say that a setting does not exist, and which was probably meant."""
    leaf = key.rpartition(".")[2]
    same_leaf = next((setting for setting in known if setting.rpartition(".")[2] == leaf and setting != key), None)
    hint = f"; did you mean '{same_leaf}'?" if same_leaf else suggestion(key, known)
    return f"unknown setting {key}{hint or '; --help lists them all'}"


def _explain(error: BaseException, known: list[str]) -> str:
    """Put an error of Hydra, OmegaConf or YAML in the words of the command line."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, choice = error.missing_cfg_file.rpartition("/")
        if error.options:
            return f"{group}={choice} is not one of {', '.join(error.options)}{suggestion(choice, error.options)}"
        return f"there is no configuration {error.missing_cfg_file}.yaml where configurations are looked for"
    if isinstance(error, OverrideParseException):
        return f"cannot read '{error.override}': {error.message.splitlines()[0]}; expected key=value"
    if foreign := re.match(r"Could not override '([^']*)'\.\s+No match in the defaults list", str(error)):
        return f"this command has no choice {foreign[1]}; --help lists what it has"
    cause = error if isinstance(error, OmegaConfBaseException) else error.__cause__ or error.__context__
    if not isinstance(cause, OmegaConfBaseException):
        return str(error) or type(error).__name__
    file = re.match(r"In '[^']*': ", str(error))
    return (file[0] if file else "") + _explain_value(cause, known)


def _explain_value(error: OmegaConfBaseException, known: list[str]) -> str:
    """Put what OmegaConf has against one value in the words of the command line."""
    key = error.full_key or str(error.key)
    if isinstance(error, (ConfigKeyError, ConfigAttributeError)):
        return _unknown_setting(key, known)
    if isinstance(error, MissingMandatoryValue):
        return f"{key} must be given, as in {key}=..."
    reason = str(error.msg or error).splitlines()[0]
    return f"{key}: {reason}" if error.full_key else reason
