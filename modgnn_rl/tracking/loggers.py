"""The dashboards of a run besides the plain ``metrics.jsonl``; a failing dashboard does not stop training."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from modgnn_rl.configs.schema import TrainConfig, as_list
from modgnn_rl.errors import InputError, one_line
from modgnn_rl.tracking.backends import CsvFiles, Dashboard, Tensorboard, Wandb
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.provenance import made_with

__all__ = ["LoggerGroup", "check_logger", "make_logger"]

PATIENCE = 13.0  # s; a dashboard that takes longer over anything is turned off


class LoggerGroup:
    """Dashboards, each turned off with a warning by its first exception or its first long wait.

    None of the methods raises, and the other dashboards continue.

    Args:
        builders: makes each dashboard, by the name that warnings call it.
        patience: longest wait for anything, s; default: `PATIENCE`.
    """

    def __init__(self, builders: Mapping[str, Callable[[], Dashboard]], *, patience: float | None = None) -> None:
        self.patience = PATIENCE if patience is None else patience
        self._dashboards: dict[str, Dashboard] = {}
        for name, build in builders.items():
            made = self._guard(name, build)
            if made is not None:
                self._dashboards[name] = made

    def __len__(self) -> int:
        """How many are on."""
        return len(self._dashboards)

    @property
    def shows_videos(self) -> bool:
        """Whether any dashboard that is on shows videos."""
        return any(dashboard.shows_videos for dashboard in self._dashboards.values())

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log numbers or tensors of one element at a step."""
        self._each(lambda dashboard: dashboard.log(step, metrics))

    def log_histogram(self, step: int, name: str, values: torch.Tensor) -> None:
        """Log how the finite numbers of a tensor are distributed."""
        finite = values.detach()[values.isfinite()].float().cpu().numpy()
        if finite.size:
            self._each(lambda dashboard: dashboard.log_histogram(step, name, finite))

    def log_video(self, step: int, name: str, path: Path) -> None:
        """Log a video, an mp4 file."""
        self._each(lambda dashboard: dashboard.log_video(step, name, path))

    def log_table(self, name: str, columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
        """Show a table; later ones of that name replace it."""
        self._each(lambda dashboard: dashboard.log_table(name, columns, rows))

    def log_references(self, step: int, references: Mapping[str, Mapping[str, float]]) -> None:
        """Draw horizontal lines up to this step into charts: for each metric, the value of each line by its name."""
        self._each(lambda dashboard: dashboard.log_references(step, references))

    def close(self) -> list[str]:
        """Finish all; for each that was still on, one line for the user that says where it lies."""
        lines = self._each(lambda dashboard: dashboard.close())
        self._dashboards.clear()
        return lines

    def _each(self, action: Callable[[Dashboard], Any]) -> list[Any]:
        """What the action returns for each dashboard that it does not turn off."""
        on = list(self._dashboards.items())
        results = [self._guard(name, functools.partial(action, dashboard)) for name, dashboard in on]
        return [result for result in results if result is not None]

    def _guard(self, name: str, action: Callable[[], Any]) -> Any:
        """Return the action's result, or turn this dashboard off."""
        try:
            return _within(self.patience, action)
        except Exception as error:  # whatever a dashboard does, training goes on
            self._dashboards.pop(name, None)
            if name == "wandb":
                _stop_wandb()
            warnings.warn(
                f"logger={name} failed and is now off ({one_line(error)}); metrics.jsonl continues",
                RuntimeWarning,
                stacklevel=5,
            )
            return None


def check_logger(config: TrainConfig) -> None:
    """Check that the dashboards of a run can be made, before anything is created.

    Raises:
        InputError: one is named twice, or another beside none, or one needs a package that is not installed.
    """
    names = as_list(config.logger)
    if len(set(names)) != len(names) or ("none" in names and len(names) > 1):
        raise InputError(f"logger=[{','.join(names)}] must name each dashboard once, and none only by itself")
    if "tensorboard" in names and importlib.util.find_spec("tensorboard") is None:
        raise InputError("logger=tensorboard needs a package that is not installed: pip install tensorboard")


def make_logger(config: TrainConfig, run: RunFolder) -> LoggerGroup:
    """Make the dashboards that a run asks for, with their files inside the run folder.

    They show all settings and what the run was made with from the start on.

    Raises:
        InputError: as `check_logger`.
    """
    check_logger(config)
    names = [name for name in as_list(config.logger) if name != "none"]
    about = made_with() if names else {}
    builders: dict[str, Callable[[], Dashboard]] = {
        "csv": lambda: CsvFiles(run, about),
        "tensorboard": lambda: Tensorboard(run, about),
        "wandb": lambda: Wandb(run, about, config.wandb),
    }
    return LoggerGroup({name: builders[name] for name in names})


def _within(seconds: float, action: Callable[[], Any]) -> Any:
    """What an action returns or raises, unless it takes longer; then it is left alone.

    Raises:
        TimeoutError: it took longer.
    """
    outcome: list[tuple[Any, BaseException | None]] = []

    def act() -> None:
        try:
            outcome.append((action(), None))
        except BaseException as error:  # raised again below
            outcome.append((None, error))

    thread = threading.Thread(target=act, daemon=True)
    thread.start()
    thread.join(seconds)
    if not outcome:
        raise TimeoutError(f"no answer within {seconds:g} s")
    result, error = outcome[0]
    if error is not None:
        raise error
    return result


def _stop_wandb() -> None:
    """End the helper process of Weights & Biases, be it dead or hanging, so that nothing waits for it at exit."""
    with contextlib.suppress(Exception):
        import wandb
        from wandb.sdk import wandb_setup

        helper = wandb_setup.singleton().assert_service()._proc
        try:
            _within(1.0, wandb.teardown)
        finally:
            if helper is not None:
                helper._process.kill()
                helper._process.wait(1.0)
