"""Results of jobs, many in one file of JSON lines, shared by the processes that work in one folder."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock

from modgnn_rl.utils.files import write_atomically

__all__ = ["Entry", "ResultStore"]

Entry = dict[str, Any]


class ResultStore:
    """The results of jobs in a folder: one file ``<group>.jsonl`` a group, one line ``{"job": ..., ...}`` a job.

    A file is always replaced as a whole, under a lock, so that a crash leaves the old one and two processes lose
    nothing. A line that cannot be read counts as absent: its job is run again.

    Args:
        folder: where the files lie; created if missing.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def read(self, group: str) -> dict[str, Entry]:
        """The entries of a group by the names of their jobs; a file that has not changed is not parsed again."""
        return dict(self._read(self._file(group)))

    def write(self, group: str, job: str, entry: Mapping[str, Any] | None) -> None:
        """Add or replace the entry of a job, or remove it (None)."""
        file = self._file(group)
        with FileLock(file.with_name(f".{file.name}.lock")):
            entries = self._read(file)
            entries.pop(job, None)
            if entry is not None:
                entries[job] = dict(entry)
            write_atomically(file, "".join(json.dumps({"job": name, **rest}) + "\n" for name, rest in entries.items()))

    def _file(self, group: str) -> Path:
        return self.folder / f"{group}.jsonl"

    def _read(self, file: Path) -> dict[str, Entry]:
        with contextlib.suppress(FileNotFoundError):
            return dict(_entries(file.read_text(encoding="utf-8", errors="replace")))
        return {}


def _entries(text: str) -> Iterator[tuple[str, Entry]]:
    for line in text.splitlines():
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError):
            entry = json.loads(line)
            yield str(entry.pop("job")), entry
