"""Collect expert episodes into a dataset, shard by shard; re-running resumes an unfinished dataset."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase, InitTracker, TransformedEnv

from modgnn_rl.configs.schema import CollectConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.data.manifest import LOCK, Manifest, check_shard, dataset_env_config, describe_shard, num_bytes
from modgnn_rl.errors import InputError
from modgnn_rl.task import Task, make_task
from modgnn_rl.utils.device import prepare_torch
from modgnn_rl.utils.folders import write_folder
from modgnn_rl.utils.progress import Progress
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["collect_dataset", "describe_dataset", "rollout_expert"]

MARGIN = 2**24  # bytes to leave free on the disk
LEFTOVER = re.compile(r"shard_\d{5,}\.(tmp|old)|\.manifest\.json\.\d+\.tmp")  # of a process that was killed


def collect_dataset(config: CollectConfig) -> Path:
    """Roll out the expert and write a dataset, or its missing shards; see `modgnn_rl.data.manifest` for the files.

    Each shard has its own seed and is written atomically: after an interruption, the same settings lead to the same
    dataset, bit for bit on the same machine.

    Returns:
        the folder.

    Raises:
        InputError: a bad setting, a folder that cannot be written to or holds other things, or too little space.
    """
    check(config)
    prepare_torch(config.device, config.threads)
    env_config = dataset_env_config(config.env, config.steps or config.env.max_steps)
    task = make_task(env_config)
    if task.teacher is None:
        raise InputError(f"task '{task.name}' has no expert, whose rollouts could be collected")
    wanted = Manifest(
        env_config=env_config,
        width=task.stored_width(env_config.num_agents),
        seed=config.seed,
        num_envs=config.num_envs,
        steps=config.steps or config.env.max_steps,
        device=config.device,
        episodes=config.episodes,
    )
    folder = Path(config.output or f"datasets/{wanted.num_agents}-agents")
    try:
        wanted.shards = _kept_shards(folder, wanted)
        missing = {name: shape for name, shape in wanted.shapes.items() if name not in wanted.shards}
        _check_space(folder, sum(map(num_bytes, missing.values())))
        if missing:
            _collect_shards(folder, task, wanted, missing)
    except OSError as error:
        raise InputError(
            f"cannot write into {folder} ({error.strerror}): give output=<a folder that you can write to>"
        ) from error
    return folder


def _kept_shards(folder: Path, wanted: Manifest) -> dict[str, dict[str, Any]]:
    """The entries of the shards that the folder holds already, whole.

    Raises:
        InputError: the folder holds other things, or a dataset of other settings or more episodes.
    """
    if not folder.exists() or all(name == LOCK or LEFTOVER.fullmatch(name) for name in os.listdir(folder)):
        return {}
    found = Manifest.read(folder)
    if different := found.differences(wanted.settings):
        raise InputError(f"{folder} holds rollouts with other settings: {different}; give output=<another folder>")
    if found.episodes > wanted.episodes:
        raise InputError(
            f"{folder} is for {found.episodes} episodes, more than episodes={wanted.episodes}; give at least as many, "
            "or output=<another folder>"
        )
    kept = {}
    for name in found.shards.keys() & wanted.shapes.keys():
        # A shorter last shard is collected again if more episodes are requested.
        if found.shapes[name] == wanted.shapes[name]:
            try:
                check_shard(folder / name, found.shards[name], wanted.shapes[name], verify=True)
                kept[name] = found.shards[name]
            except ValueError as error:
                print(f"{folder / name} is damaged ({error}) and is collected again", file=sys.stderr)
    return kept


def _check_space(folder: Path, size: int) -> None:
    """Refuse to start if the disk is too small.

    Raises:
        InputError: with the space needed and the space free.
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(there).free
    if size and free < size + MARGIN:
        raise InputError(
            f"the dataset takes {size / 1e6:,.0f} MB and the disk of {folder} has {free / 1e6:,.0f} MB free; free "
            "some space, lower episodes or steps, or give output=<folder on another disk>"
        )


