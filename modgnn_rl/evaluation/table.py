"""The evaluation table: metrics over episodes with their spread and confidence intervals, as JSON and as Markdown."""

from __future__ import annotations

import dataclasses
import json
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import EpisodeMetrics
from modgnn_rl.evaluation.statistics import paired_difference, summarise
from modgnn_rl.metrics import heading
from modgnn_rl.registry import METRICS
from modgnn_rl.task import Task
from modgnn_rl.utils.text import markdown

__all__ = ["evaluation_markdown", "read_tables", "summarise_rollouts"]

ERROR_COLUMNS = ("policy", "error", "median", "by episode quarter")
NOTE = """\
All policies start from the same states. An episode that ends early counts with the steps that it has. Mean ± standard \
deviation over episodes [95 % confidence interval of the mean]. Median: of the error, over episodes. By episode \
quarter: mean error in each quarter of the episode."""


def summarise_rollouts(rollouts: Mapping[str, EpisodeMetrics], task: Task, seed: int) -> dict[str, Any]:
    """Summarise the episodes of each policy.

    Args:
        rollouts: by name of the policy, all from the same starts.
        task: of the policies.
        seed: seed of the bootstrap.

    Returns:
        for each policy, by name of the metric: the ``mean`` over episodes (the fraction if it holds or does not) and
        their number ``n``; of a number, also ``std``, ``median`` and the confidence interval of the mean (``low``,
        ``high``); of a mean over time, ``std_over_time``, over time, agents and episodes; of a minimum, ``min``. None
        where the flock is too small for the metric. If the task has an expert, also ``error_by_quarter``, and if it has
        a yardstick, ``error_minus_local``, the paired difference from the error of that reference policy.
    """
    rng = np.random.default_rng(seed)
    table: dict[str, Any] = {}
    for name, rollout in rollouts.items():
        row: dict[str, Any] = {metric: _summary(rollout, metric, rng) for metric in task.metrics}
        if "error" in task.metrics:
            row["error_by_quarter"] = rollout.error_by_quarter.nanmean(0).tolist()
        yardstick = None if task.yardstick is None else rollouts.get(task.yardstick)
        if yardstick is not None and name != task.yardstick and row["error"] is not None:
            own, local = (episodes["error"].cpu().numpy() for episodes in (rollout, yardstick))
            row["error_minus_local"] = dataclasses.asdict(paired_difference(own, local, rng=rng))
        table[name] = row
    return table


def _summary(rollout: EpisodeMetrics, metric: str, rng: np.random.Generator) -> dict[str, float] | None:
    """What the table tells of one metric."""
    values = rollout[metric]
    if values.dtype == torch.bool:
        return {"mean": float(values.double().mean()), "n": len(values)}
    if not values.isfinite().all():  # a flock of one has no controlled agent and no neighbour
        return None
    found: dict[str, float] = dataclasses.asdict(summarise(values.double().cpu().numpy(), rng=rng))
    if metric in rollout.mean_squares:
        variance = rollout.mean_squares[metric].mean() - values.mean() ** 2
        found["std_over_time"] = float(variance.clamp(min=0).sqrt())
    if METRICS[metric].options["over_time"] == "min":
        found["min"] = float(values.min())
    return found


def read_tables(file: Path) -> dict[str, Any]:
    """Read the tables of an evaluation by number of agents; none if the file does not exist.

    Raises:
        InputError: an evaluation did not write the file, or it is damaged.
    """
    try:
        tables = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        return {str(int(size)): {**entry, "rows": dict(entry["rows"])} for size, entry in tables.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{file} is not as an evaluation wrote it; delete it and evaluate again") from error


def evaluation_markdown(tables: Mapping[str, Any], title: str) -> str:
    """Tables, by number of agents, as a Markdown page that also reads well in a terminal.

    Args:
        tables: for each number of agents the rollouts (``num_flocks``, ``steps``) and the ``rows`` that
            `summarise_rollouts` makes of them.
        title: heading of the page.
    """
    named = {name for table in tables.values() for row in table["rows"].values() for name in row}
    metrics = sorted((name for name in METRICS if name in named), key=lambda name: name != "error")
    fractions = [name for name in metrics if METRICS[name].options["unit"] == "%"]
    others = [name for name in metrics if name not in ("error", *fractions)]
    has_error = "error" in metrics
    parts = [f"# {title}"]
    for size, table in tables.items():
        errors: list[list[str]] = [[*(ERROR_COLUMNS if has_error else ("policy",)), *map(_title, fractions)]]
        shapes: list[list[str]] = [["policy", *map(_title, others)]]
        for name, row in table["rows"].items():
            errors.append(
                [name, *(_error_cells(row) if has_error else ()), *(_cell(row, metric) for metric in fractions)]
            )
            shapes.append([name, *(_cell(row, metric) for metric in others)])
        head = f"## {size} agents, {table['num_flocks']} episodes of {table['steps']} steps"
        parts += [head, *(markdown(columns) for columns in (errors, shapes) if len(columns[0]) > 1)]
    (task,) = {str(table["task"]) for table in tables.values()}
    explained = (f"{heading(name, task).capitalize()}: {METRICS[name].options['about']}." for name in metrics)
    note = textwrap.fill(" ".join([NOTE, *explained]), 120, break_on_hyphens=False)
    return "\n\n".join([*parts, note]) + "\n"


def _title(metric: str) -> str:
    return str(METRICS[metric].options["title"])


def _cell(row: Mapping[str, Any], metric: str) -> str:
    entry = row.get(metric)
    return "-" if entry is None else str(METRICS[metric].options["cell"].format(**entry))


def _error_cells(row: Mapping[str, Any]) -> list[str]:
    """Error, median, and error in each quarter."""
    if row["error"] is None:
        return ["-"] * 3
    quarters = " ".join(f"{value:.3f}".removeprefix("0") for value in row["error_by_quarter"])
    return [_cell(row, "error"), f"{row['error']['median']:.3f}", quarters]
