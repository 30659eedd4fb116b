"""``python -m modgnn_rl.replay run=<folder>``: show a rollout of a run's policy."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from pathlib import Path

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import ReplayConfig, as_list
from modgnn_rl.errors import InputError
from modgnn_rl.experiment.resume import for_task_of_run
from modgnn_rl.tracking.run_folder import RunFolder

PACKAGES = {"html": (), "mp4": ("av", "matplotlib"), "svg": ("matplotlib",), "png": ("matplotlib",)}
EXTRAS = {"mp4": "video", "svg": "plots", "png": "plots"}


def main(config: ReplayConfig) -> None:
    """Show a rollout of a policy beside the expert's, as a web page, a video or an image.

    Examples::

        python -m modgnn_rl.replay 'run=runs/<date>-<name>'
        python -m modgnn_rl.replay 'run=runs/<date>-<name>' num_agents=64 env.message_loss=0.3
        python -m modgnn_rl.replay 'run=runs/<date>-<name>' format=svg step=400
    """
    check_request(config)
    from modgnn_rl.experiment.replay import replay_run

    path = replay_run(config)
    what = {"html": "replay", "mp4": "video"}.get(config.format, "image")
    print(f"The {what} is in {path}")
    if config.format == "html":
        print(f"Next: python -m webbrowser {path.as_uri()}")
    else:
        print(f"Next, an interactive page: python -m modgnn_rl.replay {shlex.quote(f'run={config.run}')}")


def check_request(config: ReplayConfig) -> None:
    """Check the settings before the heavy imports.

    Raises:
        InputError: not a run folder, settings that contradict each other, or a package that is not installed.
    """
    for folder in (config.run, *as_list(config.others or [])):
        RunFolder.open(folder)
    if config.output is not None:
        if Path(config.output).suffix.lower() != f".{config.format}":
            raise InputError(f"output={config.output} must be a file whose name ends in .{config.format}")
        if not Path(config.output).absolute().parent.is_dir():
            raise InputError(f"output={config.output} is in a folder that does not exist; create the folder first")
    if config.step is not None and config.format not in ("svg", "png"):
        raise InputError(f"step={config.step} is the step of an image; set format=svg or format=png, or leave step out")
    if config.step is not None and config.step >= config.steps:
        raise InputError(f"step={config.step} is beyond the rollout of steps={config.steps}, which are counted from 0")
    if config.format == "mp4" and (config.others or config.viewer):
        raise InputError("a video shows one policy; leave out others and viewer, or use format=html")
    if missing := [name for name in PACKAGES[config.format] if importlib.util.find_spec(name) is None]:
        extra = EXTRAS[config.format]
        raise InputError(
            f"format={config.format} needs {' and '.join(missing)}, not installed: pip install 'modgnn-rl[{extra}]'"
        )
    if config.viewer and importlib.util.find_spec("viser") is None:
        raise InputError("viewer=true needs viser, which is not installed: pip install 'modgnn-rl[viewer]'")


if __name__ == "__main__":
    run_command(main, for_task_of_run(ReplayConfig, sys.argv[1:]), "replay")
