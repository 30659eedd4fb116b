"""Errors that the user can fix, and how they are worded."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["InputError", "NotFinite", "one_line", "suggestion"]


class InputError(ValueError):
    """Bad input: a setting, a checkpoint, a dataset, a state.

    Its message is one sentence that says what was wrong, what was expected and what to do. The commands print that
    sentence alone, without a traceback, and exit with code 2; in Python it is raised like any ``ValueError``.
    """


class NotFinite(InputError):
    """A state, an action, a loss or a gradient became NaN or infinite.

    Its message says which agent and step, what was found, and which setting helps.
    """


def one_line(error: BaseException) -> str:
    """The first line of what an exception says, or its type if it has no message."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the known word most similar to ``word``, or an empty string."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""