def _collect_shards(
    folder: Path, task: Task, manifest: Manifest, missing: dict[str, tuple[int, int, int, int]]
) -> None:
    """Collect the missing shards (shapes by name), and add each to the manifest once it is on disk."""
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder), Progress("collect", sum(shape[0] * shape[1] for shape in missing.values())) as progress:
        for name in filter(LEFTOVER.fullmatch, os.listdir(folder)):
            path = folder / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        manifest.write(folder)
        env = None
        try:
            for name, (episodes, steps, agents, _) in missing.items():
                if env is None or env.batch_size[0] != episodes:
                    env = task.evaluation_env(episodes, agents, 0, manifest.device, steps=steps)
                env.set_seed(derive_seed(manifest.seed, name))
                states = rollout_expert(task, env, steps, progress)
                _check_space(folder, num_bytes(states.shape))
                _write_shard(folder / name, states)
                manifest.shards[name] = describe_shard(folder / name)
                manifest.write(folder)
                progress.update(shards=f"{len(manifest.shards)}/{len(manifest.shapes)}")
        except KeyboardInterrupt:
            print(
                f"Stopped; {folder} has {len(manifest.shards)} of {len(manifest.shapes)} shards; re-running the "
                "same command resumes there",
                file=sys.stderr,
            )
            raise


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing into a dataset; the lock ends with the process.

    Raises:
        InputError: another process is writing it.
    """
    try:
        guard = FileLock(folder / LOCK).acquire(timeout=0)
    except Timeout as error:
        raise InputError(f"another process is writing into {folder}; wait for it or stop it") from error
    with guard:
        yield


@torch.no_grad()
def rollout_expert(task: Task, env: EnvBase, steps: int, progress: Progress | None = None) -> Tensor:
    """Roll out the expert from new initial states; where the task ends an episode early, the next one begins.

    Args:
        task: says what is stored of a state.
        env: B environments of N agents; their generators determine the episodes.
        steps: steps T.
        progress: counts flock-steps.

    Returns:
        what `Task.stored` keeps of the state before each step, on the CPU [B, T, N, S].
    """
    expert, states = task.reference_policies()["expert"], []
    tracked = TransformedEnv(env, InitTracker())
    tensordict = tracked.reset()
    for step in range(steps):
        tensordict = expert(tensordict)
        states.append(task.stored(tensordict).cpu())
        if step < steps - 1:
            _, tensordict = tracked.step_and_maybe_reset(tensordict)
        if progress is not None:
            progress.update(len(states[0]))
    return torch.stack(states, 1)


def _write_shard(path: Path, states: Tensor) -> None:
    """Write states [E, T, N, S] as a memory-mapped TensorDict, atomically."""
    with write_folder(path) as temporary:
        TensorDict({"state": states}, states.shape[:2]).memmap(temporary)


def describe_dataset(folder: Path) -> str:
    """Location and size of a dataset, and the command that trains on it."""
    manifest = Manifest.read(folder)
    size = sum(map(num_bytes, manifest.shapes.values()))
    kind, usual = type(manifest.env_config), CollectConfig().env.name
    default = {f"env.{name}": value for name, value in vars(kind()).items() if name not in kind.irrelevant_to_data}
    changed = [
        f"{name}={_as_override(manifest.settings[name])}"
        for name in default
        if name != "env.name" and manifest.settings[name] != default[name]
    ]
    if manifest.env_config.name != usual:
        changed.insert(0, f"env={manifest.env_config.name}")
    command = shlex.join(["python", "-m", "modgnn_rl.train", "trainer=bc", f"trainer.dataset={folder}", *changed])
    return (
        f"{manifest.episodes} rollouts of {manifest.steps} steps with {manifest.num_agents} agents are in {folder} "
        f"({size / 1e6:,.1f} MB)\nNext: {command}"
    )


def _as_override(value: Any) -> str:
    """A value as the command line writes it."""
    return value if isinstance(value, str) else "inf" if value == math.inf else json.dumps(value)
