"""Replay the policy of a run: roll out, record, and write a page, a video or an image."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import ReplayConfig, as_list
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.recording import record
from modgnn_rl.task import Task
from modgnn_rl.tracking.loading import changed_task, load_policy, load_task
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.device import prepare_torch
from modgnn_rl.utils.progress import Progress
from modgnn_rl.visualization.html import write_replay
from modgnn_rl.visualization.recording import Recording, recording_stride

__all__ = ["replay_run"]


def replay_run(config: ReplayConfig) -> Path:
    """Roll out the policy of a run, the expert, and policies of other runs from one start, and write what they do.

    Returns:
        the file: a page, a video, or an image.

    Raises:
        InputError: a bad setting, no such run, no readable policy in it, or no such device.
    """
    check(config)
    prepare_torch(config.device, config.threads)
    runs = [RunFolder.open(folder) for folder in (config.run, *as_list(config.others or []))]
    task, changes = changed_task(load_task(runs[0]), config.env)
    if not task.has_positions:
        raise InputError(f"task '{task.name}' has no positions, so there is nothing to replay")
    agents = _num_agents(config, task)
    policies = _policies(config, runs, task)
    path = Path(config.output or runs[0].path / f"replay.{config.format}").absolute()
    recordings = _record(policies, task, config, agents)
    try:
        if config.format == "mp4":
            from modgnn_rl.visualization.video import write_video

            write_video(path, next(iter(recordings.values())))
        elif config.format == "html":
            facts = {"run": runs[0].path.name, "rollout": f"{agents} agents, {config.steps} steps, seed {config.seed}"}
            facts |= {"checkpoint": config.checkpoint} | {f"env.{key}": value for key, value in changes.items()}
            write_replay(path, recordings, f"{runs[0].path.name}: {next(iter(policies))}", facts)
        else:
            from modgnn_rl.visualization.image import write_image

            write_image(path, recordings, _last_step(config))
    except OSError as error:
        raise InputError(f"cannot write {path} ({error.strerror}); give output=<a file that you can write>") from error
    return path


def _num_agents(config: ReplayConfig, task: Task) -> int:
    if config.num_agents is None and len(task.sizes) > 1:
        raise InputError(f"the run was trained with {task.sizes} agents; choose one size: num_agents={task.sizes[0]}")
    return int(config.num_agents or task.sizes[0])


def _last_step(config: ReplayConfig) -> int:
    """The last step to show: of an image, the one it shows."""
    return config.steps - 1 if config.step is None else config.step


def _policies(config: ReplayConfig, runs: Sequence[RunFolder], task: Task) -> dict[str, TensorDictModuleBase]:
    """The policies by name: that of the first run, the expert, those of the other runs; for a video, the first."""
    policies: dict[str, TensorDictModuleBase] = {}
    for run in runs[:1] if config.format == "mp4" else runs:
        name = str(run.config["model"]["name"])
        if name in policies:
            name = f"{name}, {run.path.name}"
        policies[name] = load_policy(run, device=config.device, which=config.checkpoint)
        if config.with_expert and task.teacher is not None and config.format != "mp4" and len(policies) == 1:
            policies["expert"] = task.reference_policies()["expert"]
    return policies


def _record(
    policies: Mapping[str, TensorDictModuleBase], task: Task, config: ReplayConfig, num_agents: int
) -> dict[str, Recording]:
    """Record a rollout of each policy; the viewer, if wanted, shows the first one live."""
    stride, steps = config.stride or recording_stride(num_agents, config.steps), config.steps
    if config.format == "mp4":
        from modgnn_rl.visualization.video import VIDEO_STRIDE, check_video

        check_video()
        stride = VIDEO_STRIDE
    elif config.format != "html":  # an image shows one step; what follows is not needed
        stride, steps = 1, _last_step(config) + 1
    recordings: dict[str, Recording] = {}
    with contextlib.ExitStack() as stack, Progress("replay", len(policies) * steps) as progress:
        for name, policy in policies.items():
            progress.update(policy=name)
            viewer = None
            if config.viewer and not recordings:
                from modgnn_rl.visualization.viewer import Viewer

                viewer = stack.enter_context(Viewer(task.frequency, config.port))
            recordings[name] = record(
                policy,
                task,
                num_agents=num_agents,
                steps=steps,
                seed=config.seed,
                stride=stride,
                device=config.device,
                progress=progress,
                on_frame=viewer,
            )
    return recordings
