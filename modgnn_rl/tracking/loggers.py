"""The loggers of a run besides the plain ``metrics.jsonl``; a failing logger does not stop training."""

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
from modgnn_rl.tracking.backends import Backend, CsvBackend, TensorboardBackend, WandbBackend
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.internals import wandb_process
from modgnn_rl.utils.provenance import made_with

__all__ = ["LoggerGroup", "check_logger", "make_logger"]

LOGGER_TIMEOUT = 13.0  # seconds; a logger that takes longer for a call is turned off


class LoggerGroup:
    """Several loggers. One that raises, or does not answer in time, is turned off with one warning.

    No method raises, and the other loggers continue.

    Args:
        builders: functions that create the loggers, by name.
        timeout: longest time for a call (seconds); default: `LOGGER_TIMEOUT`.
    """

    def __init__(self, builders: Mapping[str, Callable[[], Backend]], *, timeout: float | None = None) -> None:
        self.timeout = LOGGER_TIMEOUT if timeout is None else timeout
        self._backends: dict[str, Backend] = {}
        for name, build in builders.items():
            made = self._guard(name, build)
            if made is not None:
                self._backends[name] = made

    def __len__(self) -> int:
        """Number of active loggers."""
        return len(self._backends)

    @property
    def shows_videos(self) -> bool:
        """Whether an active logger shows videos."""
        return any(backend.shows_videos for backend in self._backends.values())

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log numbers or tensors of one element at a step."""
        self._each(lambda backend: backend.log(step, metrics))

    def log_histogram(self, step: int, name: str, values: torch.Tensor) -> None:
        """Log a histogram of the finite values of a tensor."""
        finite = values.detach()[values.isfinite()].float().cpu().numpy()
        if finite.size:
            self._each(lambda backend: backend.log_histogram(step, name, finite))

    def log_video(self, step: int, name: str, path: Path) -> None:
        """Log a video, an mp4 file."""
        self._each(lambda backend: backend.log_video(step, name, path))

    def log_table(self, name: str, columns: Sequence[str], rows: Sequence[Sequence[str | float]]) -> None:
        """Log a table; a later one of the same name replaces it."""
        self._each(lambda backend: backend.log_table(name, columns, rows))

    def log_references(self, step: int, references: Mapping[str, Mapping[str, float]]) -> None:
        """Draw horizontal lines up to this step into charts: for each metric, the value of each line by its name."""
        self._each(lambda backend: backend.log_references(step, references))

    def close(self) -> list[str]:
        """Close all loggers; returns one line for each active one that says where its files are."""
        lines = self._each(lambda backend: backend.close())
        self._backends.clear()
        return lines

    def _each(self, action: Callable[[Backend], Any]) -> list[Any]:
        """Results of an action for each active logger that did not fail."""
        on = list(self._backends.items())
        results = [self._guard(name, functools.partial(action, backend)) for name, backend in on]
        return [result for result in results if result is not None]

    def _guard(self, name: str, action: Callable[[], Any]) -> Any:
        """Return the action's result, or turn this logger off."""
        try:
            return _within(self.timeout, action)
        except Exception as error:  # a logger must not stop training
            self._backends.pop(name, None)
            if name == "wandb":
                _stop_wandb()
            warnings.warn(
                f"logger={name} failed and is now off ({one_line(error)}); metrics.jsonl is still written",
                RuntimeWarning,
                stacklevel=5,
            )
            return None


def check_logger(config: TrainConfig) -> None:
    """Check the loggers of a run before anything is created.

    Raises:
        InputError: a logger is named twice, or together with none, or needs a package that is not installed.
    """
    names = as_list(config.logger)
    if len(set(names)) != len(names) or ("none" in names and len(names) > 1):
        raise InputError(f"logger=[{','.join(names)}] must name each logger once, and none only on its own")
    if "tensorboard" in names and importlib.util.find_spec("tensorboard") is None:
        raise InputError("logger=tensorboard needs a package that is not installed: pip install tensorboard")


def make_logger(config: TrainConfig, run: RunFolder) -> LoggerGroup:
    """Create the loggers of a run, with their files inside the run folder.

    They show all settings and versions from the start.

    Raises:
        InputError: as `check_logger`.
    """
    check_logger(config)
    names = [name for name in as_list(config.logger) if name != "none"]
    about = made_with() if names else {}
    builders: dict[str, Callable[[], Backend]] = {
        "csv": lambda: CsvBackend(run, about),
        "tensorboard": lambda: TensorboardBackend(run, about),
        "wandb": lambda: WandbBackend(run, about, config.wandb),
    }
    return LoggerGroup({name: builders[name] for name in names})


def _within(seconds: float, action: Callable[[], Any]) -> Any:
    """Run an action in a thread and return its result, or re-raise its exception.

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
    """End the helper process of Weights & Biases, even if it hangs, so that nothing waits for it at exit."""
    with contextlib.suppress(Exception):
        import wandb

        helper = wandb_process()
        try:
            _within(1.0, wandb.teardown)
        finally:
            if helper is not None:
                helper.kill()
                helper.wait(1.0)
