"""The one exception for input that the user can mend."""

from __future__ import annotations

__all__ = ["InputError"]


class InputError(ValueError):
    """Bad input: a setting, a checkpoint, a dataset, a state.

    Its message is one sentence that says what was wrong, what was expected and what to do. The commands print that
    sentence alone, without a traceback, and exit with code 2; in Python it is raised like any ``ValueError``.
    """
