"""From a run folder to a rollout that can be looked at."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import FlockingConfig, ReplayConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.recording import record
from modgnn_rl.evaluation.rollout import reference_policies
from modgnn_rl.tracking.loading import load_policy, override_env_config
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.device import prepare_torch
from modgnn_rl.utils.progress import Progress
from modgnn_rl.visualization.html import write_replay
from modgnn_rl.visualization.recording import Recording, recording_stride

__all__ = ["replay_run"]


def replay_run(config: ReplayConfig) -> Path:
    """Fly the policy of a run, the expert and the policies of other runs from one start, and write what it looks like.

    Returns:
        the file.

    Raises:
        InputError: a bad setting, no such run, no readable policy in it, or no such device.
    """
    check(config)
    prepare_torch(config.device, config.threads)
    run = RunFolder.open(config.run)
    env_config, changes = override_env_config(run, config.env)
    if config.num_agents is None and len(env_config.sizes) > 1:
        raise InputError(
            f"the run was trained with {env_config.sizes} agents; choose one size: num_agents={env_config.sizes[0]}"
        )
    agents = config.num_agents or env_config.sizes[0]
    path = Path(config.output or run.path / f"replay.{config.format}").absolute()
    policies = _policies(config, env_config)
    name, policy = next(iter(policies.items()))
    rollout: dict[str, Any] = {
        "num_agents": agents, "steps": config.steps, "seed": config.seed, "device": config.device
    }  # fmt: skip
    try:
        if config.format == "mp4":
            from modgnn_rl.visualization.video import VIDEO_STRIDE, check_video, write_video

            check_video()
            write_video(path, record(policy, env_config, stride=VIDEO_STRIDE, **rollout))
            return path
        stride = config.stride or recording_stride(agents, config.steps)
        still = config.format in ("svg", "png")
        shown = config.steps - 1 if config.step is None else config.step
        if still:  # nothing after it is seen
            stride, rollout["steps"] = 1, shown + 1
        recordings = _fly_all(policies, env_config, stride, config, rollout)
        facts = {"run": run.path.name, "flown": f"{agents} agents, {config.steps} steps, seed {config.seed}"}
        facts |= {"checkpoint": config.checkpoint} | {f"env.{key}": value for key, value in changes.items()}
        if still:
            from modgnn_rl.visualization.image import write_image

            write_image(path, recordings, shown)
        else:
            write_replay(path, recordings, f"{run.path.name}: {name}", facts)
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}); give output=<a file that you can write>") from error
    return path


def _policies(config: ReplayConfig, env_config: FlockingConfig) -> dict[str, TensorDictModuleBase]:
    """Who flies, by name: the run's policy first, then the expert, then others."""
    folders = [config.run, *as_list(config.others or [])]
    policies: dict[str, TensorDictModuleBase] = {}
    for folder in folders:
        run = RunFolder.open(folder)
        name = str(run.config["model"]["name"])
        if name in policies:
            name = f"{name}, {run.path.name}"
        policies[name] = load_policy(folder, device=config.device, which=config.checkpoint)
        if config.with_expert and len(policies) == 1:
            policies["expert"] = reference_policies(env_config)["expert"]
    return policies


def _fly_all(
    policies: dict[str, TensorDictModuleBase],
    env_config: FlockingConfig,
    stride: int,
    config: ReplayConfig,
    rollout: dict[str, Any],
) -> dict[str, Recording]:
    """Record everybody's rollout; the first one is shown while it is flown, where that is asked for."""
    recordings: dict[str, Recording] = {}
    with (
        contextlib.ExitStack() as stack,
        Progress("replay", len(policies) * rollout["steps"]) as progress,
    ):
        for name, policy in policies.items():
            progress.update(flying=name)
            viewer = None
            if config.viewer and not recordings:
                from modgnn_rl.visualization.viewer import Viewer

                viewer = stack.enter_context(Viewer(env_config.control_frequency, config.port))
            recordings[name] = record(policy, env_config, stride=stride, progress=progress, on_frame=viewer, **rollout)
    return recordings
