"""The paper's three tables, its values beside those measured here."""

from __future__ import annotations

import functools
import importlib.resources
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml

from modgnn_rl.evaluation.statistics import Interval, interquartile_interval
from modgnn_rl.registry import METRICS
from modgnn_rl.reporting.table import Table
from modgnn_rl.reproduction.measurements import VALIDATION, Results
from modgnn_rl.reproduction.studies import ModelVariant

__all__ = [
    "REFERENCES",
    "format_interval",
    "iqm",
    "mean",
    "mean_and_std",
    "metric_title",
    "name_of",
    "paper_tables",
    "published",
    "title_of",
]

NAMES = {
    "modgnn_mlp": "ModGNN-MLP",
    "no_mid": "ModGNN-MLP [-f_mid]",
    "no_pre": "ModGNN-MLP [-f_pre]",
    "gcn": "GCN",
    "gcn_final": "GCN [+f_final]",
    "central": "Central",
    "modgnn_adjacency": "ModGNN-MLP, adjacency",
    "gat": "attention",
    "mpnn": "message passing",
}
REFERENCES = ("expert", "local expert (2 hops)", "local expert (1 hop)", "zero action")
DISTANCES = ("leader_distance", "cohesion", "separation")  # metrics of the paper, m
Row = ModelVariant | str


