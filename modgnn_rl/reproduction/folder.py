"""The output folder of a reproduction, which belongs to the settings that it was started with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from modgnn_rl.configs.schema import ReproduceConfig
from modgnn_rl.configs.settings import flat
from modgnn_rl.errors import InputError
from modgnn_rl.utils.files import write_atomically

__all__ = ["claim_folder"]

FIXED = ("env", "scale", "seed")  # settings that all jobs of a folder share


def claim_folder(config: ReproduceConfig) -> Path:
    """Create or reopen the output folder of a reproduction, and return its absolute path.

    Raises:
        InputError: the folder was started with other settings, is damaged, or cannot be written.
    """
    folder = Path(config.folder or f"reproduction/{config.scale.name}").absolute()
    file = folder / "settings.json"
    given: Any = OmegaConf.to_container(OmegaConf.structured(config))
    settings = flat({name: given[name] for name in FIXED})
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stored = json.loads(file.read_text(encoding="utf-8")) if file.exists() else settings
        if not isinstance(stored, dict):
            raise ValueError
        different = [f"{name}={stored.get(name)}" for name, value in settings.items() if stored.get(name) != value]
        if not different:
            write_atomically(file, json.dumps(settings, indent=2) + "\n")
    except ValueError as error:
        raise InputError(f"{file} is damaged: delete it, or give folder=<another>") from error
    except OSError as error:
        raise InputError(f"cannot write into {folder} ({error.strerror}): give folder=<a writable one>") from error
    if different:
        raise InputError(f"{folder} was started with {', '.join(different)}: use the same, or give folder=<another>")
    return folder
