"""Comparison of runs: settings, training, evaluation."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from modgnn_rl.configs.settings import flat
from modgnn_rl.errors import InputError
from modgnn_rl.metrics import heading
from modgnn_rl.registry import METRICS
from modgnn_rl.tracking.listing import next_steps, state_of
from modgnn_rl.tracking.summary import RunSummary, training_metrics
from modgnn_rl.utils.text import format_duration, format_value, markdown

__all__ = ["compare", "differing_settings"]

NOT_COMPARED = ("runs", "name", "resume")  # where a run is, not what it is
MISSING = "-"
DATE = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-")


def compare(runs: Sequence[RunSummary]) -> str:
    """Markdown tables with a column per run: settings that differ, training, evaluation.

    Args:
        runs: two or more.

    Raises:
        InputError: fewer than two runs.
    """
    if len(runs) < 2:
        raise InputError(f"{len(runs)} run cannot be compared: give two or more, as in compare=[dagger-gcn,bc-gcn]")
    head = ["", *(DATE.sub("", run.name) for run in runs)]
    settings = [[key, *map(_as_text, values)] for key, values in differing_settings(runs).items()]
    tables = {"Settings that differ": settings, "Training": _training(runs), "Evaluation": _evaluation(runs)}
    parts = [f"## {title}\n\n{markdown([head, *rows])}" for title, rows in tables.items() if rows]
    return "\n\n".join([*parts, *next_steps(runs)])


def differing_settings(runs: Sequence[RunSummary]) -> dict[str, list[Any]]:
    """The settings in which runs differ, by their dotted names.

    A setting that only one trainer has is compared between the runs of that trainer.

    Returns:
        the value in each run, ``-`` if the run has no such setting.
    """
    leaves = [flat(run.config) for run in runs]
    trainers = [settings.get("trainer.name") for settings in leaves]
    found = {}
    for key in dict.fromkeys(key for settings in leaves for key in settings):
        values = [settings.get(key, MISSING) for settings in leaves]
        having = {trainer for trainer, settings in zip(trainers, leaves, strict=True) if key in settings}
        comparable = [value for trainer, value in zip(trainers, values, strict=True) if trainer in having]
        if key not in NOT_COMPARED and any(value != comparable[0] for value in comparable):
            found[key] = values
    return found


def _training(runs: Sequence[RunSummary]) -> list[list[str]]:
    """State and training metrics of runs."""
    rows = [
        ["state", *map(state_of, runs)],
        ["started", *(f"{run.started:%Y-%m-%d %H:%M:%S}" if run.started else MISSING for run in runs)],
        ["trained for", *(format_duration(run.seconds) for run in runs)],
        ["last round", *map(_round, runs)],
        ["speed", *(f"{format_value(run.speed)} {run.unit}/s" if run.speed else MISSING for run in runs)],
    ]
    for metric in training_metrics():
        title = heading(metric, runs[0].task)
        best = [run.best if run.objective == metric else None for run in runs]
        rows += [
            [f"{title}: last", *(format_value(run.last.get(metric)) for run in runs)],
            [f"{title}: mean of the last 5", *(format_value(run.recent.get(metric)) for run in runs)],
            [f"{title}: best mean of 5", *map(format_value, best)],
        ]
    return [row for row in rows if set(row[1:]) != {MISSING}]


def _round(run: RunSummary) -> str:
    """The last round, and of how many."""
    return (
        MISSING if run.round is None else " of ".join(str(part) for part in (run.round, run.rounds) if part is not None)
    )


def _evaluation(runs: Sequence[RunSummary]) -> list[list[str]]:
    """The rows of the evaluation tables side by side: means with confidence intervals, and fractions."""
    rows = []
    for flock in dict.fromkeys(flock for run in runs for flock in run.evaluations):
        found = [run.evaluations.get(flock) for run in runs]
        rows.append(
            [flock, *(f"{row['num_flocks']} episodes of {row['steps']} steps" if row else MISSING for row in found)]
        )
        metrics = [name for name in METRICS if any(row and row.get(name) for row in found)]
        task = next(run.task for run in runs if flock in run.evaluations)
        rows += [[heading(metric, task), *(_mean(row and row.get(metric)) for row in found)] for metric in metrics]
    return rows


def _mean(entry: dict[str, float] | None) -> str:
    """Mean [confidence interval], or a fraction in percent."""
    if not entry:
        return MISSING
    return "{mean:.3g} [{low:.3g}, {high:.3g}]".format(**entry) if "low" in entry else f"{entry['mean']:.0%}"


def _as_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)
