"""Checkpoints that are written atomically, verified when loaded, and cannot execute code.

One checkpoint is a folder::

    step_000000012/
      policy.safetensors      one file for each group of tensors
      optimizer.safetensors
      state.json              everything else, as JSON
      manifest.json           schema version, step, SHA-256 and size of each file above

It is written under another name, synchronised to disk and renamed (`modgnn_rl.utils.folders.write_folder`), so that
after a crash at any moment the previous checkpoint is still the newest one.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import warnings
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.utils.files import fsync_folder
from modgnn_rl.utils.folders import describe_files, verify_files, write_folder

__all__ = ["CHECKPOINT_VERSION", "Checkpoint", "has_checkpoint", "load_checkpoint", "save_checkpoint"]

CHECKPOINT_VERSION = 1

# A checkpoint that is being replaced by another of the same step is named `.old` until the new one is complete.
_NAME = re.compile(r"step_\d{9,}(\.old)?")
_LEFTOVER = re.compile(r"step_\d{9,}(\.old|\.tmp)")
_TENSORS = ".safetensors"
_DAMAGE = (OSError, ValueError, RecursionError, SafetensorError)


@dataclass(frozen=True)
class Checkpoint:
    """A verified checkpoint.

    Attributes:
        path: the folder it was read from.
        step: the step at which it was saved.
        tensors: groups of named tensors, for example ``tensors["policy"]``, a state dict.
        state: the rest, as it comes back from JSON (tuples as lists, keys as strings).
    """

    path: Path
    step: int
    tensors: dict[str, dict[str, Tensor]]
    state: dict[str, Any]


def save_checkpoint(
    folder: str | os.PathLike[str],
    step: int,
    tensors: Mapping[str, Mapping[str, Tensor]],
    state: Mapping[str, Any],
    *,
    keep: int = 2,
) -> Path:
    """Write a checkpoint atomically, then remove the ones no longer needed.

    A checkpoint of the same step is replaced. Checkpoints of later steps are removed: the run was resumed before them.

    Args:
        folder: the folder of a run's checkpoints; created if missing.
        step: name and order of the checkpoint, at least 0.
        tensors: groups of named tensors, one file each; any dtype and device, tensors may share memory.
        state: everything else that a run needs, as JSON values.
        keep: how many checkpoints to keep, this one included.

    Returns:
        The folder of the new checkpoint.

    Raises:
        OSError: the disk is full or not writable; older checkpoints are then untouched.
        TypeError: ``state`` holds something that is not JSON.
    """
    if step < 0 or keep < 1:
        raise InputError(f"step={step} and keep={keep} cannot be: step must be at least 0 and keep at least 1")
    folder = Path(folder)
    path = folder / f"step_{step:09d}"
    if not folder.exists():
        folder.mkdir(parents=True)
        fsync_folder(folder.parent)
    with write_folder(path) as temporary:
        _write_files(temporary, step, tensors, state)
    _prune(folder, path, keep)
    return path


def has_checkpoint(folder: str | os.PathLike[str]) -> bool:
    """Whether a folder contains a checkpoint, damaged or not."""
    return bool(_checkpoints(Path(folder)))


def load_checkpoint(
    folder: str | os.PathLike[str],
    *,
    device: torch.device | str = "cpu",
    groups: Container[str] | None = None,
) -> Checkpoint:
    """Read the newest undamaged checkpoint; a damaged one is skipped with a warning.

    Args:
        folder: the folder of a run's checkpoints.
        device: device of the tensors.
        groups: names of the groups of tensors to verify and read; default: all.

    Raises:
        InputError: there is no checkpoint, or every one is damaged.
    """
    reasons = []
    for path in _checkpoints(Path(folder)):
        try:
            found = _read(path, groups)
        except _DAMAGE as error:
            reasons.append(f"{path.name}: {error}")
            warnings.warn(
                f"CHECKPOINT SKIPPED, it is damaged: {path} ({error}); trying the previous one",
                RuntimeWarning,
                stacklevel=2,
            )
        else:
            moved = {group: {key: t.to(device) for key, t in named.items()} for group, named in found.tensors.items()}
            return replace(found, tensors=moved)
    if reasons:
        raise InputError(
            f"no checkpoint in {folder} can be used ({'; '.join(reasons)}): restore it from a copy or train again"
        )
    raise InputError(
        f"no checkpoint in {folder}: expected folders step_<number>; give a run that has saved one, or train again"
    )


def _write_files(
    folder: Path, step: int, tensors: Mapping[str, Mapping[str, Tensor]], state: Mapping[str, Any]
) -> None:
    """Write the files of a checkpoint into a new folder."""
    for group, named in tensors.items():
        (folder / f"{group}{_TENSORS}").write_bytes(save(_unshared(named)))
    (folder / "state.json").write_text(json.dumps(state), encoding="utf-8")
    manifest = {"schema_version": CHECKPOINT_VERSION, "step": step, "files": describe_files(folder)}
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2), encoding="utf-8")


def _unshared(named: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors on the CPU without shared memory: safetensors refuses tied weights and views of one tensor."""
    result: dict[str, Tensor] = {}
    storages = set()
    for name, tensor in named.items():
        tensor = tensor.detach().cpu().contiguous()
        storage = tensor.untyped_storage().data_ptr()
        result[name] = tensor.clone() if storage in storages else tensor
        storages.add(storage)
    return result


def _checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, newest first; a replaced one comes after its replacement."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if _NAME.fullmatch(path.name)]
    return sorted(found, key=lambda path: (-_step(path), path.name))


def _step(path: Path) -> int:
    """Return the step in the name of a checkpoint."""
    return int(path.name.removeprefix("step_").removesuffix(".old"))


def _read(path: Path, groups: Container[str] | None) -> Checkpoint:
    """Verify and read one checkpoint, or raise one of `_DAMAGE`."""
    listed = _read_manifest(path)
    files = {
        name: entry
        for name, entry in listed.items()
        if groups is None or not name.endswith(_TENSORS) or name.removesuffix(_TENSORS) in groups
    }
    verify_files(path, files)
    if "state.json" not in files:
        raise ValueError("manifest.json does not list state.json")
    tensors = {name.removesuffix(_TENSORS): load_file(path / name) for name in files if name.endswith(_TENSORS)}
    return Checkpoint(path, _step(path), tensors, json.loads((path / "state.json").read_text(encoding="utf-8")))


def _read_manifest(path: Path) -> dict[str, dict[str, Any]]:
    """Return size and SHA-256 of each file of a checkpoint."""
    text = (path / "manifest.json").read_text(encoding="utf-8")
    try:
        manifest = json.loads(text)
        version, step = manifest["schema_version"], manifest["step"]
        files = {name: {key: entry[key] for key in ("bytes", "sha256")} for name, entry in manifest["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError("manifest.json is malformed") from error
    if version != CHECKPOINT_VERSION:
        raise ValueError(f"it has schema version {version}, this program reads {CHECKPOINT_VERSION}")
    if step != _step(path):
        raise ValueError(f"manifest.json is of step {step}")
    return files


def _prune(folder: Path, newest: Path, keep: int) -> None:
    """Remove checkpoints that are no longer needed; errors are ignored."""
    earlier = [path for path in _checkpoints(folder) if _step(path) < _step(newest) and path.suffix != ".old"]
    kept = {newest, *earlier[: keep - 1]}
    for path in folder.iterdir():
        if path not in kept and (_NAME.fullmatch(path.name) or _LEFTOVER.fullmatch(path.name)):
            shutil.rmtree(path, ignore_errors=True)
