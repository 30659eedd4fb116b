"""Policies from run folders."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from modgnn_rl.configs.schema import FlockingConfig, ModelConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.models.factory import configured_model
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder

__all__ = ["load_env_config", "load_policy", "override_env_config", "stored_model"]


def load_policy(folder: str | os.PathLike[str], *, device: torch.device | str = "cpu", which: str = "last") -> ModGNN:
    """Load the policy that a run ended with, or reached so far.

    Args:
        folder: a run folder, ``runs/<date>-<name>``.
        device: where the policy goes.
        which: ``last``, or ``best``: the one with the best score while it trained.

    Returns:
        the policy, a TensorDictModule for flocks of any size, in evaluation mode.

    Raises:
        InputError: the folder holds no run, no readable checkpoint, or one of another model.
    """
    run = RunFolder.open(Path(folder))
    model = stored_model(run)
    policy = configured_model(model, load_env_config(run), seed=0)
    checkpoint = load_checkpoint(run.best if which == "best" else run.checkpoints, groups=("policy",))
    try:
        policy.load_state_dict(checkpoint.tensors["policy"])
    except (KeyError, RuntimeError) as error:
        raise InputError(
            f"the checkpoint {checkpoint.path} does not fit the model '{model.name}' of {run.path / 'config.yaml'}; "
            "restore the folder as training wrote it"
        ) from error
    return policy.to(device).eval()


def stored_model(run: RunFolder) -> ModelConfig:
    """The model that a run trained.

    Raises:
        InputError: its configuration does not describe one.
    """
    model: ModelConfig = _stored(run, "model", ModelConfig)
    return model


def load_env_config(run: RunFolder) -> FlockingConfig:
    """The world that a run was trained in.

    Raises:
        InputError: its configuration does not describe one.
    """
    env_config: FlockingConfig = _stored(run, "env", FlockingConfig)
    return env_config


def override_env_config(run: RunFolder, changes: Any) -> tuple[FlockingConfig, dict[str, Any]]:
    """The world that a run was trained in, with some settings changed.

    Args:
        run: the run.
        changes: a `modgnn_rl.configs.schema.EnvOverrides`.

    Returns:
        the world, and by name the settings that are changed.

    Raises:
        InputError: a value of the wrong kind.
    """
    changed = {name: value for name, value in vars(changes).items() if value is not None}
    try:
        env_config: Any = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(load_env_config(run)), changed))
    except OmegaConfBaseException as error:
        raise InputError(f"env.{error.full_key}: {str(error.msg).splitlines()[0]}") from error
    return env_config, changed


def _stored(run: RunFolder, group: str, schema: type) -> Any:
    """Read one group of a stored configuration back into its dataclass."""
    try:
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), run.config[group]))
    except (KeyError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{group} in {run.path / 'config.yaml'} is not as training wrote it: {reason}") from error
    check(settings, group)
    return settings
