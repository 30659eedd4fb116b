"""``python -m modgnn_rl.reproduce scale=small``: the paper's evaluation, and the studies beyond it."""

from __future__ import annotations

import json
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import REFERENCE_SIZE, ReproduceConfig
from modgnn_rl.configs.settings import flat
from modgnn_rl.data.manifest import recordable
from modgnn_rl.errors import InputError
from modgnn_rl.utils.files import write_atomically


def main(config: ReproduceConfig) -> int:
    """Reproduce the paper's tables beside its figures, or answer a question beyond them; started again, it goes on.

    Examples::

        python -m modgnn_rl.reproduce scale=smoke
        python -m modgnn_rl.reproduce scale=small
        python -m modgnn_rl.reproduce scale=small study=communication seeds=3
    """
    if config.env.sizes != [REFERENCE_SIZE] or REFERENCE_SIZE not in config.scale.sizes:
        raise InputError(
            f"env.num_agents={config.env.num_agents} and scale.sizes={config.scale.sizes} must be and hold "
            f"{REFERENCE_SIZE}, the number of agents in the paper's training; other sizes are what scale.sizes is for"
        )
    recordable(config.env, config.scale.steps)
    folder = claim_folder(config)
    from modgnn_rl.reproduction.measurements import Measurements
    from modgnn_rl.reproduction.pages import write_study
    from modgnn_rl.reproduction.pipeline import cells_of
    from modgnn_rl.reproduction.studies import study_of
    from modgnn_rl.reproduction.tasks import run_cells
    from modgnn_rl.utils.device import prepare_torch

    prepare_torch(config.device, config.threads)
    study = study_of(config)
    started = datetime.now().astimezone()
    try:
        outcome = run_cells(folder / "cells", cells_of(config, study, folder))
    except KeyboardInterrupt:
        print(
            f"Stopped; what is finished is kept in {folder}, and the same command goes on from there", file=sys.stderr
        )
        raise
    page = write_study(Measurements(outcome, config, study), folder, started)
    print(f"The tables are in {page.with_name('tables.md')}, the report is {page}")
    for line in outcome.failure_lines():
        print(f"failed: {line}", file=sys.stderr)
    if outcome.failures:
        print("The same command tries what failed again, and keeps the rest", file=sys.stderr)
    else:
        print(f"Next: python -m webbrowser {page.as_uri()}")
    return 1 if outcome.failures else 0


def claim_folder(config: ReproduceConfig) -> Path:
    """The folder of a reproduction, which keeps to the settings that it was begun with.

    Raises:
        InputError: it was begun with others, or cannot be written.
    """
    folder = Path(config.folder or f"reproduction/{config.scale.name}").absolute()
    kept: Any = OmegaConf.to_container(OmegaConf.structured(config))
    mine = flat({name: kept[name] for name in ("env", "scale", "seed")})
    file = folder / "settings.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if file.exists():
            theirs = json.loads(file.read_text(encoding="utf-8"))
            if different := [f"{name}={theirs.get(name)}" for name in mine if mine[name] != theirs.get(name)]:
                raise InputError(
                    f"{folder} was begun with {', '.join(different)}: set that again, or give folder=<another>"
                )
        write_atomically(file, json.dumps(mine, indent=2) + "\n")
    except (ValueError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{file} is damaged: delete it, or give folder=<another>") from error
    except OSError as error:
        raise InputError(
            f"cannot write into {folder} ({error.strerror}): give folder=<one you can write to>"
        ) from error
    return folder


if __name__ == "__main__":
    run_command(main, ReproduceConfig, "reproduce")
