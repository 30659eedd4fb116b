"""Ctrl-C and SIGTERM: the first lets the current step finish, the second ends the process."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing import parent_process
from types import FrameType

__all__ = ["GracefulInterrupt", "Stopped", "follow_parent"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(KeyboardInterrupt):
    """The work was stopped by a signal, after its current step.

    Attributes:
        code: exit code of the process: 128 + the number of the signal, which is 130 after Ctrl-C and 143 after SIGTERM.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.code = 128 + number


class GracefulInterrupt:
    """Lets long-running work stop between two steps when a signal arrives.

    Example::

        with GracefulInterrupt().listen() as interruption:
            with interruption.deferred():
                for step in range(1000):
                    ...  # is not interrupted
                    interruption.check()  # raises Stopped if a signal has arrived

    Within `deferred` the first signal waits for `check`, and the second ends the process at once, with the same code.
    Elsewhere a signal raises `Stopped` at once. Outside the main thread signals are not handled.
    """

    def __init__(self) -> None:
        self._asked: int | None = None
        self._defers = False
        self._advice = ""

    @contextlib.contextmanager
    def listen(self) -> Iterator[GracefulInterrupt]:
        """Handle the signals, and restore the previous handlers at the end."""
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
        """Defer signals until `check`.

        Args:
            advice: printed when a signal arrives.
        """
        self._defers, self._advice = True, advice
        try:
            yield
        finally:
            self._defers = False

    @property
    def is_requested(self) -> bool:
        """Whether a signal has arrived."""
        return self._asked is not None

    def check(self) -> None:
        """Stop here if a signal has arrived.

        Raises:
            Stopped: a signal has arrived.
        """
        if self._asked is not None:
            raise Stopped(self._asked)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._asked is not None:
            os._exit(128 + number)  # a second signal does not wait for anything, not even for a server
        self._asked = number
        if not self._defers:
            raise Stopped(number)
        if self._advice:
            os.write(2, f"\n{self._advice}\n".encode())  # print may have been interrupted itself, and is not reentrant


def follow_parent() -> None:
    """In a worker process: ignore Ctrl-C, which the parent handles, and end when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent ends, whatever it is doing."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
