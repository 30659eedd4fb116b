"""Checkpoints that are whole or absent, verified when loaded, and unable to run code.

One checkpoint is a folder::

    step_000000012/
      policy.safetensors      one file for each group of tensors
      optimizer.safetensors
      state.json              everything else, as JSON
      manifest.json           schema version, step, SHA-256 and size of each file above

It is written under another name, synchronised to the disk and renamed, so that a crash at any moment leaves the
previous checkpoint as the newest one.
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
from modgnn_rl.utils.files import fsync_file, fsync_folder, sha256

__all__ = ["SCHEMA_VERSION", "Checkpoint", "has_checkpoint", "load_checkpoint", "save_checkpoint"]

SCHEMA_VERSION = 1

# A checkpoint that is being replaced by another of the same step is called `.old` until the new one stands.
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
    """Write one checkpoint whole or not at all, then remove the ones no longer needed.

    A checkpoint of the same step is replaced. Those of later steps are removed: the run has gone back before them.

    Args:
        folder: where the checkpoints of a run lie; made when missing.
        step: what the checkpoint is named and sorted by, at least 0.
        tensors: groups of named tensors, one file each; any dtype and device, tensors may share memory.
        state: what else a run needs, limited to what JSON holds.
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
    temporary = path.with_name(path.name + ".tmp")
    if not folder.exists():
        folder.mkdir(parents=True)
        fsync_folder(folder.parent)
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        temporary.mkdir()
        _write_files(temporary, step, tensors, state)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    if path.exists():
        old = path.with_name(path.name + ".old")
        shutil.rmtree(old, ignore_errors=True)
        os.replace(path, old)
    os.replace(temporary, path)
    fsync_folder(folder)
    _prune(folder, path, keep)
    return path


def has_checkpoint(folder: str | os.PathLike[str]) -> bool:
    """Whether there is a checkpoint in a folder, whole or not."""
    return bool(_checkpoints(Path(folder)))


def load_checkpoint(
    folder: str | os.PathLike[str],
    *,
    device: torch.device | str = "cpu",
    groups: Container[str] | None = None,
) -> Checkpoint:
    """Read the newest checkpoint that is whole; a damaged one is passed over with a warning.

    Args:
        folder: where the checkpoints of a run lie.
        device: where to put the tensors.
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
                f"CHECKPOINT PASSED OVER, it is damaged: {path} ({error}); trying the one before it",
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
    """Fill a new folder with the files of a checkpoint and bring them to the disk."""
    for group, named in tensors.items():
        (folder / f"{group}{_TENSORS}").write_bytes(save(_apart(named)))
    (folder / "state.json").write_text(json.dumps(state), encoding="utf-8")
    files = {p.name: {"sha256": sha256(p), "bytes": p.stat().st_size} for p in sorted(folder.iterdir())}
    manifest = {"schema_version": SCHEMA_VERSION, "step": step, "files": files}
    (folder / "manifest.json").write_text(json.dumps(manifest, indent=2), encoding="utf-8")
    for file in folder.iterdir():
        fsync_file(file)
    fsync_folder(folder)


def _apart(named: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors on the CPU, of which no two share memory: safetensors refuses tied weights and views of one tensor."""
    apart: dict[str, Tensor] = {}
    storages = set()
    for name, tensor in named.items():
        tensor = tensor.detach().cpu().contiguous()
        storage = tensor.untyped_storage().data_ptr()
        apart[name] = tensor.clone() if storage in storages else tensor
        storages.add(storage)
    return apart


def _checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, newest first, the replaced after the one that replaces it."""
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
    for name, (size, digest) in files.items():
        file = path / name
        if file.parent != path:
            raise ValueError(f"manifest.json names {name!r}, a file outside the checkpoint")
        if file.stat().st_size != size:
            raise ValueError(f"{name} has {file.stat().st_size} bytes instead of {size}")
        if sha256(file) != digest:
            raise ValueError(f"the content of {name} has changed since it was written (SHA-256)")
    if "state.json" not in files:
        raise ValueError("manifest.json does not list state.json")
    tensors = {name.removesuffix(_TENSORS): load_file(path / name) for name in files if name.endswith(_TENSORS)}
    return Checkpoint(path, _step(path), tensors, json.loads((path / "state.json").read_text(encoding="utf-8")))


def _read_manifest(path: Path) -> dict[str, tuple[int, str]]:
    """Return size and SHA-256 of each file that belongs to a checkpoint."""
    text = (path / "manifest.json").read_text(encoding="utf-8")
    try:
        manifest = json.loads(text)
        version, step = manifest["schema_version"], manifest["step"]
        files = {name: (entry["bytes"], entry["sha256"]) for name, entry in manifest["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError("manifest.json is malformed") from error
    if version != SCHEMA_VERSION:
        raise ValueError(f"it has schema version {version}, this program reads {SCHEMA_VERSION}")
    if step != _step(path):
        raise ValueError(f"manifest.json speaks of step {step}")
    return files


def _prune(folder: Path, newest: Path, keep: int) -> None:
    """Remove what is no longer needed, now that `newest` is safe; what cannot be removed stays."""
    earlier = [path for path in _checkpoints(folder) if _step(path) < _step(newest) and path.suffix != ".old"]
    kept = {newest, *earlier[: keep - 1]}
    for path in folder.iterdir():
        if path not in kept and (_NAME.fullmatch(path.name) or _LEFTOVER.fullmatch(path.name)):
            shutil.rmtree(path, ignore_errors=True)
