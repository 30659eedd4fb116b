"""The manifest of a dataset of rollouts: what was flown, and what every file of it must be.

One dataset is a folder::

    manifest.json       settings, versions of packages, SHA-256 and size of each file below, and of itself
    shard_00000/        the first num_envs episodes, as tensordict writes a memory-mapped TensorDict
      meta.json
      state.memmap      positions, m, and velocities, m/s: float32 [episodes, steps, N, 6]
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

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.errors import InputError
from modgnn_rl.utils.files import sha256, write_atomically

__all__ = [
    "FILES",
    "MANIFEST",
    "SCHEMA_VERSION",
    "STATE",
    "Manifest",
    "check_shard",
    "describe_files",
    "num_bytes",
    "recordable",
]

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
STATE = "state.memmap"
FILES = ("meta.json", STATE)  # of a shard
PACKAGES = ("modgnn_rl", "torch", "torchrl", "tensordict")
# Faults that are seen only through adjacency, observation and mask, which a dataset does not hold.
UNSEEN = ("message_loss", "delay", "range_spread", "position_noise", "velocity_noise", "dropout_rate")

_DERIVED = ("schema_version", "complete", "num_agents")  # in the file for those who read it

_MALFORMED = (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError)


@dataclass
class Manifest:
    """What a dataset is made of; `read` and `write` keep it in ``manifest.json``.

    Attributes:
        env_config: the world of the rollouts, all settings resolved.
        seed: each shard was flown with the seed ``derive_seed(seed, name)``.
        num_envs: episodes in each shard but the last, flown at once.
        steps: steps of an episode, T.
        device: where they were flown.
        episodes: episodes of the complete dataset.
        shards: for each shard that is there, by name, the SHA-256 and the size of its files, and what wrote them.
    """

    env_config: FlockingConfig
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
        """All that decides what is in a shard, by the names of the command line."""
        env_config = {f"env.{name}": value for name, value in dataclasses.asdict(self.env_config).items()}
        del env_config["env.max_steps"]  # these are the steps
        return {**env_config, "seed": self.seed, "num_envs": self.num_envs, "steps": self.steps, "device": self.device}

    def differences(self, settings: Mapping[str, Any]) -> str:
        """Which of these settings are others here, as ``name=value (there value)`` with commas between; or nothing."""
        ours = self.settings
        return ", ".join(
            f"{name}={value} (there {ours[name]})" for name, value in settings.items() if value != ours[name]
        )

    @property
    def shapes(self) -> dict[str, tuple[int, int, int, int]]:
        """The shape of the states of each shard of the complete dataset, by its name, in order."""
        starts = range(0, self.episodes, self.num_envs)
        return {
            f"shard_{number:05d}": (min(self.num_envs, self.episodes - start), self.steps, self.num_agents, 6)
            for number, start in enumerate(starts)
        }

    @property
    def is_complete(self) -> bool:
        """Whether all shards are there."""
        return all(
            self.shards.get(name, {}).get("files", {}).get(STATE, {}).get("bytes") == num_bytes(shape)
            for name, shape in self.shapes.items()
        )

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Read and verify the manifest of a dataset.

        Raises:
            InputError: there is none, it was written by another version, or it is damaged.
        """
        file = folder / MANIFEST
        if not file.is_file():
            raise InputError(
                f"{folder} is no dataset of rollouts, it has no {MANIFEST}; python -m modgnn_rl.collect makes one"
            )
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            found = content["schema_version"]
            if found == SCHEMA_VERSION:
                return cls._from_json(content)
        except _MALFORMED as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"{file} is damaged ({reason}): restore it from a copy or collect anew") from error
        raise InputError(f"{file} has schema version {found}, this program reads {SCHEMA_VERSION}: collect anew")

    @classmethod
    def _from_json(cls, content: dict[str, Any]) -> Manifest:
        """The manifest in a parsed file, or one of `_MALFORMED`."""
        if content.pop("sha256") != _digest(content):
            raise ValueError("it has changed since it was written, says its SHA-256")
        known = {name: value for name, value in content.items() if name not in _DERIVED}
        # JSON has no infinity; FlockingConfig has no setting that may be called so.
        env_config: dict[str, Any]
        env_config = {
            name: float(value) if value in ("inf", "-inf") else value for name, value in known["env_config"].items()
        }
        manifest = cls(**{**known, "env_config": FlockingConfig(**env_config)})
        check(manifest.env_config, "env_config")
        for name in ("num_envs", "steps", "episodes", "num_agents"):
            if type(count := getattr(manifest, name)) is not int or count < 1:
                raise ValueError(f"{name} is {count}")
        return manifest

    def write(self, folder: Path) -> None:
        """Write it whole or not at all.

        Raises:
            OSError: the folder cannot be written to.
        """
        derived = {"schema_version": SCHEMA_VERSION, "complete": self.is_complete, "num_agents": self.num_agents}
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


def describe_files(folder: Path) -> dict[str, Any]:
    """What the manifest says of a shard that lies in ``folder``."""
    files = {name: {"sha256": sha256(folder / name), "bytes": (folder / name).stat().st_size} for name in FILES}
    return {"files": files, "packages": {name: _version(name) for name in PACKAGES}}


def check_shard(folder: Path, entry: Mapping[str, Any], shape: tuple[int, ...], *, verify: bool) -> None:
    """Hold a shard against its entry in the manifest.

    Args:
        folder: the shard.
        entry: what `describe_files` said when it was written.
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
    for name, expected in entry["files"].items():
        file = folder / name
        if not file.is_file():
            raise ValueError(f"{name} is missing")
        if (size := file.stat().st_size) != expected["bytes"]:
            raise ValueError(f"{name} has {size} bytes instead of {expected['bytes']}")
        if verify and sha256(file) != expected["sha256"]:
            raise ValueError(f"{name} has changed since it was written, says its SHA-256")


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def recordable(env_config: FlockingConfig, steps: int) -> FlockingConfig:
    """The world of a dataset of rollouts of so many steps.

    Raises:
        InputError: a flock cannot be known from positions and velocities in this world.
    """
    if len(env_config.sizes) > 1:
        raise InputError(
            f"env.num_agents={env_config.sizes} are several sizes; a dataset has one, collect one for each"
        )
    hidden = [f"env.{name}={getattr(env_config, name)}" for name in UNSEEN if getattr(env_config, name)]
    if env_config.graph != "matrix":
        hidden.append(f"env.graph={env_config.graph}")
    if hidden:
        raise InputError(
            f"a dataset holds positions and velocities, which do not tell what agents see with {', '.join(hidden)}; "
            "leave it out, or train with trainer=dagger, which collects its own rollouts"
        )
    return dataclasses.replace(env_config, num_agents=env_config.sizes[0], max_steps=steps)
