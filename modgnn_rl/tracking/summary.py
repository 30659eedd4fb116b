"""The state and metrics of a run from the plain files of its folder, read without torch and without writing anything.

For `modgnn_rl.runs`. The folder may belong to someone else, be written to meanwhile, or be damaged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from modgnn_rl.configs.schema import as_list
from modgnn_rl.registry import TRAINERS
from modgnn_rl.tracking.reader import (
    as_dict,
    as_number,
    as_time,
    last_records,
    read_best,
    read_config,
    read_evaluation,
    written_at,
)
from modgnn_rl.tracking.run_folder import RunFolder

__all__ = ["RunSummary", "find_runs", "summarise_run", "training_metrics"]

RECENT = 5  # values that are averaged
DEPTH = 3  # levels of folders, for sweeps and groups of runs


@dataclass(frozen=True)
class RunSummary:
    """Summary of a run, or of one of several policies that a run trains side by side.

    Attributes:
        name: name of the folder, relative to the folder that was searched.
        path: the folder.
        run: folder of the run; differs from ``path`` for one of several policies.
        problem: what could not be read; empty if nothing.
        config: the settings; empty if they cannot be read.
        state: see `modgnn_rl.tracking.run_folder.RunFolder.state`; ``unreadable`` without settings.
        reason: why the run ended early.
        started, updated: when it began, and when it last wrote.
        seconds: training time so far, s; of a run that has ended, until its last checkpoint.
        round, rounds: number of the last round, and the planned number of rounds if that is a setting.
        share: fraction of the training that is done, 0 to 1; of a run that has ended, in its last checkpoint.
        speed, unit: units of work per second, and the unit.
        last: last value of each of `training_metrics`, averaged over the sizes trained on.
        recent: mean of its last 5 values.
        objective: the metric in which the best policy is the best.
        best: its value for the best policy, a mean over 5 rounds.
        evaluations: the policy's rows in the evaluation tables, see `modgnn_rl.tracking.reader.read_evaluation`.
        policies: each of several policies.
    """

    name: str
    path: Path
    run: Path
    problem: str = ""
    config: dict[str, Any] = field(default_factory=dict)
    state: str = "unreadable"
    reason: str = ""
    started: datetime | None = None
    updated: datetime | None = None
    seconds: float | None = None
    round: int | None = None
    rounds: int | None = None
    share: float | None = None
    speed: float | None = None
    unit: str = "updates"
    last: dict[str, float] = field(default_factory=dict)
    recent: dict[str, float] = field(default_factory=dict)
    objective: str = ""
    best: float | None = None
    evaluations: dict[str, dict[str, Any]] = field(default_factory=dict)
    policies: tuple[RunSummary, ...] = ()

    @property
    def task(self) -> str:
        """Name of the task; empty if the configuration does not say."""
        return str(as_dict(self.config.get("env")).get("name", ""))

    @property
    def sizes(self) -> list[Any]:
        """The numbers of agents in training."""
        return as_list(as_dict(self.config.get("env")).get("num_agents"))


def training_metrics() -> tuple[str, ...]:
    """Names of the metrics that measure training progress: the trainers' objectives, and the loss."""
    known = filter(None, map(TRAINERS.peek, TRAINERS))  # an installed package is not imported for this
    return tuple(dict.fromkeys([*filter(None, (entry.options.get("objective") for entry in known)), "loss"]))


def find_runs(root: Path, depth: int = DEPTH) -> list[Path]:
    """The run folders in a folder, including damaged ones, or the folder itself if it is one.

    Args:
        root: where to look.
        depth: how many levels of folders to search.
    """
    try:
        if any((root / name).is_file() for name in ("config.yaml", "status.json", "metrics.jsonl")):
            return [root]
        folders = sorted(path for path in root.iterdir() if path.is_dir()) if depth > 0 else []
    except OSError:  # no permission
        return []
    return [run for folder in folders for run in find_runs(folder, depth - 1)]


def summarise_run(path: Path, name: str | None = None) -> RunSummary:
    """Summarise a run; what cannot be read is left out and named in ``problem``.

    Args:
        path: the run folder.
        name: its name in lists; default: the name of the folder.
    """
    name = name or path.absolute().name
    try:
        config = read_config(path / "config.yaml")
    except ValueError as error:
        return RunSummary(name, path, path, problem=str(error))
    run = RunFolder(path, config)
    records = last_records(run.metrics_file)
    trainer = str(as_dict(config.get("trainer")).get("name"))
    objective = TRAINERS[trainer].options.get("objective", "") if trainer in TRAINERS else ""
    summary = RunSummary(name, path, path, config=config, objective=objective, **_standing(run, records))
    policies = _policies(records[-1]) if records else []
    return dataclasses.replace(
        _with_metrics(summary, records),
        policies=tuple(_summarise_policy(summary, policy, records) for policy in policies),
    )


