"""The exceptions that the user can do something about."""

from __future__ import annotations

__all__ = ["InputError", "NotFinite", "one_line"]


class InputError(ValueError):
    """Bad input: a setting, a checkpoint, a dataset, a state.

    Its message is one sentence that says what was wrong, what was expected and what to do. The commands print that
    sentence alone, without a traceback, and exit with code 2; in Python it is raised like any ``ValueError``.
    """


class NotFinite(InputError):
    """Numbers that have become NaN or infinite while flying or training: a state, an action, a loss, a gradient.

    Its message says whose they are and when, what was found, and which setting helps. No bug, hence an `InputError`.
    """


def one_line(error: BaseException) -> str:
    """The first line of what an exception says, or its kind where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
