"""The folder that holds all of one run: configuration, metrics, checkpoints, tables."""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from modgnn_rl.errors import InputError
from modgnn_rl.utils.files import fsync_file, write_atomically

__all__ = ["RUN_VERSION", "RunFolder"]

RUN_VERSION = 2  # 1: settings, metrics and the parts of checkpoints had other names
LOCK_TIMEOUT = 0.5  # seconds; `is_locked` of another process holds the lock for a moment

_HEADER = (
    "# The configuration of this run, all defaults written out. Commands that continue or evaluate the run read it.\n"
)


@dataclass(frozen=True)
class RunFolder:
    """A run folder; see `create` and `open`.

    It holds ``config.yaml``, ``metrics.jsonl``, ``status.json``, ``checkpoints/`` and whatever :meth:`write` adds.

    Attributes:
        path: the folder.
        config: the configuration of the run as plain dicts and lists, without the schema version.
    """

    path: Path
    config: dict[str, Any]

    @classmethod
    def create(cls, root: str | os.PathLike[str], name: str, config_yaml: str) -> RunFolder:
        """Make the folder ``<root>/<YYYY-MM-DD_HH-MM-SS>-<name>``, with a number appended where that exists.

        Args:
            root: where the runs lie; made when missing.
            name: what the run is called: letters, digits and ``_ . + -``.
            config_yaml: the resolved configuration.

        Raises:
            InputError: the name is not a valid folder name, or the root cannot be written; nothing is left behind.
        """
        if not re.fullmatch(r"[A-Za-z0-9][\w.+-]*", name, re.ASCII):
            raise InputError(f"name={name!r} cannot name a folder: use letters, digits and _ . + - only")
        root = Path(root)
        missing: list[Path] = []
        path = None
        try:
            missing = [folder for folder in (root, *root.parents) if not folder.exists()]
            root.mkdir(parents=True, exist_ok=True)
            path = _make_unique(root / f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{name}")
            cls(path, {}).with_config(config_yaml)
        except OSError as error:
            if path is not None:
                shutil.rmtree(path, ignore_errors=True)
            for folder in missing:
                with contextlib.suppress(OSError):
                    folder.rmdir()
            raise _unwritable(root, error) from error
        return cls.open(path)

    @staticmethod
    def check_root(root: str | os.PathLike[str]) -> None:
        """Check that `create` can make folders in a root; nothing is left behind.

        Raises:
            InputError: it could not.
        """
        root = Path(root).absolute()
        there = next(folder for folder in (root, *root.parents) if folder.exists())
        try:
            with tempfile.TemporaryDirectory(dir=there):
                pass
        except OSError as error:
            raise _unwritable(root, error) from error

    @classmethod
    def create_inside(cls, parent: RunFolder, name: str, config_yaml: str) -> RunFolder:
        """Make a folder for one of several policies of a run, inside that run's folder.

        Args:
            parent: the run.
            name: of the folder.
            config_yaml: the policy's own settings.
        """
        path = parent.path / name
        path.mkdir(exist_ok=True)
        return cls(path, {}).with_config(config_yaml)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> RunFolder:
        """Open the folder of an earlier run.

        Raises:
            InputError: the folder does not exist, is not a run folder, or its configuration cannot be read.
        """
        path = Path(path).absolute()
        file = path / "config.yaml"
        if not file.is_file():
            raise InputError(
                f"{path} is not a run folder (config.yaml is missing): give a folder that training created, such as "
                "runs/<date>-<name>"
            )
        return cls(path, _read_config(file))

    def with_config(self, config_yaml: str) -> RunFolder:
        """Write ``config.yaml``, and return the folder as it is then."""
        self.write("config.yaml", f"{_HEADER}schema_version: {RUN_VERSION}\n{config_yaml}")
        return self.open(self.path)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from training in this folder; the lock ends with the process.

        Raises:
            InputError: another process trains in it.
        """
        lock = FileLock(self._lock_file)
        try:
            lock.acquire(timeout=LOCK_TIMEOUT)
        except Timeout:
            raise InputError(
                f"{self.path} is in use by a training run (process {self.status.get('pid', 'unknown')}): wait for it, "
                "stop it, or start another run"
            ) from None
        except OSError as error:
            raise InputError(f"cannot write into {self.path} ({error.strerror}): make the folder writable") from error
        try:
            self._tidy()
            yield
        finally:
            lock.release()

    def _tidy(self) -> None:
        """Remove the incomplete files of a training that was killed."""
        for pattern in (".status.json.*.tmp", ".config.yaml.*.tmp", "videos/.*.tmp.mp4"):
            for leftover in self.path.glob(pattern):
                with contextlib.suppress(OSError):
                    leftover.unlink()

    @property
    def is_locked(self) -> bool:
        """Whether a process is training in this folder; true if that is unknown, for lack of write permission."""
        if not self._lock_file.exists():
            return False
        try:
            FileLock(self._lock_file).acquire(timeout=0).lock.release()
        except (Timeout, OSError):
            return True
        return False

    @property
    def status(self) -> dict[str, Any]:
        """What `note_status` wrote; empty if there is nothing readable."""
        try:
            found = json.loads((self.path / "status.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    @property
    def state(self) -> str:
        """State of the run: ``training``, ``evaluating``, ``finished``, ``stopped``, ``failed``, or ``killed``."""
        state = str(self.status.get("state", "unknown"))
        return "killed" if state in ("training", "evaluating") and not self.is_locked else state

    def note_status(self, state: str, **figures: float | str) -> None:
        """Write the state of the run into ``status.json``.

        Args:
            state: ``training``, ``evaluating``, ``finished``, ``stopped`` (it can be resumed) or ``failed``.
            figures: what else there is to say, such as a ``reason``; what was said before stays, but for that.
        """
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        fresh = {"state": state, "updated": now, "pid": os.getpid(), "host": platform.node()}
        before = {name: value for name, value in self.status.items() if name != "reason"}  # why it ended before
        status = {"started": now, **before, **fresh, **figures}
        self.write("status.json", json.dumps(status, indent=2) + "\n")

    @property
    def _lock_file(self) -> Path:
        return self.path / ".lock"

    @property
    def checkpoints(self) -> Path:
        """The folder for :func:`modgnn_rl.tracking.checkpoint.save_checkpoint`."""
        return self.path / "checkpoints"

    @property
    def best(self) -> Path:
        """The folder for the best policy, a checkpoint of the policy alone."""
        return self.path / "best"

    @property
    def metrics_file(self) -> Path:
        """The file that :meth:`log` appends to."""
        return self.path / "metrics.jsonl"

    def log(self, step: int, metrics: Mapping[str, float]) -> None:
        """Append one line of JSON to ``metrics.jsonl``; it has been written when this returns.

        Args:
            step: what the line is counted by.
            metrics: numbers or tensors of one element; NaN and infinities are written as ``null``, which JSON can hold.
        """
        values = {key: float(value) for key, value in metrics.items()}
        finite = {key: value if math.isfinite(value) else None for key, value in values.items()}
        line = json.dumps({"step": int(step)} | finite, allow_nan=False).encode() + b"\n"
        with self.metrics_file.open("a+b") as file:
            size = file.tell()
            if size > 0:
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":  # a crash cut the last line; do not append to it
                    line = b"\n" + line
            try:
                file.write(line)
                file.flush()
            except OSError:
                file.truncate(size)  # no half lines where the disk is full
                raise

    def sync_metrics(self) -> int:
        """Synchronise ``metrics.jsonl`` to disk and return its size (bytes)."""
        if not self.metrics_file.exists():
            return 0
        fsync_file(self.metrics_file)
        return self.metrics_file.stat().st_size

    def cut_metrics(self, size: int) -> None:
        """Truncate ``metrics.jsonl`` to a size (bytes).

        Raises:
            ValueError: it is shorter than that.
        """
        found = self.metrics_file.stat().st_size if self.metrics_file.exists() else 0
        if found < size:
            raise ValueError(f"metrics.jsonl has {found} bytes instead of {size}")
        if found > size:
            os.truncate(self.metrics_file, size)

    def read_metrics(self) -> list[dict[str, float]]:
        """Return the lines of ``metrics.jsonl``; ``null`` comes back as NaN, an incomplete last line is skipped."""
        records = []
        text = self.metrics_file.read_text(encoding="utf-8", errors="replace") if self.metrics_file.exists() else ""
        for number, line in enumerate(text.splitlines(), start=1):
            try:
                record = json.loads(line)
                records.append({key: math.nan if value is None else value for key, value in record.items()})
            except (ValueError, AttributeError):
                warnings.warn(f"line {number} of {self.metrics_file} is incomplete and left out", stacklevel=2)
        return records

    def write(self, name: str, text: str) -> Path:
        """Write a text file into the folder atomically, and return its path."""
        write_atomically(self.path / name, text)
        return self.path / name


def _unwritable(root: Path, error: OSError) -> InputError:
    return InputError(f"cannot write into {root} ({error.strerror}): choose a folder you can write to")


def _make_unique(path: Path) -> Path:
    """Make a new folder `path`, or `path-2`, `path-3` and so on if it exists."""
    number, candidate = 1, path
    while True:
        try:
            candidate.mkdir()
        except FileExistsError:
            number += 1
            candidate = path.with_name(f"{path.name}-{number}")
        else:
            return candidate


def _read_config(file: Path) -> dict[str, Any]:
    """Parse a stored configuration and check its schema version."""
    try:
        config = OmegaConf.to_container(OmegaConf.create(file.read_text(encoding="utf-8")))
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"{file} cannot be read as YAML ({reason}): restore it from a copy or use another run"
        ) from error
    version = config.pop("schema_version", None) if isinstance(config, dict) else None
    if version != RUN_VERSION or not isinstance(config, dict):
        raise InputError(
            f"{file} has schema_version {version}, this program reads {RUN_VERSION}: use the version that made the run"
        )
    return {str(key): value for key, value in config.items()}
