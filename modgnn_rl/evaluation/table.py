"""The evaluation table: figures of rollouts with their spread and confidence, as JSON and as Markdown."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import EpisodeMetrics
from modgnn_rl.evaluation.statistics import paired_difference, summarise
from modgnn_rl.utils.text import markdown

__all__ = ["as_markdown", "read_tables", "summarise_rollouts"]

YARDSTICK = "LocalReynolds(hops=1)"
SUMMARISED = ("error", "leader_distance", "cohesion", "separation", "min_distance", "collision_rate", "reward")
ERROR_HEADER = ("flown by", "error", "median", "by quarter", "lost", "diverged")
SHAPE_HEADER = ("flown by", "leader distance", "cohesion", "separation", "smallest", "touching", "reward")
NOTE = """\
All rows fly from the same starts behind the same leaders, each to the end. Mean ± standard deviation over flocks
[95 % confidence interval of the mean]. Error: mean squared error of the action against the expert's, per component,
over the agents that the policy flies, m^2/s^2; with its median over flocks and its mean in the quarters of the rollout.
Lost: share of flocks in which nobody hears the leader at the end. Diverged: share of flocks in which an agent strayed
beyond env.max_distance. Leader distance: from the leader to the centre of mass of the others. Cohesion: diameter of the
smallest enclosing sphere. Separation: distance to the nearest neighbour. Smallest: the smallest distance of any two
agents in any rollout. Touching: pairs within env.collision_distance, mean over time. Reward: of an agent, summed over
the rollout. All distances in m."""


def summarise_rollouts(rollouts: Mapping[str, EpisodeMetrics], seed: int) -> dict[str, Any]:
    """Summarise each row's rollouts over flocks.

    Args:
        rollouts: rollouts by name of the policy, all from the same starts.
        seed: seed of the bootstrap.

    Returns:
        for each row the mean, standard deviation, median and confidence interval of each metric over flocks, the error
        by quarter, the standard deviations over time and flocks, the extremes, and the paired difference of its error
        from the yardstick's.
    """
    rng = np.random.default_rng(seed)
    table: dict[str, Any] = {}
    for name, rollout in rollouts.items():
        row: dict[str, Any] = {}
        for metric in SUMMARISED:
            values = getattr(rollout, metric).double().cpu().numpy()
            # A flock of one has nobody that the policy flies, and no neighbour.
            row[metric] = dataclasses.asdict(summarise(values, rng=rng)) if np.isfinite(values).all() else None
        for metric, squares in rollout.squares.items():
            if row[metric] is not None:
                row[metric]["std_over_time"] = float((squares.mean() - getattr(rollout, metric).mean() ** 2).sqrt())
        row["error_by_quarter"] = rollout.error_by_quarter.mean(0).tolist()
        row["smallest_distance_ever"] = float(rollout.min_distance.min())
        row["lost"] = float(rollout.lost.double().mean())
        row["diverged"] = float(rollout.diverged.double().mean())
        if YARDSTICK in rollouts and name != YARDSTICK:
            mine, local = (f.error.double().cpu().numpy() for f in (rollout, rollouts[YARDSTICK]))
            if row["error"] is not None:
                row["error_minus_local"] = dataclasses.asdict(paired_difference(mine, local, rng=rng))
        table[name] = row
    return table


def read_tables(file: Path) -> dict[str, Any]:
    """The tables, by number of agents, that an evaluation left in a file; none where there is no such file.

    Raises:
        InputError: the file is not what an evaluation writes.
    """
    try:
        tables = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        return {str(int(size)): {**entry, "rows": dict(entry["rows"])} for size, entry in tables.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{file} is not as an evaluation wrote it; delete it and evaluate again") from error


def as_markdown(tables: Mapping[str, Any], title: str) -> str:
    """Tables, by number of agents, as a Markdown page that also reads well on a terminal.

    Args:
        tables: for each number of agents the rollouts it was made of (``num_flocks``, ``steps``) and its ``rows``, as
            made by `summarise_rollouts`.
        title: heading of the page.
    """
    parts = [f"# {title}"]
    for size, table in tables.items():
        rows = table["rows"]
        errors = [ERROR_HEADER, *([name, *_error_cells(row)] for name, row in rows.items())]
        shapes = [SHAPE_HEADER, *([name, *_shape_cells(row)] for name, row in rows.items())]
        parts += [
            f"## {size} agents, {table['num_flocks']} rollouts of {table['steps']} steps",
            markdown(errors),
            markdown(shapes),
        ]
    return "\n\n".join([*parts, NOTE]) + "\n"


def _error_cells(row: Mapping[str, Any]) -> list[str]:
    if row["error"] is None:
        return ["-"] * (len(ERROR_HEADER) - 1)
    quarters = " ".join(f"{value:.3f}".removeprefix("0") for value in row["error_by_quarter"])
    shares = [f"{row[name]:.0%}" for name in ("lost", "diverged")]
    return [_spread(row["error"], 3), f"{row['error']['median']:.3f}", quarters, *shares]


def _shape_cells(row: Mapping[str, Any]) -> list[str]:
    cells = [_spread(row[metric], 2) for metric in ("leader_distance", "cohesion", "separation")]
    alone = row["min_distance"] is None
    smallest = "-" if alone else f"{row['smallest_distance_ever']:.2f}"
    touching = "-" if row["collision_rate"] is None else f"{row['collision_rate']['mean']:.2g}"
    return [*cells, smallest, touching, _interval(row["reward"], 1)]


def _spread(entry: Mapping[str, float] | None, digits: int) -> str:
    """Mean ± standard deviation [confidence interval]."""
    if entry is None:
        return "-"
    mean, std, low, high = (f"{entry[key]:.{digits}f}" for key in ("mean", "std", "low", "high"))
    return f"{mean} ± {std} [{low}, {high}]"


def _interval(entry: Mapping[str, float] | None, digits: int) -> str:
    """Mean [confidence interval]."""
    if entry is None:
        return "-"
    mean, low, high = (f"{entry[key]:.{digits}f}" for key in ("mean", "low", "high"))
    return f"{mean} [{low}, {high}]"
