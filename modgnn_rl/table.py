"""The evaluation table: figures of flights with their spread and confidence, as JSON and as Markdown."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from modgnn_rl.evaluation import Flights
from modgnn_rl.statistics import paired_difference, summarise

__all__ = ["as_json", "as_markdown", "summarise_flights"]

YARDSTICK = "LocalReynolds(hops=1)"
SUMMARISED = ("error", "leader_distance", "cohesion", "separation", "smallest_distance", "near_collisions", "reward")
NOTE = """\
Error: mean squared error of the action against the expert's, per component, over the agents that the policy flies
(m^2/s^2), with a 95 % confidence interval over flocks; its median over flocks; its mean in the four quarters of the
flight. Leader distance, cohesion (diameter of the smallest enclosing sphere) and separation (distance to the nearest
neighbour) in m: mean and standard deviation over flocks and time (separation: and agents). Smallest: the smallest
distance of any two agents in any flight, m. Lost: share of flocks in which nobody hears the leader at the end.
Diverged: share of flocks in which an agent strayed beyond env.max_distance. All rows fly from the same starts behind
the same leaders, each to the end."""


def summarise_flights(flights: Mapping[str, Flights], seed: int) -> dict[str, Any]:
    """Summarise each row's flights over flocks.

    Args:
        flights: flights by name of the policy, all from the same starts.
        seed: seed of the bootstrap.

    Returns:
        for each row the mean, standard deviation, median and confidence interval of each metric over flocks, the error
        by quarter, the standard deviations over time and flocks, the extremes, and the paired difference of its error
        from the yardstick's.
    """
    rng = np.random.default_rng(seed)
    table: dict[str, Any] = {}
    for name, flight in flights.items():
        row: dict[str, Any] = {}
        for metric in SUMMARISED:
            values = getattr(flight, metric).double().cpu().numpy()
            # A flock of one has no neighbour to be near or far from.
            row[metric] = dataclasses.asdict(summarise(values, rng=rng)) if np.isfinite(values).all() else None
        for metric, squares in flight.squares.items():
            if row[metric] is not None:
                row[metric]["std_over_time"] = float((squares.mean() - getattr(flight, metric).mean() ** 2).sqrt())
        row["error_by_quarter"] = flight.error_by_quarter.mean(0).tolist()
        row["smallest_distance_ever"] = float(flight.smallest_distance.min())
        row["lost"] = float(flight.lost.double().mean())
        row["diverged"] = float(flight.diverged.double().mean())
        if YARDSTICK in flights and name != YARDSTICK:
            errors = (f.error.double().cpu().numpy() for f in (flight, flights[YARDSTICK]))
            row["error_minus_local"] = dataclasses.asdict(paired_difference(*errors, rng=rng))
        table[name] = row
    return table


def as_json(tables: Mapping[int, Mapping[str, Any]], about: Mapping[str, Any]) -> str:
    """All tables, by number of agents, with what they were made from, as JSON."""
    return json.dumps({**about, "tables": {str(agents): table for agents, table in tables.items()}}, indent=2) + "\n"


def as_markdown(tables: Mapping[int, Mapping[str, Any]], title: str) -> str:
    """All tables, by number of agents, as a Markdown page."""
    parts = [f"# {title}"]
    for agents, table in tables.items():
        parts.append(f"## {agents} agents\n\n" + markdown_table(table))
    parts.append(NOTE)
    return "\n\n".join(parts) + "\n"


def markdown_table(table: Mapping[str, Any]) -> str:
    """One table in Markdown, aligned so that it also reads well on a terminal."""
    header = [
        *("flown by", "error", "95 % interval", "median", "by quarter", "leader distance"),
        *("cohesion", "separation", "smallest", "lost", "diverged"),
    ]
    rows = [header, *([name, *_cells(row)] for name, row in table.items())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def _cells(row: Mapping[str, Any]) -> list[str]:
    error = row["error"]
    figures = [f"{error['mean']:.3f}", f"{error['low']:.3f} to {error['high']:.3f}", f"{error['median']:.3f}"]
    figures.append(" ".join(f"{value:.3f}".removeprefix("0") for value in row["error_by_quarter"]))
    for metric in ("leader_distance", "cohesion", "separation"):
        entry = row[metric]
        figures.append("-" if entry is None else f"{entry['mean']:.2f} ± {entry['std_over_time']:.2f}")
    smallest = row["smallest_distance_ever"]
    figures.append(f"{smallest:.2f}" if np.isfinite(smallest) else "-")
    return [*figures, f"{row['lost']:.0%}", f"{row['diverged']:.0%}"]
