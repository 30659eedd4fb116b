"""Large experiments as jobs whose results are kept, so that the same command resumes where it stopped.

A job is finished when its result is stored. Files that it produced may be deleted: it runs again only if a pending job
depends on it. A job that fails does not stop the others and is tried again next time. Processes that work in one folder
share its jobs: a job is run by the process that holds its lock.
"""

from __future__ import annotations

import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from modgnn_rl.errors import one_line
from modgnn_rl.reproduction.store import ResultStore
from modgnn_rl.utils.files import write_atomically
from modgnn_rl.utils.text import format_duration

__all__ = ["Job", "JobResults", "Result", "run_jobs"]

Result = dict[str, Any]
POLL = 1.0  # seconds between two checks of what other processes have finished
MIN_SHARE = 0.03  # fraction of the total cost from which on the remaining time is estimated


def _always(result: Result) -> bool:
    return True


@dataclass(frozen=True)
class Job:
    """One piece of work.

    Attributes:
        name: unique: letters, digits and ``_ . + - =``.
        run: does the work, given the results of the jobs that it depends on, by name; returns a JSON object.
        cost: duration relative to other jobs, for the estimate of the time left.
        depends_on: names of jobs that must finish before.
        is_valid: given the stored result, whether the files that the job produced for others still exist.
        group: name of the file that its result is stored in.
    """

    name: str
    run: Callable[[Mapping[str, Result]], Result]
    cost: float = 1.0
    depends_on: Sequence[str] = ()
    is_valid: Callable[[Result], bool] = _always
    group: str = "results"


@dataclass
class JobResults:
    """Results of a list of jobs.

    Attributes:
        results: of the finished jobs, by name.
        seconds: duration of each.
        failures: reason of each failure, in one line.
        blocked: failures whose only reason is a failed dependency.
    """

    results: dict[str, Result] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    blocked: set[str] = field(default_factory=set)

    def failure_lines(self) -> list[str]:
        """What failed and why, and how many jobs could not run because of that."""
        lines = [f"{name}: {reason}" for name, reason in self.failures.items() if name not in self.blocked]
        return [*lines, f"{len(self.blocked)} others depend on failed jobs"] if self.blocked else lines


def run_jobs(folder: Path, jobs: Sequence[Job]) -> JobResults:
    """Run the jobs that are not finished yet, and report on stderr how much is left.

    Args:
        folder: holds the results, ``<group>.jsonl`` (see `modgnn_rl.reproduction.store.ResultStore`), and tracebacks of
            failed jobs, ``<name>.failed.txt``.
        jobs: in the order in which they should run; dependencies are among them.

    Raises:
        KeyboardInterrupt: the work was interrupted; finished jobs are kept.
    """
    return _Runner(folder, jobs).run()


class _Runner:
    """Runs jobs in one folder; see `run_jobs`."""

    def __init__(self, folder: Path, jobs: Sequence[Job]) -> None:
        self.folder, self.jobs = folder, {job.name: job for job in jobs}
        self.store = ResultStore(folder)
        self.outcome = JobResults()

    def run(self) -> JobResults:
        """Run what is pending, again and again until nothing is left."""
        pending = self._pending()
        clock = _Clock(list(self.jobs.values()), pending)
        while pending:
            settled = [job for job in list(pending) if self._settle(job, clock)]
            pending = [job for job in pending if job not in settled]
            if pending and not settled:
                time.sleep(POLL)
        return self.outcome

    def _settle(self, job: Job, clock: _Clock) -> bool:
        """Run a job, or mark it as blocked; false if it must wait for a dependency or another process."""
        failed = next((name for name in job.depends_on if name in self.outcome.failures), None)
        if failed is not None:
            self.outcome.failures[job.name] = f"it depends on {failed}, which failed"
            self.outcome.blocked.add(job.name)
        elif not all(name in self.outcome.results for name in job.depends_on) or not self._attempt(job, clock):
            return False
        clock.count(job)
        return True

    def _pending(self) -> list[Job]:
        """The unfinished jobs that no other job depends on, and what they need; results of finished jobs are loaded."""
        stored = {group: self.store.read(group) for group in {job.group for job in self.jobs.values()}}
        needed = {name for job in self.jobs.values() for name in job.depends_on}
        left: set[str] = set()
        targets = [job for name, job in self.jobs.items() if name not in needed]
        while targets:
            job = targets.pop()
            if job.name not in left and not self._load(job, stored[job.group]):
                left.add(job.name)
                targets += [self.jobs[name] for name in job.depends_on]
        for name, job in self.jobs.items():
            if name not in left:
                self._load(job, stored[job.group], check_files=False)
        return [job for name, job in self.jobs.items() if name in left]

    def _attempt(self, job: Job, clock: _Clock) -> bool:
        """Run a job unless it is finished; false if another process is running it."""
        lock = FileLock(self.folder / f".{job.name}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return False
        try:
            if self._load(job, self.store.read(job.group)):
                return True
            self.store.write(job.group, job.name, None)  # the files that the result refers to are gone
            print(f"{clock}: {job.name}", file=sys.stderr, flush=True)
            with _timed(self.folder / f".{job.name}.seconds") as watch:
                result = job.run({name: self.outcome.results[name] for name in job.depends_on})
            self.store.write(job.group, job.name, {"seconds": watch.seconds, "result": result})
            self._failure_file(job).unlink(missing_ok=True)
            self._load(job, self.store.read(job.group))
        except Exception as error:  # must not stop the other jobs
            self.outcome.failures[job.name] = one_line(error)
            print(f"{job.name} failed: {one_line(error)}", file=sys.stderr, flush=True)
            with contextlib.suppress(OSError):
                write_atomically(self._failure_file(job), traceback.format_exc())
        finally:
            lock.release()
        return True

    def _failure_file(self, job: Job) -> Path:
        return self.folder / f"{job.name}.failed.txt"

    def _load(self, job: Job, stored: Mapping[str, Any], *, check_files: bool = True) -> bool:
        """Take the stored result of a job; false if there is none, it cannot be read, or its files are gone."""
        try:
            entry = stored[job.name]
            result, seconds = dict(entry["result"]), float(entry["seconds"])
            if check_files and not job.is_valid(result):
                return False
        except (ValueError, TypeError, KeyError):
            return False
        self.outcome.results[job.name], self.outcome.seconds[job.name] = result, seconds
        return True


@dataclass
class _Watch:
    seconds: float


@contextlib.contextmanager
def _timed(file: Path) -> Iterator[_Watch]:
    """Measure the duration of a job, including the time before an interruption, which is kept in a file."""
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


class _Clock:
    """Progress of the jobs, and an estimate of the time left at the pace so far."""

    def __init__(self, jobs: Sequence[Job], pending: Sequence[Job]) -> None:
        self.total, self.left = len(jobs), sum(job.cost for job in pending)
        self.number, self.cost = len(jobs) - len(pending), 0.0
        self.begun = time.monotonic()

    def count(self, job: Job) -> None:
        """Count a job as finished."""
        self.number, self.cost, self.left = self.number + 1, self.cost + job.cost, self.left - job.cost

    def __str__(self) -> str:
        elapsed = time.monotonic() - self.begun
        known = self.cost > MIN_SHARE * (self.cost + self.left)
        left = f", about {format_duration(elapsed * self.left / self.cost)} left" if known else ""
        return f"[{self.number + 1}/{self.total}{left}]"
