"""Settings of a resumed run: those it was started with, changes to them, and what these changes affect."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from modgnn_rl.configs.schema import TaskConfig, TrainConfig
from modgnn_rl.configs.settings import flat, overrides_of
from modgnn_rl.errors import InputError
from modgnn_rl.registry import TASKS, TRAINERS
from modgnn_rl.tracking.run_folder import RunFolder

__all__ = [
    "changed_config",
    "differences",
    "for_task_of_run",
    "requires_restart",
    "stored_config",
    "with_stored_choices",
]

# Settings that cannot change once a run has started, beside those of the trainer's own option `fixed`.
FIXED = ("model", "trainer.name", "env.name", "init_from", "seed", "runs", "name")
# If one of these changes, environments and training data start afresh.
RESTARTING = (
    "env",
    "device",
    "collector",
    "trainer.num_envs",
    "trainer.num_val_envs",
    "trainer.capacity",
    "trainer.stride",
    "trainer.replacement",
    "trainer.hide_velocity",
)
NOT_RESTARTING = ("env.on_nonfinite", "collector.timeout", "collector.ray_address")


def stored_config(run: RunFolder) -> TrainConfig:
    """The settings of a training run.

    Raises:
        InputError: they are not as this version writes them, or the trainer is unknown.
    """
    try:
        trainer = TRAINERS[run.config["trainer"]["name"]].option("settings")()
        env = TASKS[run.config["env"]["name"]].option("settings", TaskConfig)()
        structure = OmegaConf.structured(TrainConfig(env=env, trainer=trainer))
        return cast(TrainConfig, OmegaConf.to_object(OmegaConf.merge(structure, run.config)))
    except (InputError, KeyError, TypeError, OmegaConfBaseException) as error:
        raise InputError(
            f"{run.path / 'config.yaml'} is not as this version writes it ({str(error).splitlines()[0]}): resume the "
            "run with the version that started it"
        ) from error


def changed_config(old: TrainConfig, changes: Mapping[str, Any]) -> TrainConfig:
    """Settings with some changed.

    Args:
        old: the settings.
        changes: new values by dotted names, as in ``{"trainer.rounds": 160, "logger": "csv"}``; of a trainer or a
            model only the name is used.

    Raises:
        InputError: there is no such setting, or it cannot have that value.
    """
    structure = OmegaConf.structured(old)
    for key, value in changes.items():
        if key in ("trainer", "model") or (key == "env" and value.name != old.env.name):
            key, value = f"{key}.name", value.name
        elif key == "env" and value.name != TrainConfig().env.name:
            continue  # the task that `with_stored_choices` has named
        try:
            OmegaConf.update(structure, key, value)
        except OmegaConfBaseException as error:
            raise InputError(f"{key}: {str(error.msg or error).splitlines()[0]}") from error
    return cast(TrainConfig, OmegaConf.to_object(structure))


def differences(old: TrainConfig, new: TrainConfig) -> dict[str, tuple[Any, Any]]:
    """The settings that differ, by their dotted names: old and new value.

    Raises:
        InputError: one of them cannot change in a run that has started.
    """
    before, after = (flat(cast(Any, OmegaConf.to_container(OmegaConf.structured(config)))) for config in (old, new))
    found = {key: (before.get(key), value) for key, value in after.items() if before.get(key) != value}
    own = [f"trainer.{name}" for name in TRAINERS[old.trainer.name].option("fixed", ())]
    fixed = [f"{key} from {was} to {value}" for key, (was, value) in found.items() if _is_among(key, [*FIXED, *own])]
    if fixed:
        raise InputError(
            f"a run that has started cannot change {', '.join(fixed)}; leave that out, or start a new run, with "
            "init_from= to start from this run's policy"
        )
    return found


def requires_restart(changed: Mapping[str, tuple[Any, Any]]) -> list[str]:
    """The changed settings because of which environments and data start afresh, as ``name=value``."""
    return [
        f"{key}={value}"
        for key, (_, value) in changed.items()
        if _is_among(key, RESTARTING) and not _is_among(key, NOT_RESTARTING)
    ]


def with_stored_choices(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command line, with the trainer and the task of the run that it resumes.

    Their settings are then known. The flocking task is the default, and need not be named.
    """
    named = list(arguments)
    for index, argument in enumerate(arguments):
        if argument.startswith("resume="):
            config = _config_of(argument)
            for group in ("trainer", "env"):
                name = (config.get(group) or {}).get("name")
                if name and name != TrainConfig().env.name and not _is_given(group, arguments):
                    named.insert(index + 1, f"{group}={name}")
    return named


def for_task_of_run(schema: type, arguments: Sequence[str]) -> type:
    """The settings of a command with those of the task of the run that it is for, under ``env``.

    Args:
        schema: settings with the fields ``run`` and ``env``, the changes to the environment.
        arguments: command line.
    """
    folders = [argument for argument in arguments if argument.startswith("run=")]
    name = (_config_of(folders[0]).get("env") or {}).get("name") if folders else None
    with contextlib.suppress(InputError):  # an unknown task is reported when the run is opened
        if name is not None:
            env = dataclasses.field(default_factory=overrides_of(TASKS[name].option("settings", TaskConfig)))
            about = {"__doc__": schema.__doc__, "__module__": schema.__module__}
            return dataclasses.make_dataclass(schema.__name__, [("env", Any, env)], bases=(schema,), namespace=about)
    return schema


def _config_of(argument: str) -> dict[str, Any]:
    """The configuration of the run folder that ``<setting>=<folder>`` names; errors are reported where it is opened."""
    with contextlib.suppress(InputError, KeyError, TypeError):
        return RunFolder.open(Path(argument.partition("=")[2])).config
    return {}


def _is_given(group: str, arguments: Sequence[str]) -> bool:
    return any(argument.startswith(f"{group}=") for argument in arguments)


def _is_among(key: str, names: Sequence[str]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)
