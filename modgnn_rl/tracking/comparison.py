"""What tells runs apart: their settings, how they trained, how they fly."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

from modgnn_rl.configs.settings import flat
from modgnn_rl.errors import InputError
from modgnn_rl.tracking.listing import next_steps, state_of
from modgnn_rl.tracking.reader import EVALUATED, SHARES
from modgnn_rl.tracking.summary import METRICS, RunSummary
from modgnn_rl.utils.text import format_duration, format_value, markdown

__all__ = ["compare", "differing_settings"]

UNITS = {"error": "m^2/s^2", "validation_loss": "m^2/s^2", "leader_distance": "m", "cohesion": "m", "separation": "m"}
NOT_COMPARED = ("runs", "name", "resume")  # they say where a run is, not what it is
MISSING = "-"
DATE = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d-")


def compare(runs: Sequence[RunSummary]) -> str:
    """Markdown tables with a column for each run: the settings that differ, the training, the evaluation.

    Args:
        runs: two or more.

    Raises:
        InputError: there are fewer.
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

    Those of one trainer alone count where they differ between runs of that trainer.

    Returns:
        the value in each run, ``-`` where there is no such setting.
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
    """How runs stand, and their metrics."""
    rows = [
        ["state", *map(state_of, runs)],
        ["started", *(f"{run.started:%Y-%m-%d %H:%M:%S}" if run.started else MISSING for run in runs)],
        ["trained for", *(format_duration(run.seconds) for run in runs)],
        ["last round", *map(_round, runs)],
        ["speed", *(f"{format_value(run.speed)} {run.unit}/s" if run.speed else MISSING for run in runs)],
    ]
    for metric in METRICS:
        best = [run.best if run.aim == metric else None for run in runs]
        rows += [
            [f"{_title(metric)}: last", *(format_value(run.last.get(metric)) for run in runs)],
            [f"{_title(metric)}: mean of the last 5", *(format_value(run.recent.get(metric)) for run in runs)],
            [f"{_title(metric)}: best mean of 5", *map(format_value, best)],
        ]
    return [row for row in rows if set(row[1:]) != {MISSING}]


def _round(run: RunSummary) -> str:
    """The last round of how many."""
    return (
        MISSING if run.round is None else " of ".join(str(part) for part in (run.round, run.rounds) if part is not None)
    )


def _evaluation(runs: Sequence[RunSummary]) -> list[list[str]]:
    """The rows of the evaluation tables side by side; means with confidence intervals."""
    rows = []
    for flock in dict.fromkeys(flock for run in runs for flock in run.evaluations):
        found = [run.evaluations.get(flock) for run in runs]
        rows.append(
            [flock, *(f"{row['num_flocks']} rollouts of {row['steps']} steps" if row else MISSING for row in found)]
        )
        rows += [[_title(metric), *(_interval(row and row[metric]) for row in found)] for metric in EVALUATED]
        rows += [[share, *(f"{row[share]:.0%}" if row else MISSING for row in found)] for share in SHARES]
    return rows


def _title(metric: str) -> str:
    """The name of a metric with its unit."""
    return metric.replace("_", " ") + (f", {UNITS[metric]}" if metric in UNITS else "")


def _interval(spread: dict[str, float] | None) -> str:
    """Mean [confidence interval]."""
    return f"{spread['mean']:.3g} [{spread['low']:.3g}, {spread['high']:.3g}]" if spread else MISSING


def _as_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)
