"""The paper's three tables with what was measured here beside the paper's figures."""

from __future__ import annotations

import functools
import importlib.resources
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml

from modgnn_rl.evaluation.statistics import Interval, interquartile_interval
from modgnn_rl.reporting.table import Table
from modgnn_rl.reproduction.measurements import VALIDATION, Results
from modgnn_rl.reproduction.studies import ModelVariant

__all__ = ["REFERENCES", "mean", "middle", "name_of", "paper_tables", "published", "shown", "spread", "title_of"]

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
METRES = {"leader_distance": "leader distance", "cohesion": "cohesion", "separation": "separation"}
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
    """What a model is called in tables: as in the paper, or as in settings."""
    return NAMES.get(model, model)


def middle(results: Results, row: Row, env_config: str, figure: str) -> Interval | None:
    """Interquartile mean of a figure over seeds and rollouts, with its 95 % interval; None where all failed."""
    values = results.values(row, env_config, figure)
    return None if values is None else interquartile_interval(values, rng=np.random.default_rng(0))


def shown(interval: Interval | None, digits: int = 3) -> str:
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
        "table2_middle": _evaluation_middle(results, rows),
        "table3": _generalization(results, rows),
    }


def mean(results: Results, row: Row, env_config: str, figure: str) -> float:
    """Mean of a figure over seeds and rollouts; NaN where all failed."""
    values = results.values(row, env_config, figure)
    return math.nan if values is None else float(values.mean())


def _about(results: Results, env_config: str) -> str:
    """How many rollouts a table rests on."""
    seeds = results.config.seeds
    counted = (
        f"{seeds} trainings of each model" if seeds > 1 else "one training of each model, so intervals tell of rollouts"
    )
    if env_config == VALIDATION:
        return f"{results.config.scale.val_episodes} rollouts of the expert that no model was trained on; {counted}."
    flown = next(entry for entry in results.study.settings if entry.name == env_config)
    return f"{flown.flocks} rollouts of {flown.steps} steps, from the same starts for all rows; {counted}."


def _paper(row: Row, *keys: Any) -> Any:
    """A figure of the paper, or None."""
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
        here = middle(results, row, VALIDATION, "error")
        average = mean(results, row, VALIDATION, "error")
        body.append([title_of(row), math.nan if paper is None else paper, average, shown(here)])
    caption = (
        "Mean squared error against the expert's action, per component, m²/s², on the expert's rollouts. Middle: "
        f"interquartile mean with its 95 % interval over seeds and rollouts. {_about(results, VALIDATION)}"
    )
    header = ["model", "paper", "mean", "middle [95 %]"]
    return Table("Table 1: validation error", header, body, caption, {1: "low", 2: "low"}, REFERENCES)


def _evaluation(results: Results, rows: Sequence[Row]) -> Table:
    header = ["model", "error, paper", "error"]
    for name in METRES.values():
        header += [f"{name}, paper", name]
    body = []
    for row in rows:
        model, hops = _hops(row)
        paper = _paper(row, "model_evaluation", model, hops) or {}
        cells: list[Any] = [title_of(row), paper.get("error", math.nan), mean(results, row, "N32", "error")]
        for figure in METRES:
            there = paper.get(figure)
            cells += ["-" if there is None else f"{there[0]:.2f} ± {there[1]:.2f}", _spread(results, row, figure)]
        body.append([*cells, _share(results, row, "leader_lost")])
    caption = (
        "Rollouts of the models' own with 32 agents. Error: mean squared, against the expert's action, m²/s². Leader "
        "distance, cohesion and separation: mean ± standard deviation over time, agents and rollouts, m. Lost: "
        "share of "
        f"flocks in which nobody hears the leader at the end. {_about(results, 'N32')}"
    )
    best: dict[int, Any] = {1: "low", 2: "low", 3: "low", 4: "low", 5: "low", 6: "low"}
    return Table("Table 2: rollouts of the models' own", [*header, "lost"], body, caption, best, REFERENCES)


def spread(results: Results, row: Row, figure: str) -> tuple[float, float]:
    """Mean and standard deviation of a figure over time, agents, rollouts and seeds; NaN where all failed."""
    values, squares = (results.values(row, "N32", name) for name in (figure, f"{figure}_square"))
    if values is None or squares is None:
        return math.nan, math.nan
    return float(values.mean()), math.sqrt(max(0.0, squares.mean() - values.mean() ** 2))


def _spread(results: Results, row: Row, figure: str) -> str:
    mean, deviation = spread(results, row, figure)
    return "failed" if math.isnan(mean) else f"{mean:.2f} ± {deviation:.2f}"


def _share(results: Results, row: Row, figure: str) -> str:
    values = results.values(row, "N32", figure)
    return "failed" if values is None else f"{values.mean():.0%}"


def _evaluation_middle(results: Results, rows: Sequence[Row]) -> Table:
    figures = {"error": "error", **METRES, "separation_spread": "spread of separation", "reward": "reward"}
    body = [
        [
            title_of(row),
            *(shown(middle(results, row, "N32", name), 3 if name == "error" else 2) for name in figures),
        ]
        for row in rows
    ]
    caption = (
        "The same rollouts: interquartile means over seeds and rollouts with their 95 % intervals. Spread of "
        "separation: "
        "its standard deviation over the time and agents of a rollout, m. Reward: of an agent, summed over the rollout."
    )
    best: dict[int, Any] = {1: "low", 2: "low", 3: "low", 5: "low", 6: "high"}
    return Table("Table 2, middle of the rollouts", ["model", *figures.values()], body, caption, best, REFERENCES)


def _generalization(results: Results, rows: Sequence[Row]) -> Table:
    settings = [env_config for env_config in results.study.settings if not env_config.changes]
    header, body = ["model"], []
    for env_config in settings:
        header += [f"N = {env_config.num_agents}, paper", f"N = {env_config.num_agents}", "middle [95 %]"]
    for row in rows:
        model, hops = _hops(row)
        if model == "central":
            continue
        cells: list[Any] = [title_of(row)]
        for env_config in settings:
            paper = _paper(row, "generalization", model, hops, env_config.num_agents)
            average = mean(results, row, env_config.name, "error")
            here = middle(results, row, env_config.name, "error")
            cells += [math.nan if paper is None else paper, average, shown(here)]
        body.append(cells)
    caption = (
        "Error on rollouts of the models' own with other numbers of agents than the 32 of training: mean, and "
        f"interquartile mean with its 95 % interval. {_about(results, settings[0].name)}"
    )
    best: dict[int, Any] = {
        column: "low" for start in range(1, 1 + 3 * len(settings), 3) for column in (start, start + 1)
    }
    return Table("Table 3: other numbers of agents", header, body, caption, best, REFERENCES)
