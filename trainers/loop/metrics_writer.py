"""Metrics of a run, in ``metrics.jsonl`` and in loggers."""

from __future__ import annotations

import shlex
import time
import warnings
from collections.abc import Mapping

from modgnn_rl.errors import InputError
from modgnn_rl.tracking.loggers import LoggerGroup
from modgnn_rl.tracking.run_folder import RunFolder

__all__ = ["MetricsWriter", "report_write_error"]


class MetricsWriter:
    """Writes the metrics of each round to the run folder and to loggers.

    A full disk does not stop training: what could not be written is written after a later round.

    Args:
        run: the run folder.
        loggers: where metrics go in addition.
        unit: what the counts given to `write` are of.
    """

    def __init__(self, run: RunFolder, loggers: LoggerGroup, unit: str) -> None:
        self.run, self.loggers, self.unit = run, loggers, unit
        self._unwritten: list[tuple[int, dict[str, float]]] = []
        self._last_time = time.monotonic()

    def write(self, step: int, metrics: Mapping[str, float], count: int) -> None:
        """Write the metrics of one round; loggers also get its duration (s) and the speed (units per second)."""
        self._unwritten.append((step, dict(metrics)))
        self.flush()
        now = time.monotonic()
        seconds, self._last_time = now - self._last_time, now
        speed = {"time/round": seconds, f"time/{self.unit}_per_second": count / seconds}
        self.loggers.log(step, {**metrics, **speed})

    def flush(self, *, fatal: bool = False) -> None:
        """Write what is missing in ``metrics.jsonl``.

        Raises:
            InputError: it cannot be written and the error is ``fatal``; otherwise there is a warning.
        """
        try:
            while self._unwritten:
                self.run.log(*self._unwritten[0])
                self._unwritten.pop(0)
        except OSError as error:
            report_write_error(self.run, "metrics.jsonl", error, fatal=fatal)


def report_write_error(run: RunFolder, what: str, error: OSError, *, fatal: bool = False) -> None:
    """Warn that something could not be written into a run folder, or raise an `InputError` if that is fatal."""
    reason = f"{what} cannot be written into {run.path} ({error.strerror or error})"
    if fatal:
        raise InputError(
            f"{reason}: free some space, then resume from the last checkpoint with python -m modgnn_rl.train "
            f"{shlex.quote(f'resume={run.path}')}"
        ) from error
    warnings.warn(f"{reason}; training continues, and tries again later", RuntimeWarning, stacklevel=4)
