"""Reading the files of a run folder that may be damaged, somebody else's, or written to meanwhile.

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

from modgnn_rl.tracking.run_folder import SCHEMA_VERSION

__all__ = [
    "EVALUATED",
    "SHARES",
    "as_dict",
    "as_number",
    "as_time",
    "last_records",
    "read_best",
    "read_config",
    "read_evaluation",
    "written_at",
]

EVALUATED = ("error", "leader_distance", "cohesion", "separation", "reward")
SHARES = ("lost", "diverged")
SPREAD = ("mean", "low", "high")
TAIL = 25  # lines of metrics.jsonl that are read, so that what is not measured in each round is among them
BLOCK = 1 << 16  # bytes

_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # OmegaConf's own needs seconds for fifty runs


def read_config(file: Path) -> dict[str, Any]:
    """Read a stored configuration, or raise a ValueError that says in a few words why that cannot be."""
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
    if version != SCHEMA_VERSION:
        raise ValueError(f"{file.name} has schema_version {version}, this program reads {SCHEMA_VERSION}")
    return {str(key): value for key, value in config.items()}


def last_records(file: Path, count: int = TAIL) -> list[dict[str, Any]]:
    """The last lines of a metrics file, oldest first; a line that is being written, or was cut, is left out."""
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


def read_best(folder: Path, aim: str) -> float | None:
    """The score of the best policy, turned back into the metric: of scores the lowest is the best."""
    for file in sorted(folder.glob("step_*/state.json"), reverse=True):
        try:
            score = as_number(as_dict(json.loads(file.read_text(encoding="utf-8"))).get("score"))
        except (OSError, ValueError):  # a better one takes its place
            continue
        return score if score is None or aim != "reward" else -score
    return None


def read_evaluation(file: Path, row: str) -> dict[str, dict[str, Any]]:
    """One row of the tables in a file of evaluations, by the number of agents and the changes of the world.

    Raises:
        OSError, ValueError, TypeError, KeyError, AttributeError: the file is not as an evaluation writes it.
    """
    tables = json.loads(file.read_text(encoding="utf-8"))
    changes = file.stem.removeprefix("evaluation").removeprefix("-")
    found = {}
    for size, table in tables.items():
        if row in table["rows"]:
            figures = table["rows"][row]
            spreads = {metric: figures[metric] for metric in EVALUATED}  # null in a flock of one
            found[f"{int(size)} agents" + (f", {changes}" if changes else "")] = {
                **{
                    metric: spread and {key: float(spread[key]) for key in SPREAD} for metric, spread in spreads.items()
                },
                **{share: float(figures[share]) for share in SHARES},
                "num_flocks": int(table["num_flocks"]),
                "steps": int(table["steps"]),
            }
    return found


def written_at(file: Path) -> datetime | None:
    """When a file was last written to."""
    try:
        return datetime.fromtimestamp(file.stat().st_mtime).astimezone()
    except OSError:
        return None


def as_dict(value: Any) -> dict[str, Any]:
    """A dict that is one, or an empty one."""
    return value if isinstance(value, dict) else {}


def as_number(value: Any) -> float | None:
    """A number that is one, or nothing."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def as_time(value: Any) -> datetime | None:
    """A point in time as ``status.json`` gives it, or nothing."""
    try:
        return datetime.fromisoformat(value).astimezone()
    except (TypeError, ValueError, OverflowError):
        return None
