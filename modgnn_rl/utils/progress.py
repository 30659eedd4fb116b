"""One progress display for training and evaluation."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from typing import Any, TextIO

from tqdm import tqdm

__all__ = ["Progress"]

_LIVE = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}{postfix} [{rate_fmt}, {remaining} left]"
_PLAIN = "{desc}: {percentage:3.0f}% {n_fmt}/{total_fmt}{postfix} [{rate_fmt}, {elapsed} elapsed, {remaining} left]"


class Progress:
    """A live bar on a terminal, otherwise a plain line every few seconds, and a final line.

    Example::

        with Progress("dagger", total=84 * 4096) as progress:
            for number in range(84):
                ...
                progress.update(4096, round=f"{number + 1}/84", error=error)

    Args:
        description: name of the work, at the start of the line.
        total: number of units of work.
        unit: name of a unit; the rate is in units per second.
        done: units done before, in resumed work.
        every: minimum time between plain lines (s).
        stream: where to write; default: standard error.
        clock: returns the time (s).
    """

    def __init__(
        self,
        description: str,
        total: int,
        *,
        unit: str = "flock-steps",
        done: int = 0,
        every: float = 10.0,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.description, self.total, self.unit = description, total, f" {unit}"
        self.done = self.initial = done
        self.values: dict[str, str] = {}
        self._stream = sys.stderr if stream is None else stream
        self._every, self._clock = every, clock
        self._bar: tqdm[Any] | None = None

    def __enter__(self) -> Progress:
        """Start the clock and show the first bar."""
        self._start = self._last = self._clock()
        if self._stream.isatty():
            self._bar = tqdm(
                desc=self.description,
                total=self.total,
                initial=self.initial,
                unit=self.unit,
                unit_scale=True,
                bar_format=_LIVE,
                dynamic_ncols=True,
                file=self._stream,
            )
        return self

    def __exit__(self, *exception: object) -> None:
        """Write the final line."""
        if self._bar is not None:
            self._bar.close()
        else:
            self._write_line()

    def update(self, n: int = 0, **values: float | str) -> None:
        """Count ``n`` more units as done, and show these values from now on.

        Args:
            n: units done since the last call.
            **values: numbers (shown with three digits) and texts by name; those left out keep their last value. NaN,
                for a value not known yet, is not shown.
        """
        self.done += n
        self.values |= {key: value if isinstance(value, str) else f"{value:.3g}" for key, value in values.items()}
        self.values = {key: text for key, text in self.values.items() if text != "nan"}
        if self._bar is not None:
            self._bar.set_postfix_str(self._postfix(), refresh=False)
            self._bar.update(n)
        elif self._clock() - self._last >= self._every:
            self._write_line()

    def _postfix(self) -> str:
        return ", ".join(f"{key} {value}" for key, value in self.values.items())

    def _write_line(self) -> None:
        self._last = self._clock()
        line = tqdm.format_meter(
            self.done,
            self.total,
            self._last - self._start,
            initial=self.initial,
            prefix=self.description,
            unit=self.unit,
            unit_scale=True,
            postfix=self._postfix(),
            bar_format=_PLAIN,
        )
        with contextlib.suppress(OSError):  # a full disk or a closed pipe must not end the work
            print(line, file=self._stream, flush=True)
