"""Policies and settings of run folders."""

from __future__ import annotations

import os
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from modgnn_rl.configs.schema import ModelConfig, TaskConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.models.factory import configured_model
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import TASKS
from modgnn_rl.task import Task, make_task
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder

__all__ = ["changed_task", "load_env_config", "load_policy", "load_task", "stored_model"]


def load_policy(
    run: RunFolder | str | os.PathLike[str],
    *,
    device: torch.device | str = "cpu",
    which: str = "last",
    task: Task | None = None,
) -> ModGNN:
    """Load the policy of a run.

    Args:
        run: a run folder, or its path ``runs/<date>-<name>``.
        device: device of the policy.
        which: ``last``: the latest; or ``best``: the one with the best score in training.
        task: task of the run, if it is loaded already.

    Returns:
        the policy, a TensorDictModule for flocks of any size, in evaluation mode.

    Raises:
        InputError: not a run folder, no readable checkpoint, or a checkpoint of another model.
    """
    run = run if isinstance(run, RunFolder) else RunFolder.open(run)
    model = stored_model(run)
    policy = configured_model(model, task or load_task(run), seed=0)
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


def load_task(run: RunFolder) -> Task:
    """The task of a run, with its settings.

    Raises:
        InputError: its configuration is damaged, or the task is not known here.
    """
    task: Task = make_task(load_env_config(run))
    return task


def load_env_config(run: RunFolder) -> Any:
    """The settings of a run's task.

    Raises:
        InputError: its configuration is damaged, or the task is not known here.
    """
    name = (run.config.get("env") or {}).get("name")
    if name is None:
        raise InputError(
            f"{run.path / 'config.yaml'} does not name the task, env.name; restore it as training wrote it"
        )
    return _stored(run, "env", TASKS[str(name)].option("settings", TaskConfig))


def changed_task(task: Task, overrides: Any) -> tuple[Task, dict[str, Any]]:
    """Change some settings of a task.

    Args:
        task: such as that of a run.
        overrides: an instance of what `modgnn_rl.configs.settings.overrides_of` makes of the task's settings; those
            that are None stay as they are.

    Returns:
        the changed task, and by name the settings that it changes.

    Raises:
        InputError: the task has no such setting, or a value is of the wrong kind.
    """
    changed = {name: value for name, value in vars(overrides).items() if value is not None}
    try:
        found: Any = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(task.config), changed))
    except OmegaConfBaseException as error:
        raise InputError(f"env.{error.full_key}: {str(error.msg).splitlines()[0]}") from error
    check(found, "env")
    return make_task(found), changed


def _stored(run: RunFolder, group: str, schema: type) -> Any:
    """Read one group of a stored configuration back into its dataclass."""
    try:
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), run.config[group]))
    except (KeyError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{group} in {run.path / 'config.yaml'} is not as training wrote it: {reason}") from error
    check(settings, group)
    return settings
