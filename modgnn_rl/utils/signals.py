"""Ctrl-C and SIGTERM: the first lets a step of the work end, the second does not."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType

__all__ = ["GracefulInterrupt", "Stopped"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(KeyboardInterrupt):
    """The work was stopped from outside, in good order.

    Attributes:
        code: what the process should end with: 128 + the number of the signal, 130 after Ctrl-C, 143 after SIGTERM.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.code = 128 + number


class GracefulInterrupt:
    """Turns signals into a question that long work asks itself now and then.

    Example::

        with GracefulInterrupt().listen() as interruption:
            with interruption.deferred():
                for step in range(1000):
                    ...  # is not torn apart
                    interruption.check()  # raises Stopped when there was a signal

    Within `deferred` the first signal waits for `check`, and the second ends the process at once, with the same code.
    Elsewhere a signal raises `Stopped` where it comes. In other threads than the main one nothing is listened to.
    """

    def __init__(self) -> None:
        self._asked: int | None = None
        self._defers = False
        self._advice = ""

    @contextlib.contextmanager
    def listen(self) -> Iterator[GracefulInterrupt]:
        """Take over the signals; they are given back at the end."""
        if threading.current_thread() is not threading.main_thread():
            yield self
            return
        before = {number: signal.signal(number, self._handle) for number in SIGNALS}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextlib.contextmanager
    def deferred(self, advice: str = "") -> Iterator[None]:
        """Let signals wait for `check`.

        Args:
            advice: what is printed when one comes.
        """
        self._defers, self._advice = True, advice
        try:
            yield
        finally:
            self._defers = False

    @property
    def is_asked_for(self) -> bool:
        """Whether a signal has come."""
        return self._asked is not None

    def check(self) -> None:
        """Stop here if a signal has come.

        Raises:
            Stopped: one has.
        """
        if self._asked is not None:
            raise Stopped(self._asked)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._asked is not None:
            os._exit(128 + number)  # whoever asks twice waits for nothing, not even for a server's answer
        self._asked = number
        if not self._defers:
            raise Stopped(number)
        if self._advice:
            os.write(2, f"\n{self._advice}\n".encode())  # print is not safe here: it may have been interrupted itself
