"""Settings of a resumed run: those it was started with, changes to them, and what these changes affect."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from modgnn_rl.configs.schema import TrainConfig
from modgnn_rl.configs.settings import flat
from modgnn_rl.errors import InputError
from modgnn_rl.registry import TRAINERS
from modgnn_rl.tracking.run_folder import RunFolder

__all__ = [
    "changed_config",
    "differences",
    "requires_restart",
    "stored_config",
    "with_stored_trainer",
]

# Settings that cannot change once a run has started, beside those of the trainer's own option `fixed`.
FIXED = ("model", "trainer.name", "init_from", "seed", "runs", "name")
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
        structure = OmegaConf.structured(TrainConfig(trainer=trainer))
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
        key, value = (f"{key}.name", value.name) if key in ("trainer", "model") else (key, value)
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


def with_stored_trainer(arguments: Sequence[str]) -> list[str]:
    """The arguments of a command line, with the trainer of the run that it resumes, whose settings are then known."""
    named = list(arguments)
    if not any(argument.startswith("trainer=") for argument in arguments):
        for index, argument in enumerate(arguments):
            if argument.startswith("resume="):
                # Errors of the folder are reported later, where the run is opened.
                with contextlib.suppress(InputError, KeyError, TypeError):
                    trainer = RunFolder.open(Path(argument.partition("=")[2])).config["trainer"]["name"]
                    named.insert(index + 1, f"trainer={trainer}")
    return named


def _is_among(key: str, names: Sequence[str]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)
