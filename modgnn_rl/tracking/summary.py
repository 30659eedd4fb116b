"""What the plain files of a run folder say of the run, read without torch and without writing anything.

`modgnn_rl.runs` shows it. A folder may belong to somebody else, be written to meanwhile, or be damaged.
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

__all__ = ["METRICS", "RunSummary", "find_runs", "summarise_run"]

METRICS = ("error", "reward", "validation_loss", "loss")
RECENT = 5  # numbers that are averaged
DEPTH = 3  # folders, for sweeps and groups of runs


@dataclass(frozen=True)
class RunSummary:
    """How a run stands, or one of several policies that a run trains side by side.

    Attributes:
        name: of the folder, below the folder that was searched.
        path: the folder.
        run: the folder of the run, which for one of several policies is another.
        problem: what could not be read; empty where all could.
        config: the settings; empty where they cannot be read.
        state: as `modgnn_rl.tracking.run_folder.RunFolder.state`; ``unreadable`` without settings.
        reason: why it ended before its time.
        started, updated: when it began, and when it was last heard of.
        seconds: how long it has trained, s; if it does not train any more, until its last checkpoint.
        round, rounds: number of the last round, and of the last that is planned where that is a setting.
        share: how much of the training is done, 0 to 1; if it does not train any more, in its last checkpoint.
        speed, unit: what it does in a second, and of what.
        last: the last number of each of `METRICS`, averaged over the sizes trained on.
        recent: the mean of its last 5 numbers.
        aim: the metric that the best policy is the best in.
        best: its value then, a mean over 5 rounds.
        evaluations: the policy's row of each evaluation table, by the number of agents and the changes of the world, as
            in ``32 agents, wind=1``: `EVALUATED` with mean and confidence interval, `SHARES`, and of how many rollouts
            and steps (``num_flocks``, ``steps``) they are.
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
    aim: str = ""
    best: float | None = None
    evaluations: dict[str, dict[str, Any]] = field(default_factory=dict)
    policies: tuple[RunSummary, ...] = ()

    @property
    def sizes(self) -> list[Any]:
        """The numbers of agents trained on."""
        return as_list(as_dict(self.config.get("env")).get("num_agents"))


def find_runs(root: Path, depth: int = DEPTH) -> list[Path]:
    """The run folders in a folder, damaged ones too, or the folder itself if it is one.

    Args:
        root: where to look.
        depth: how many folders deep.
    """
    try:
        if any((root / name).is_file() for name in ("config.yaml", "status.json", "metrics.jsonl")):
            return [root]
        folders = sorted(path for path in root.iterdir() if path.is_dir()) if depth > 0 else []
    except OSError:  # not ours to look into
        return []
    return [run for folder in folders for run in find_runs(folder, depth - 1)]


def summarise_run(path: Path, name: str | None = None) -> RunSummary:
    """Read how a run stands; what cannot be read is left out and named in ``problem``.

    Args:
        path: the run folder.
        name: what to call it; default: the name of the folder.
    """
    name = name or path.absolute().name
    try:
        config = read_config(path / "config.yaml")
    except ValueError as error:
        return RunSummary(name, path, path, problem=str(error))
    run = RunFolder(path, config)
    records = last_records(run.metrics_file)
    trainer = str(as_dict(config.get("trainer")).get("name"))
    aim = TRAINERS[trainer].option("objective", "") if trainer in TRAINERS else ""
    summary = RunSummary(name, path, path, config=config, aim=aim, **_standing(run, records))
    policies = _policies(records[-1]) if records else []
    return dataclasses.replace(
        _with_figures(summary, records),
        policies=tuple(_summarise_policy(summary, policy, records) for policy in policies),
    )


def _standing(run: RunFolder, records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Those attributes of a summary that say how far a run is."""
    status, trainer = run.status, as_dict(run.config.get("trainer"))
    state, updated = run.state, as_time(status.get("updated"))
    done, total, seconds = (as_number(status.get(key)) for key in ("done", "total", "seconds"))
    speed = done / seconds if done and seconds else None
    step = as_number(records[-1].get("step")) if records else None
    rounds = as_number(trainer.get("rounds", trainer.get("iterations")))
    shares = [(done, total)]
    if state == "training":  # status.json tells of the last checkpoint, metrics.jsonl of the last round
        shares.append((step, rounds))
        written = written_at(run.metrics_file)
        if updated and written and written > updated:
            seconds = (seconds or 0) + (written - updated).total_seconds()
            updated = written
    parts = [part / whole for part, whole in shares if part is not None and whole]
    return {
        "state": state,
        "reason": str(status.get("reason", "")) if state in ("stopped", "failed") else "",  # it stays in status.json
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
    """One of several policies of a run; its own folder is whole only when the run has ended."""
    path = run.path / policy
    try:
        config = read_config(path / "config.yaml")
    except ValueError:
        config = run.config
    return _with_figures(
        dataclasses.replace(run, name=f"{run.name}/{policy}", path=path, config=config), records, policy
    )


def _with_figures(summary: RunSummary, records: Sequence[dict[str, Any]], policy: str = "") -> RunSummary:
    """Add what was measured of the run's policy, or of one of several."""
    numbers = {metric: _numbers(records, metric, policy) for metric in METRICS}
    measured = {metric: found for metric, found in numbers.items() if found}
    model = str(as_dict(summary.config.get("model")).get("name"))
    folders = [(summary.path, model)]
    if policy:
        folders.insert(0, (summary.path.parent, policy))  # where the run flew all of them
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
        last={metric: found[-1] for metric, found in measured.items()},
        recent={metric: sum(found[-RECENT:]) / len(found[-RECENT:]) for metric, found in measured.items()},
        best=read_best(summary.path / "best", summary.aim),
        evaluations=evaluations,
    )


def _policies(record: dict[str, Any]) -> list[str]:
    """The names of several policies trained side by side, which begin the names of their metrics."""
    heads = [key.removesuffix("/validation_loss").rpartition("/") for key in record if key.endswith("/validation_loss")]
    return list(dict.fromkeys(head for head, _, _ in heads if head))


def _numbers(records: Sequence[dict[str, Any]], metric: str, policy: str) -> list[float]:
    """A metric of a policy in those records that have it, the mean over the sizes."""
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