@functools.cache
def published() -> dict[str, Any]:
    """The paper's figures: ``validation_loss``, ``model_evaluation`` and ``generalization`` by model and hops."""
    text = importlib.resources.files("modgnn_rl.reproduction").joinpath("paper_tables.yaml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text))


def title_of(row: Row) -> str:
    """What a row is called in tables."""
    if isinstance(row, str):
        return row
    if row.model == "central":
        return NAMES[row.model]
    layers = "" if row.layers is None else f", L = {row.layers}"
    return f"{name_of(row.model)}{layers}, K = {row.hops}"


def name_of(model: str) -> str:
    """The name of a model in tables: as in the paper, or as in settings."""
    return NAMES.get(model, model)


def metric_title(metric: str) -> str:
    """The title of a metric, or of its standard deviation over time and agents (``<metric>_spread``)."""
    name = metric.removesuffix("_spread")
    title = str(METRICS[name].options["title"])
    return title if name == metric else f"std of {title}"


def iqm(results: Results, row: Row, setting: str, metric: str) -> Interval | None:
    """Interquartile mean of a metric over seeds and episodes, with its 95 % interval; None if all failed."""
    values = results.values(row, setting, metric)
    return None if values is None else interquartile_interval(values, rng=np.random.default_rng(0))


def format_interval(interval: Interval | None, digits: int = 3) -> str:
    """An interquartile mean with its interval as text."""
    if interval is None:
        return "failed"
    value, low, high = (f"{number:.{digits}f}" for number in (interval.value, interval.low, interval.high))
    return f"{value} [{low}, {high}]"


def paper_tables(results: Results) -> dict[str, Table]:
    """The tables by the name of their files."""
    rows: list[Row] = [*REFERENCES, *results.study.variants]
    return {
        "table1": _validation(results, rows),
        "table2": _evaluation(results, rows),
        "table2_iqm": _evaluation_middle(results, rows),
        "table3": _generalization(results, rows),
    }


def mean(results: Results, row: Row, setting: str, metric: str) -> float:
    """Mean of a metric over seeds and episodes; NaN if all failed."""
    values = results.values(row, setting, metric)
    return math.nan if values is None else float(values.mean())


def _about(results: Results, setting: str) -> str:
    """The number of episodes and trainings behind a table."""
    seeds = results.config.seeds
    counted = (
        f"{seeds} trainings of each model"
        if seeds > 1
        else "one training of each model, so the intervals cover episodes only"
    )
    if setting == VALIDATION:
        return f"{results.config.scale.val_episodes} expert episodes that no model was trained on; {counted}."
    episodes = next(entry for entry in results.study.settings if entry.name == setting)
    return f"{episodes.flocks} episodes of {episodes.steps} steps from the same initial states for all rows; {counted}."


def _paper(row: Row, *keys: Any) -> Any:
    """A value of the paper, or None."""
    entry: Any = published()
    for key in keys:
        entry = entry.get(key) if isinstance(entry, dict) else None
    return entry


def _hops(row: Row) -> tuple[str, Any]:
    """Model and hops under which the paper lists a row."""
    return (row, "inf") if isinstance(row, str) else (row.model, row.hops)


def _validation(results: Results, rows: Sequence[Row]) -> Table:
    body = []
    for row in rows:
        model, hops = _hops(row)
        paper = _paper(row, "validation_loss", model, hops)
        here = iqm(results, row, VALIDATION, "error")
        average = mean(results, row, VALIDATION, "error")
        body.append([title_of(row), math.nan if paper is None else paper, average, format_interval(here)])
    caption = (
        "Mean squared error against the expert's action, per component, m²/s², on the expert's rollouts. Middle: "
        f"interquartile mean with its 95 % interval over seeds and episodes. {_about(results, VALIDATION)}"
    )
    header = ["model", "paper", "mean", "IQM [95 %]"]
    return Table("Table 1: validation error", header, body, caption, {1: "low", 2: "low"}, REFERENCES)


def _evaluation(results: Results, rows: Sequence[Row]) -> Table:
    header = ["model", "error, paper", "error"]
    for metric in DISTANCES:
        header += [f"{metric_title(metric)}, paper", metric_title(metric)]
    body = []
    for row in rows:
        model, hops = _hops(row)
        paper = _paper(row, "model_evaluation", model, hops) or {}
        cells: list[Any] = [title_of(row), paper.get("error", math.nan), mean(results, row, "N32", "error")]
        for metric in DISTANCES:
            there = paper.get(metric)
            cells += ["-" if there is None else f"{there[0]:.2f} ± {there[1]:.2f}", _spread(results, row, metric)]
        body.append([*cells, _share(results, row, "leader_lost")])
    caption = (
        "Closed loop with 32 agents. Error: mean squared, against the expert's action, m²/s². Leader "
        "distance, cohesion and separation: mean ± standard deviation over time, agents and episodes, m. Leader lost: "
        f"fraction of episodes that end with the leader out of everyone's range. {_about(results, 'N32')}"
    )
    best: dict[int, Any] = {1: "low", 2: "low", 3: "low", 4: "low", 5: "low", 6: "low"}
    return Table("Table 2: closed loop", [*header, "leader lost"], body, caption, best, REFERENCES)


def mean_and_std(results: Results, row: Row, metric: str) -> tuple[float, float]:
    """Mean and standard deviation of a metric over time, agents, episodes and seeds; NaN if all failed."""
    values, squares = (results.values(row, "N32", name) for name in (metric, f"{metric}_square"))
    if values is None or squares is None:
        return math.nan, math.nan
    return float(values.mean()), math.sqrt(max(0.0, squares.mean() - values.mean() ** 2))


def _spread(results: Results, row: Row, metric: str) -> str:
    mean, deviation = mean_and_std(results, row, metric)
    return "failed" if math.isnan(mean) else f"{mean:.2f} ± {deviation:.2f}"


def _share(results: Results, row: Row, metric: str) -> str:
    values = results.values(row, "N32", metric)
    return "failed" if values is None else f"{values.mean():.0%}"


def _evaluation_middle(results: Results, rows: Sequence[Row]) -> Table:
    metrics = ("error", *DISTANCES, "separation_spread", "reward")
    body = [
        [
            title_of(row),
            *(format_interval(iqm(results, row, "N32", name), 3 if name == "error" else 2) for name in metrics),
        ]
        for row in rows
    ]
    caption = (
        "The same episodes: interquartile means over seeds and episodes with their 95 % intervals. Std of separation: "
        "its standard deviation over the time and agents of an episode, m. Reward: per agent, summed over the episode."
    )
    best: dict[int, Any] = {1: "low", 2: "low", 3: "low", 5: "low", 6: "high"}
    return Table(
        "Table 2, interquartile means", ["model", *map(metric_title, metrics)], body, caption, best, REFERENCES
    )


def _generalization(results: Results, rows: Sequence[Row]) -> Table:
    settings = [setting for setting in results.study.settings if not setting.changes]
    header, body = ["model"], []
    for setting in settings:
        header += [f"N = {setting.num_agents}, paper", f"N = {setting.num_agents}", "IQM [95 %]"]
    for row in rows:
        model, hops = _hops(row)
        if model == "central":
            continue
        cells: list[Any] = [title_of(row)]
        for setting in settings:
            paper = _paper(row, "generalization", model, hops, setting.num_agents)
            average = mean(results, row, setting.name, "error")
            here = iqm(results, row, setting.name, "error")
            cells += [math.nan if paper is None else paper, average, format_interval(here)]
        body.append(cells)
    caption = (
        "Closed-loop error with other numbers of agents than the 32 of training: mean, and "
        f"interquartile mean with its 95 % interval. {_about(results, settings[0].name)}"
    )
    best: dict[int, Any] = {
        column: "low" for start in range(1, 1 + 3 * len(settings), 3) for column in (start, start + 1)
    }
    return Table("Table 3: other numbers of agents", header, body, caption, best, REFERENCES)