def _standing(run: RunFolder, records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The attributes of a summary that tell how far the run is."""
    status, trainer = run.status, as_dict(run.config.get("trainer"))
    state, updated = run.state, as_time(status.get("updated"))
    done, total, seconds = (as_number(status.get(key)) for key in ("done", "total", "seconds"))
    speed = done / seconds if done and seconds else None
    step = as_number(records[-1].get("step")) if records else None
    rounds = as_number(trainer.get("rounds"))
    shares = [(done, total)]
    if state == "training":  # status.json knows the last checkpoint, metrics.jsonl the last round
        shares.append((step, rounds))
        written = written_at(run.metrics_file)
        if updated and written and written > updated:
            seconds = (seconds or 0) + (written - updated).total_seconds()
            updated = written
    parts = [part / whole for part, whole in shares if part is not None and whole]
    return {
        "state": state,
        "reason": str(status.get("reason", ""))
        if state in ("stopped", "failed")
        else "",  # status.json keeps an old one
        "started": as_time(status.get("started")),
        "updated": updated,
        "seconds": seconds,
        "round": None if step is None else int(step),
        "rounds": None if rounds is None else int(rounds),
        "share": min(1.0, max(parts)) if parts else None,
        "speed": speed,
        "unit": str(status.get("unit", "updates")),
    }


def _summarise_policy(run: RunSummary, policy: str, records: Sequence[dict[str, Any]]) -> RunSummary:
    """Summarise one of several policies of a run; its own folder is complete only once the run has ended."""
    path = run.path / policy
    try:
        config = read_config(path / "config.yaml")
    except ValueError:
        config = run.config
    return _with_metrics(
        dataclasses.replace(run, name=f"{run.name}/{policy}", path=path, config=config), records, policy
    )


def _with_metrics(summary: RunSummary, records: Sequence[dict[str, Any]], policy: str = "") -> RunSummary:
    """Add the metrics of the run's policy, or of one of several."""
    found = {metric: _values(records, metric, policy) for metric in {*training_metrics(), summary.objective}}
    logged = {metric: values for metric, values in found.items() if values}
    model = str(as_dict(summary.config.get("model")).get("name"))
    folders = [(summary.path, model)]
    if policy:
        folders.insert(0, (summary.path.parent, policy))  # the run evaluates all of them together
    evaluations: dict[str, dict[str, Any]] = {}
    problems = []
    for folder, row in folders:
        for file in sorted(folder.glob("evaluation*.json"), key=lambda file: (file.stem != "evaluation", file.name)):
            try:
                evaluations |= read_evaluation(file, row)
            except (OSError, ValueError, TypeError, KeyError, AttributeError):
                problems.append(f"{file.name} cannot be read")
    return dataclasses.replace(
        summary,
        problem=", ".join(problems),
        last={metric: values[-1] for metric, values in logged.items()},
        recent={metric: sum(values[-RECENT:]) / len(values[-RECENT:]) for metric, values in logged.items()},
        best=read_best(summary.path / "best", summary.objective),
        evaluations=evaluations,
    )


def _policies(record: dict[str, Any]) -> list[str]:
    """The names of policies trained side by side, with which the names of their metrics begin."""
    heads = [key.removesuffix("/validation_loss").rpartition("/") for key in record if key.endswith("/validation_loss")]
    return list(dict.fromkeys(head for head, _, _ in heads if head))


def _values(records: Sequence[dict[str, Any]], metric: str, policy: str) -> list[float]:
    """A metric of a policy in the records that have it, averaged over the sizes."""
    found = []
    for record in records:
        values = [record[metric]] if not policy and metric in record else _by_size(record, metric, policy)
        numbers = [number for value in values if (number := as_number(value)) is not None]
        if numbers and len(numbers) == len(values):
            found.append(sum(numbers) / len(numbers))
    return found


def _by_size(record: dict[str, Any], metric: str, policy: str) -> list[Any]:
    """The values named ``<size>/<metric>``, or ``<policy>/<size>/<metric>``."""
    end = f"/{metric}"
    heads = ((key.removesuffix(end).rpartition("/"), value) for key, value in record.items() if key.endswith(end))
    return [value for (head, _, size), value in heads if head == policy and size.isdecimal()]
