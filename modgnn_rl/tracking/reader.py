"""Read the files of a run folder that may be damaged, owned by someone else, or being written to.

Nothing is written, and torch is not imported.
"""

from __future__ import annotations

import json
import math
import os
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from modgnn_rl.metrics import higher_is_better
from modgnn_rl.registry import METRICS
from modgnn_rl.tracking.run_folder import RUN_VERSION

__all__ = [
    "as_dict",
    "as_number",
    "as_time",
    "last_records",
    "read_best",
    "read_config",
    "read_evaluation",
    "written_at",
]

TAIL = 25  # lines of metrics.jsonl to read, enough to include metrics that are not logged in every round
BLOCK = 1 << 16  # bytes

_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # OmegaConf's own loader takes seconds for fifty runs


def read_config(file: Path) -> dict[str, Any]:
    """Read a stored configuration; raise a ValueError that says in a few words why that is impossible."""
    try:
        config = yaml.load(file.read_text(encoding="utf-8"), _Loader)
    except FileNotFoundError as error:
        raise ValueError(f"no {file.name}") from error
    except OSError as error:
        raise ValueError(f"{file.name} cannot be read ({error.strerror})") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"{file.name} is damaged") from error
    version = config.pop("schema_version", None) if isinstance(config, dict) else None
    if version is None:
        raise ValueError(f"{file.name} is not the configuration of a run")
    if version != RUN_VERSION:
        raise ValueError(f"{file.name} has schema_version {version}, this program reads {RUN_VERSION}")
    return {str(key): value for key, value in config.items()}


def last_records(file: Path, count: int = TAIL) -> list[dict[str, Any]]:
    """Records of the last lines of a metrics file, oldest first, without lines that are incomplete."""
    try:
        with file.open("rb") as stream:
            size, length = stream.seek(0, os.SEEK_END), BLOCK
            while True:
                start = max(0, size - length)
                stream.seek(start)
                lines = stream.read(size - start).split(b"\n")
                if start == 0 or len(lines) > count + 1:
                    break
                length *= 4
    except OSError:
        return []
    records = []
    for line in lines[-count - 1 :]:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict):
            records.append(record)
    return records[-count:]


def read_best(folder: Path, objective: str) -> float | None:
    """The objective of the best policy, from its score, which is the metric with a sign such that lower is better."""
    for file in sorted(folder.glob("step_*/state.json"), reverse=True):
        try:
            score = as_number(as_dict(json.loads(file.read_text(encoding="utf-8"))).get("score"))
        except (OSError, ValueError):  # a better one is just replacing it
            continue
        return -score if score is not None and higher_is_better(objective) else score
    return None


def read_evaluation(file: Path, policy: str) -> dict[str, dict[str, Any]]:
    """One policy's row of each table that an evaluation has written to a file.

    Returns:
        for each table, named by its number of agents and the changes to the environment, as in ``32 agents, wind=1``:
        ``num_flocks``, ``steps``, and by name of the metric its mean over the episodes with, unless it is a fraction,
        the ends of the confidence interval ``low`` and ``high``; None if the metric does not apply.

    Raises:
        OSError, ValueError, TypeError, KeyError, AttributeError: an evaluation did not write the file.
    """
    tables = json.loads(file.read_text(encoding="utf-8"))
    changes = file.stem.removeprefix("evaluation").removeprefix("-")
    found: dict[str, dict[str, Any]] = {}
    for size, table in tables.items():
        if policy in table["rows"]:
            row = {metric: _interval(table["rows"][policy].get(metric)) for metric in METRICS}
            counts = {key: int(table[key]) for key in ("num_flocks", "steps")}
            found[f"{int(size)} agents" + (f", {changes}" if changes else "")] = {**row, **counts}
    return found


def _interval(entry: dict[str, Any] | None) -> dict[str, float] | None:
    """Mean and ends of the confidence interval of an entry of a table."""
    if entry is None:
        return None
    return {key: float(entry[key]) for key in ("mean", "low", "high") if key == "mean" or key in entry}


def written_at(file: Path) -> datetime | None:
    """When a file was last written to; None if there is no such file."""
    try:
        return datetime.fromtimestamp(file.stat().st_mtime).astimezone()
    except OSError:
        return None


def as_dict(value: Any) -> dict[str, Any]:
    """The value if it is a dict, else an empty one."""
    return value if isinstance(value, dict) else {}


def as_number(value: Any) -> float | None:
    """The value as a float if it is a finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def as_time(value: Any) -> datetime | None:
    """The time that an entry of ``status.json`` gives, or None."""
    try:
        return datetime.fromisoformat(value).astimezone()
    except (TypeError, ValueError, OverflowError):
        return None
