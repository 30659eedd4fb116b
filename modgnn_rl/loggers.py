"""Dashboards beside the plain ``metrics.jsonl``: TorchRL's loggers behind a guard that lets training go on."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shlex
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from modgnn_rl.configs.schema import LoggerConfig
from modgnn_rl.errors import InputError
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.settings import check

__all__ = ["GuardedLogger", "check_logger", "make_logger"]


class GuardedLogger:
    """A logger whose first exception turns it off with one warning; it never raises.

    Args:
        name: what the warning calls it.
        build: makes the logger of ``torchrl.record``, or returns None where nothing is to be logged.
    """

    def __init__(self, name: str, build: Callable[[], Any]) -> None:
        self.name = name
        self._logger: Any = None
        self._logger = self._guard(build)

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Log numbers or tensors of one element at a step."""
        if self._logger is not None:
            self._guard(lambda: self._logger.log_metrics(dict(metrics), step=step))

    def close(self) -> str | None:
        """Finish the log and return one line for the user that says where it lies, or None where it was off."""
        if self._logger is None:
            return None
        line: str | None = self._guard(lambda: _whereabouts(self.name, self._logger))
        if line is not None:
            self._guard(self._logger.close)
        self._logger = None
        return line

    def _guard(self, action: Callable[[], Any]) -> Any:
        """Return the action's result, or turn this logger off."""
        try:
            return action()
        except Exception as error:  # whatever a dashboard does, training goes on
            self._logger = None
            if self.name == "wandb":
                _stop_wandb()
            warnings.warn(
                f"logger={self.name} failed and is now off ({_one_line(error)}); metrics.jsonl goes on",
                RuntimeWarning,
                stacklevel=3,
            )
            return None


def check_logger(config: LoggerConfig) -> None:
    """Check that a logger can be made, before anything is created.

    Raises:
        InputError: a setting is out of range, or the logger needs a package that is not installed.
    """
    check(config, "logger")
    if config.name == "tensorboard" and importlib.util.find_spec("tensorboard") is None:
        raise InputError("logger=tensorboard needs a package that is not installed: pip install tensorboard")


def make_logger(config: LoggerConfig, run: RunFolder) -> GuardedLogger:
    """Make the logger that a run asks for, with its files inside the run folder.

    It asks for no key, waits on no terminal, and gives up on a server after ``config.init_timeout``.

    Raises:
        InputError: as :func:`check_logger`.
    """
    check_logger(config)
    builders: dict[str, Callable[[], Any]] = {
        "none": lambda: None,
        "csv": lambda: _make_csv(run),
        "tensorboard": lambda: _make_tensorboard(run),
        "wandb": lambda: _make_wandb(config, run),
    }
    return GuardedLogger(config.name, builders[config.name])


def _make_csv(run: RunFolder) -> Any:
    from torchrl.record import CSVLogger

    return CSVLogger(exp_name="csv", log_dir=str(run.path))


def _make_tensorboard(run: RunFolder) -> Any:
    from torchrl.record import TensorboardLogger

    return TensorboardLogger(exp_name="tensorboard", log_dir=str(run.path))


def _make_wandb(config: LoggerConfig, run: RunFolder) -> Any:
    """Start Weights & Biases as asked for; online falls back to offline."""
    if config.mode != "online":
        return _start_wandb(config, run, config.mode)
    try:
        return _start_wandb(config, run, "online")
    except Exception as error:  # no key, no network, no such project: all mean offline
        warnings.warn(
            f"Weights & Biases cannot be reached ({_one_line(error)}); this run is logged offline",
            RuntimeWarning,
            stacklevel=2,
        )
        return _start_wandb(config, run, "offline")


def _start_wandb(config: LoggerConfig, run: RunFolder, mode: str) -> Any:
    """Start a Weights & Biases run in exactly this mode."""
    # Its error reports, on unless refused, hold back the exit for 20 s where the server does not answer.
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    # It keeps a log of its own in the home folder otherwise, and floods the terminal where that is read-only.
    os.environ.setdefault("WANDB_CACHE_DIR", str(run.path / "wandb" / "cache"))
    import wandb
    from torchrl.record import WandbLogger

    wandb.setup(wandb.Settings(silent=True))
    # Asked before init, which would prompt on a terminal where there is no key.
    if mode == "online" and not wandb.login(prompt=False, verify=False):
        raise RuntimeError("no API key; `wandb login` stores one")
    settings = wandb.Settings(
        console="off",
        init_timeout=config.init_timeout,
        finish_timeout=config.init_timeout,
        x_save_requirements=False,  # the list of all installed packages is nobody's business
    )
    # The mode goes to wandb.init: TorchRL's own `offline=True` would set WANDB_MODE for the whole process.
    return WandbLogger(
        exp_name=run.path.name,
        save_dir=str(run.path),
        project=config.project,
        log_env_packages=False,
        mode=mode,
        reinit="create_new",
        config=run.config,
        settings=settings,
    )


def _stop_wandb() -> None:
    """Drop the helper process of Weights & Biases, which may be dead, so that nothing fails again at exit."""
    with contextlib.suppress(Exception):
        import wandb

        wandb.teardown()


def _whereabouts(name: str, logger: Any) -> str:
    """Return the line that tells the user where a log lies."""
    if name != "wandb":
        return f"{name}: {logger.experiment.log_dir}"
    settings = logger.experiment.settings
    if settings.mode == "disabled":
        return "wandb: disabled, nothing was kept"
    if settings.mode == "online":
        return f"wandb: {logger.experiment.url}"
    return f"wandb: offline run in {settings.sync_dir}; to send it: wandb sync {shlex.quote(settings.sync_dir)}"


def _one_line(error: Exception) -> str:
    """Return the first line of an exception."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
