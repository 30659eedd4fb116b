"""The manifest of a dataset of expert episodes: settings, and a description of every file.

One dataset is a folder::

    manifest.json       settings, versions of packages, SHA-256 and size of each file below, and of itself
    shard_00000/        the first num_envs episodes, as tensordict writes a memory-mapped TensorDict
      meta.json
      state.memmap      what the task stores of each agent: float32 [episodes, steps, N, S]; of flocking, position,
                        m, and velocity, m/s
    shard_00001/
      ...
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from modgnn_rl.configs.schema import TaskConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.registry import TASKS
from modgnn_rl.utils.files import write_atomically
from modgnn_rl.utils.folders import describe_files, verify_files

__all__ = [
    "DATASET_VERSION",
    "FILES",
    "LOCK",
    "MANIFEST",
    "STATE",
    "Manifest",
    "check_shard",
    "dataset_env_config",
    "describe_shard",
    "num_bytes",
]

DATASET_VERSION = 3  # 1: the environment's settings were under the key "world"; 2: they did not name the task
MANIFEST = "manifest.json"
STATE = "state.memmap"
LOCK = ".lock"
FILES = ("meta.json", STATE)  # of a shard
PACKAGES = ("modgnn_rl", "torch", "torchrl", "tensordict")

_DERIVED = ("schema_version", "complete", "num_agents")  # in the file for its readers

_MALFORMED = (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError)


@dataclass
class Manifest:
    """Description of a dataset; `read` and `write` keep it in ``manifest.json``.

    Attributes:
        env_config: env config of the episodes.
        width: numbers stored of an agent in a step, S.
        seed: each shard was collected with the seed ``derive_seed(seed, name)``.
        num_envs: episodes in each shard but the last, collected in parallel.
        steps: steps of an episode, T.
        device: device of the simulation.
        episodes: episodes of the complete dataset.
        shards: by name of each finished shard, size and SHA-256 of its files, and versions of packages.
    """

    env_config: TaskConfig
    width: int
    seed: int
    num_envs: int
    steps: int
    device: str
    episodes: int
    shards: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def num_agents(self) -> int:
        """Agents of a flock, N."""
        return int(self.env_config.num_agents)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that determine the content of a shard, by their names on the command line."""
        env_config = {f"env.{name}": value for name, value in dataclasses.asdict(self.env_config).items()}
        del env_config["env.max_steps"]  # these are the steps
        return {**env_config, "seed": self.seed, "num_envs": self.num_envs, "steps": self.steps, "device": self.device}

    def differences(self, settings: Mapping[str, Any]) -> str:
        """The settings that differ, as ``name=value (there value)``, separated by commas; empty if none does."""
        ours = self.settings
        return ", ".join(
            f"{name}={value} (there {ours[name]})" for name, value in settings.items() if value != ours[name]
        )

    @property
    def shapes(self) -> dict[str, tuple[int, int, int, int]]:
        """The shape of the states of each shard of the complete dataset, by its name, in order."""
        starts = range(0, self.episodes, self.num_envs)
        return {
            f"shard_{number:05d}": (min(self.num_envs, self.episodes - start), self.steps, self.num_agents, self.width)
            for number, start in enumerate(starts)
        }

    @property
    def is_complete(self) -> bool:
        """Whether all shards are finished."""
        return all(
            self.shards.get(name, {}).get("files", {}).get(STATE, {}).get("bytes") == num_bytes(shape)
            for name, shape in self.shapes.items()
        )

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read and verify the manifest of a dataset.

        Raises:
            InputError: it is missing, damaged, or of another version.
        """
        file = folder / MANIFEST
        if not file.is_file():
            raise InputError(
                f"{folder} is not a dataset of rollouts ({MANIFEST} is missing); python -m modgnn_rl.collect "
                f"creates one"
            )
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            found = content["schema_version"]
            if found == DATASET_VERSION:
                return cls._from_json(content)
        except _MALFORMED as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"{file} is damaged ({reason}): restore it from a copy or collect it again") from error
        raise InputError(f"{file} has schema version {found}, this program reads {DATASET_VERSION}: collect it again")

    @classmethod
    def _from_json(cls, content: dict[str, Any]) -> Manifest:
        """The manifest in a parsed file, or one of `_MALFORMED`."""
        if content.pop("sha256") != _digest(content):
            raise ValueError("its content has changed since it was written (SHA-256)")
        known = {name: value for name, value in content.items() if name not in _DERIVED}
        # JSON has no infinity; no setting has these strings as values.
        env_config: dict[str, Any]
        env_config = {
            name: float(value) if value in ("inf", "-inf") else value for name, value in known["env_config"].items()
        }
        settings = TASKS[env_config["name"]].option("settings", TaskConfig)
        manifest = cls(**{**known, "env_config": settings(**env_config)})
        check(manifest.env_config, "env_config")
        for name in ("num_envs", "steps", "episodes", "num_agents", "width"):
            if type(count := getattr(manifest, name)) is not int or count < 1:
                raise ValueError(f"{name} is {count}")
        return manifest

    def write(self, folder: Path) -> None:
        """Write the file atomically.

        Raises:
            OSError: the folder cannot be written to.
        """
        derived = {"schema_version": DATASET_VERSION, "complete": self.is_complete, "num_agents": self.num_agents}
        content: dict[str, Any] = derived | {
            entry.name: getattr(self, entry.name) for entry in dataclasses.fields(self)
        }
        content["env_config"] = {
            name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in dataclasses.asdict(self.env_config).items()
        }
        content["shards"] = dict(sorted(self.shards.items()))
        write_atomically(folder / MANIFEST, json.dumps({**content, "sha256": _digest(content)}, indent=2) + "\n")


def num_bytes(shape: tuple[int, ...]) -> int:
    """Size of a file of float32 values."""
    return 4 * math.prod(shape)


def describe_shard(folder: Path) -> dict[str, Any]:
    """The manifest's entry for a shard: its files, and the versions of the packages that wrote it."""
    return {"files": describe_files(folder), "packages": {name: _version(name) for name in PACKAGES}}


def check_shard(folder: Path, entry: Mapping[str, Any], shape: tuple[int, ...], *, verify: bool) -> None:
    """Compare a shard with its entry in the manifest.

    Args:
        folder: the shard.
        entry: what `describe_shard` returned when it was written.
        shape: shape of its states.
        verify: read the files and compare their hashes, too.

    Raises:
        ValueError: what is wrong with which file.
    """
    if set(entry["files"]) != set(FILES) or entry["files"][STATE]["bytes"] != num_bytes(shape):
        raise ValueError(f"{MANIFEST} does not describe states of shape {shape}")
    if not folder.is_dir():
        raise ValueError("it is missing")
    if foreign := sorted(set(os.listdir(folder)) - set(FILES)):
        raise ValueError(f"{foreign[0]} does not belong there")
    verify_files(folder, entry["files"], hashes=verify)


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def dataset_env_config(env_config: TaskConfig, steps: int) -> Any:
    """The env config of a dataset of episodes with a number of steps.

    Raises:
        InputError: states do not determine what agents observe, or there are several numbers of agents.
    """
    if len(env_config.sizes) > 1:
        raise InputError(
            f"env.num_agents={env_config.sizes} names several sizes; a dataset has one: collect one for each"
        )
    if hidden := env_config.not_in_data:
        raise InputError(
            f"a dataset contains states, which do not determine the observations with env.{', env.'.join(hidden)}; "
            "leave it out, or train with trainer=dagger, which collects its own rollouts"
        )
    return dataclasses.replace(env_config, num_agents=env_config.sizes[0], max_steps=steps)
