"""Policies and settings of run folders."""

from __future__ import annotations

import os
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


def load_policy(
    run: RunFolder | str | os.PathLike[str],
    *,
    device: torch.device | str = "cpu",
    which: str = "last",
    env_config: FlockingConfig | None = None,
) -> ModGNN:
    """Load the policy of a run.

    Args:
        run: a run folder, or its path ``runs/<date>-<name>``.
        device: device of the policy.
        which: ``last``: the latest; or ``best``: the one with the best score in training.
        env_config: environment config of the run, if it is loaded already.

    Returns:
        the policy, a TensorDictModule for flocks of any size, in evaluation mode.

    Raises:
        InputError: not a run folder, no readable checkpoint, or a checkpoint of another model.
    """
    run = run if isinstance(run, RunFolder) else RunFolder.open(run)
    model = stored_model(run)
    policy = configured_model(model, env_config or load_env_config(run), seed=0)
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
    """The model settings of a run.

    Raises:
        InputError: its configuration is damaged.
    """
    model: ModelConfig = _stored(run, "model", ModelConfig)
    return model


def load_env_config(run: RunFolder) -> FlockingConfig:
    """The environment config of a run.

    Raises:
        InputError: its configuration is damaged.
    """
    env_config: FlockingConfig = _stored(run, "env", FlockingConfig)
    return env_config


def override_env_config(env_config: FlockingConfig, overrides: Any) -> tuple[FlockingConfig, dict[str, Any]]:
    """Change some settings of an environment.

    Args:
        env_config: environment config, such as that of a run.
        overrides: a `modgnn_rl.configs.schema.EnvOverrides`; its settings that are None stay as they are.

    Returns:
        the changed environment config, and by name the settings that it changes.

    Raises:
        InputError: a value of the wrong kind.
    """
    changed = {name: value for name, value in vars(overrides).items() if value is not None}
    try:
        found: Any = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(env_config), changed))
    except OmegaConfBaseException as error:
        raise InputError(f"env.{error.full_key}: {str(error.msg).splitlines()[0]}") from error
    return found, changed


def _stored(run: RunFolder, group: str, schema: type) -> Any:
    """Read one group of a stored configuration back into its dataclass."""
    try:
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), run.config[group]))
    except (KeyError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{group} in {run.path / 'config.yaml'} is not as training wrote it: {reason}") from error
    check(settings, group)
    return settings
