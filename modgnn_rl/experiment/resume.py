"""What a run may change when it goes on: the settings of before, with changes, and what these cost."""

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

# What the weights, or what has been drawn, were made for.
FIXED = (
    "model",
    "trainer.name",
    "trainer.models",
    "trainer.hops",
    "trainer.seeds",
    "trainer.gate",
    "trainer.ensemble",
    "trainer.critic_hidden",
    "init_from",
    "seed",
    "runs",
    "name",
)
# What rollouts and data were made for: with another of these, flocks begin anew, with no data.
FLOWN = (
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
NOT_FLOWN = ("env.on_nonfinite", "collector.timeout", "collector.ray_address")


def stored_config(run: RunFolder) -> TrainConfig:
    """The settings of a training run.

    Raises:
        InputError: they are not as this version writes them.
    """
    try:
        trainer = TRAINERS[run.config["trainer"]["name"]].option("settings")()
        structure = OmegaConf.structured(TrainConfig(trainer=trainer))
        return cast(TrainConfig, OmegaConf.to_object(OmegaConf.merge(structure, run.config)))
    except (InputError, KeyError, TypeError, OmegaConfBaseException) as error:
        raise InputError(
            f"{run.path / 'config.yaml'} is not as this version writes it ({str(error).splitlines()[0]}): resume the "
            "run with the version that began it"
        ) from error


def changed_config(old: TrainConfig, changes: Mapping[str, Any]) -> TrainConfig:
    """Settings with some changed.

    Args:
        old: the settings.
        changes: new values by dotted names, as in ``{"trainer.rounds": 160, "logger": "csv"}``; of a trainer or a
            model only the name counts.

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
        InputError: a run that has begun cannot change one of these.
    """
    before, after = (flat(cast(Any, OmegaConf.to_container(OmegaConf.structured(config)))) for config in (old, new))
    found = {key: (before.get(key), value) for key, value in after.items() if before.get(key) != value}
    fixed = [f"{key} from {was} to {value}" for key, (was, value) in found.items() if _is_among(key, FIXED)]
    if fixed:
        raise InputError(
            f"a run that has begun cannot change {', '.join(fixed)}; leave that out, or begin another run, with "
            "init_from= where its policy should be that of this one"
        )
    return found


def requires_restart(changed: Mapping[str, tuple[Any, Any]]) -> list[str]:
    """Those of the changed settings with which flocks begin anew, as ``name=value``."""
    return [
        f"{key}={value}"
        for key, (_, value) in changed.items()
        if _is_among(key, FLOWN) and not _is_among(key, NOT_FLOWN)
    ]


def with_stored_trainer(arguments: Sequence[str]) -> list[str]:
    """A command line that names the trainer of the run that it resumes, so that settings of that trainer are known."""
    named = list(arguments)
    if not any(argument.startswith("trainer=") for argument in arguments):
        for index, argument in enumerate(arguments):
            if argument.startswith("resume="):
                # What is wrong with a folder is said later, where the run is opened.
                with contextlib.suppress(InputError, KeyError, TypeError):
                    trainer = RunFolder.open(Path(argument.partition("=")[2])).config["trainer"]["name"]
                    named.insert(index + 1, f"trainer={trainer}")
    return named


def _is_among(key: str, names: Sequence[str]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)
