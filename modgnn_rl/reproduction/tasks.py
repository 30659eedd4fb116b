"""Large experiments in cells: pieces of work whose results are kept, so that the same command goes on where it ended.

A cell is done when its file is there. What others need of it may be gone: it is made again where one of them is left to
do. One that fails does not stop the others, and is tried again next time. Processes that work in one folder share its
cells: whoever holds a cell's lock does it.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from modgnn_rl.errors import one_line
from modgnn_rl.utils.files import write_atomically
from modgnn_rl.utils.text import format_duration

__all__ = ["Cell", "Outcome", "run_cells"]

Result = dict[str, Any]
WAIT = 1.0  # s between two looks at what other processes do
TELLING = 0.03  # share of the work from which on the pace so far tells something


def _always(result: Result) -> bool:
    return True


@dataclass(frozen=True)
class Cell:
    """One piece of work.

    Attributes:
        name: of its file: letters, digits and ``_ . + - =``.
        work: does it, given the results of the cells that it needs, by name; what it returns can be written as JSON.
        cost: how long it takes in comparison with others, for the time left.
        needs: names of cells that must be done before.
        is_there: given its result, whether what it made beside that, and others need, is still there.
    """

    name: str
    work: Callable[[Mapping[str, Result]], Result]
    cost: float = 1.0
    needs: Sequence[str] = ()
    is_there: Callable[[Result], bool] = _always


@dataclass
class Outcome:
    """What came of the cells.

    Attributes:
        results: of those that are done, by name.
        seconds: how long each took.
        failures: of the others the reason, in one line.
    """

    results: dict[str, Result] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    waiting: set[str] = field(default_factory=set)
    """Those of the failures that only lack a cell that failed."""

    def failure_lines(self) -> list[str]:
        """What failed and why, and how many cells could not be done because of that."""
        lines = [f"{name}: {reason}" for name, reason in self.failures.items() if name not in self.waiting]
        return [*lines, f"{len(self.waiting)} others need what failed"] if self.waiting else lines


def run_cells(folder: Path, cells: Sequence[Cell]) -> Outcome:
    """Do what is not done yet, and say on stderr how much is left.

    Args:
        folder: where results are kept, ``<name>.json``, and tracebacks of failures, ``<name>.failed.txt``.
        cells: in the order in which they should be done; none needs one that is not among them.

    Raises:
        KeyboardInterrupt: the work was interrupted; what is done is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    outcome = Outcome()
    pending = _pending(outcome, folder, cells)
    clock = _Clock(cells, pending)
    while pending:
        moved = False
        for cell in list(pending):
            if lost := next((name for name in cell.needs if name in outcome.failures), None):
                outcome.failures[cell.name] = f"it needs {lost}, which failed"
                outcome.waiting.add(cell.name)
            elif not all(name in outcome.results for name in cell.needs) or not _attempt(outcome, folder, cell, clock):
                continue
            moved = True
            pending.remove(cell)
            clock.note(cell)
        if pending and not moved:
            time.sleep(WAIT)
    return outcome


def _pending(outcome: Outcome, folder: Path, cells: Sequence[Cell]) -> list[Cell]:
    """What nobody needs and is not done, and what that needs and is not there; of the others the results are taken."""
    by_name = {cell.name: cell for cell in cells}
    needed = {name for cell in cells for name in cell.needs}
    left: set[str] = set()
    asked_for = [cell for cell in cells if cell.name not in needed]
    while asked_for:
        cell = asked_for.pop()
        if cell.name not in left and not _take(outcome, folder, cell):
            left.add(cell.name)
            asked_for += [by_name[name] for name in cell.needs]
    for cell in cells:
        if cell.name not in left:
            _take(outcome, folder, cell, even_if_gone=True)
    return [cell for cell in cells if cell.name in left]


def _attempt(outcome: Outcome, folder: Path, cell: Cell, clock: _Clock) -> bool:
    """Do a cell unless it is done; false where another process is at it."""
    lock = FileLock(folder / f".{cell.name}.lock")
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return False
    try:
        if _take(outcome, folder, cell):
            return True
        (folder / f"{cell.name}.json").unlink(missing_ok=True)  # what it tells of is gone
        print(f"{clock}: {cell.name}", file=sys.stderr, flush=True)
        with _timed(folder / f".{cell.name}.seconds") as watch:
            result = cell.work({name: outcome.results[name] for name in cell.needs})
        _keep(folder, cell, {"seconds": watch.seconds, "result": result})
        _take(outcome, folder, cell)
    except Exception as error:  # whatever it is, it must not stop the others
        outcome.failures[cell.name] = one_line(error)
        print(f"{cell.name} failed: {one_line(error)}", file=sys.stderr, flush=True)
        with contextlib.suppress(OSError):
            write_atomically(folder / f"{cell.name}.failed.txt", traceback.format_exc())
    finally:
        lock.release()
    return True


@dataclass
class _Watch:
    seconds: float


@contextlib.contextmanager
def _timed(file: Path) -> Iterator[_Watch]:
    """Times work, together with what was spent on it before it was stopped, which the file tells."""
    watch, begun = _Watch(0.0), time.monotonic()
    with contextlib.suppress(OSError, ValueError):
        watch.seconds = float(file.read_text(encoding="utf-8"))
    try:
        yield watch
    except KeyboardInterrupt:
        write_atomically(file, f"{watch.seconds + time.monotonic() - begun:.1f}\n")
        raise
    watch.seconds += time.monotonic() - begun
    file.unlink(missing_ok=True)


def _keep(folder: Path, cell: Cell, entry: Mapping[str, Any]) -> None:
    write_atomically(folder / f"{cell.name}.json", json.dumps(entry) + "\n")
    (folder / f"{cell.name}.failed.txt").unlink(missing_ok=True)


def _take(outcome: Outcome, folder: Path, cell: Cell, *, even_if_gone: bool = False) -> bool:
    """Read the result of a cell that is done and there; one whose file is damaged is not."""
    try:
        entry = json.loads((folder / f"{cell.name}.json").read_text(encoding="utf-8"))
        result, seconds = dict(entry["result"]), float(entry["seconds"])
        if not even_if_gone and not cell.is_there(result):
            return False
    except (OSError, ValueError, TypeError, KeyError):
        return False
    outcome.results[cell.name], outcome.seconds[cell.name] = result, seconds
    return True


class _Clock:
    """How far the work is, and how long the rest will take at the pace so far."""

    def __init__(self, cells: Sequence[Cell], pending: Sequence[Cell]) -> None:
        self.total, self.left = len(cells), sum(cell.cost for cell in pending)
        self.number, self.cost = len(cells) - len(pending), 0.0
        self.begun = time.monotonic()

    def note(self, cell: Cell) -> None:
        """Count a cell as done."""
        self.number, self.cost, self.left = self.number + 1, self.cost + cell.cost, self.left - cell.cost

    def __str__(self) -> str:
        passed = time.monotonic() - self.begun
        known = self.cost > TELLING * (self.cost + self.left)
        left = f", about {format_duration(passed * self.left / self.cost)} left" if known else ""
        return f"[{self.number + 1}/{self.total}{left}]"
